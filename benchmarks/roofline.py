"""What a piece of torch asks of a device, counted from shapes, and what the device can give."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from clock import typical
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

# One kernel after the other on one stream; the host needs about as long to ask for it.
LAUNCH_S = 5e-6
_MOVES = ("index.", "gather", "index_select", "index_copy", "index_add", "scatter", "embedding")


class Peak(NamedTuple):
    """What a device can do in a second, in float32."""

    name: str
    bytes_per_s: float
    flops_per_s: float


# By NVIDIA's data sheet: what is reckoned with where no GPU is at hand.
H200 = Peak("NVIDIA H200, by its data sheet", 4.8e12, 67e12)


class Load(NamedTuple):
    """Of one call: memory traffic, arithmetic, kernels."""

    bytes: float
    flops: float
    kernels: int

    def seconds(self, peak: Peak) -> dict[str, float]:
        """The least time that each resource takes."""
        return {
            "memory": self.bytes / peak.bytes_per_s,
            "arithmetic": self.flops / peak.flops_per_s,
            "launches": self.kernels * LAUNCH_S,
        }


class _Tally(TorchDispatchMode):
    """Adds up every operation; views are free, and nothing is taken to stay in a cache."""

    def __init__(self) -> None:
        super().__init__()
        self.load = Load(0.0, 0.0, 0)

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        out = func(*args, **(kwargs or {}))
        reads, writes = _tensors((args, kwargs)), _tensors(out)
        if func.is_view or "view" in str(func) or not writes:
            return out
        name = str(func)
        if any(move in name for move in _MOVES):
            traffic = _moved(name, reads, writes)
        else:
            traffic = sum(map(_stored, reads)) + sum(map(_stored, writes))
        flops = max(t.numel() for t in (*reads, *writes))
        if "mm." in name:  # a product of matrices; the last axis of the first is summed over
            flops = 2 * writes[0].numel() * reads[-2].shape[-1]
        load = self.load
        self.load = Load(load.bytes + traffic, load.flops + flops, load.kernels + 1)
        return out


def load_of(call: Callable[[], object]) -> Load:
    """Run once and count."""
    with _Tally() as tally:
        call()
    return tally.load


def peak_of(device: str) -> Peak:
    """Measured: a large copy, and a large product of matrices."""
    if device == "cpu":
        return H200
    source, square = torch.empty(1 << 28, device=device), torch.randn(8192, 8192, device=device)
    target = torch.empty_like(source)
    copy = timed(lambda: target.copy_(source))
    product = timed(lambda: square @ square)
    name = f"{torch.cuda.get_device_name()}, measured"
    return Peak(name, 2 * 4 * len(source) / copy, 2 * 8192**3 / product)


def timed(call: Callable[[], object]) -> float:
    """Median wall seconds of a call on the GPU, to its very end."""

    def to_the_end() -> None:
        call()
        torch.cuda.synchronize()

    return typical(to_the_end).wall_s


def _tensors(tree: object) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)]


def _stored(tensor: Tensor) -> int:
    """Bytes; what is expanded is stored once."""
    count = 1
    for extent, stride in zip(tensor.shape, tensor.stride(), strict=True):
        count *= extent if stride else 1
    return count * tensor.element_size()


def _moved(name: str, reads: list[Tensor], writes: list[Tensor]) -> float:
    """Of gathers and scatters: what is moved, not the whole of what it is taken from or put to."""
    is_put = any(word in name for word in ("copy", "add", "scatter"))
    indices = sum(_stored(t) for t in reads if t.dtype == torch.int64)
    values = _stored(reads[-1]) if is_put else _stored(writes[0])
    return indices + (3 if "add" in name else 2) * values
