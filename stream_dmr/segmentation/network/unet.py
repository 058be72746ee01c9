"""A U-Net small enough for two CPU cores (paper, Sec. 2; Ronneberger et al., MICCAI 2015).

Its first convolution already halves the input, so that no layer works at full size; the last one
gives four values per cell, which are the four pixels of that cell. The widths were chosen for 15 ms
a crop on one core: 1.53 million weights, more than half of them in the coarsest level, which takes
little time, need 3.3 ms (docs/research/start-and-memory.md).
"""

import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn
from torch.nn.functional import interpolate, pixel_shuffle

_WIDTHS = (24, 40, 64, 96, 128)  # channels at 1/2, 1/4, 1/8, 1/16 and 1/32 of the size
_DEPTHS = (0, 1, 1, 2, 2)  # residual blocks on the way down
MIN_SPREAD = 4.0  # grey levels: noise of a uniform image is not amplified


class UNet(nn.Module):
    """From a crop and its box to the fish's mask and the positions of its head and tail."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = _convolve(4, _WIDTHS[0], kernel=4, stride=2)
        self.down, self.across, self.up = nn.ModuleList(), nn.ModuleList(), nn.ModuleList()
        for fine, coarse, depth in zip(_WIDTHS, _WIDTHS[1:], _DEPTHS[1:], strict=False):
            blocks = (Residual(coarse) for _ in range(depth))
            self.down.append(nn.Sequential(_convolve(fine, coarse, stride=2), *blocks))
            self.across.append(nn.Conv2d(coarse, fine, 1))
            self.up.append(Residual(fine))
        self.mask = nn.Conv2d(_WIDTHS[0], 4, 3, padding=1)
        self.ends = nn.Conv2d(_WIDTHS[1], 2, 3, padding=1)

    def forward(
        self, inputs: Float[Tensor, "B 4 H W"]
    ) -> tuple[Float[Tensor, "B H W"], Float[Tensor, "B 2 h w"]]:
        """Logits of the mask at the input's size, and of head and tail at a quarter of it.

        `inputs` are from `normalise`; h and w are H and W over ENDS_STRIDE.
        """
        x = self.stem(inputs)
        levels = [x]
        for down in self.down:
            levels.append(x := down(x))
        ends = x
        for level in reversed(range(len(self.up))):
            x = interpolate(self.across[level](x), scale_factor=2.0, mode="nearest")
            x = self.up[level](x + levels[level])
            if level == 1:
                ends = self.ends(x)
        return pixel_shuffle(self.mask(x), 2)[:, 0], ends


def normalise(
    images: Float32[Tensor, "B H W 3"], in_box: Float32[Tensor, "B H W"]
) -> Float32[Tensor, "B 4 H W"]:
    """The network's input from BGR images (0 to 255) and the fraction of each pixel in the box.

    Each channel's mean is subtracted and the image's overall spread set to one, so that neither
    the water's colour nor the exposure matters.
    """
    centred = images - images.mean(dim=(1, 2), keepdim=True)
    spread = centred.square().mean(dim=(1, 2, 3), keepdim=True).sqrt()
    channels = torch.cat([centred / (spread + MIN_SPREAD), in_box[..., None] - 0.5], dim=3)
    return channels.permute(0, 3, 1, 2)  # channels_last in memory, the faster layout


class Residual(nn.Module):
    """Two convolutions with a skip connection."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = _convolve(width, width)
        self.second = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
        """`x`, plus what the two convolutions make of it."""
        return torch.relu(x + self.second(self.first(x)))


def _convolve(channels: int, width: int, *, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    """Convolution, batch normalisation, ReLU; an even kernel halves without a shift."""
    padding = (kernel - 1) // 2
    return nn.Sequential(
        nn.Conv2d(channels, width, kernel, stride, padding, bias=False),
        nn.BatchNorm2d(width),
        nn.ReLU(inplace=True),
    )
