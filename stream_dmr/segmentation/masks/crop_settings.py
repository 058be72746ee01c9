"""`[crop_fish]`: how fish are cut out of the frame."""

from typing import Annotated

from pydantic import Field

from stream_dmr.segmentation.network.unet_interface import SIZE_MULTIPLE_PX
from stream_dmr.settings import Settings

_PictureSize = Annotated[int, Field(ge=64, le=1024, multiple_of=SIZE_MULTIPLE_PX)]


class CropFishSettings(Settings):
    """`[crop_fish]`: how fish are cut out of the frame."""

    crop_size_px: int = Field(
        default=128, ge=32, le=1024, description="width and height of a crop, px"
    )
    margin: float = Field(
        default=0.15,
        ge=0,
        le=2,
        description="margin on each side, as a fraction of the fish's longer side",
    )
    min_mask_area_px: int = Field(
        default=64, ge=1, description="smaller masks are ignored, frame px"
    )
    segmenter_sizes_px: list[_PictureSize] = Field(
        default=[128],
        min_length=1,
        description="widths of the pictures of a crop that the segmenter sees, multiples of 32 px, "
        "those that the frame has; the mean counts. Stills: [128, 192, 256]",
    )
    second_look: bool = Field(
        default=False,
        description="true: what was found is cut out again as a wider view shows it, and the surer "
        "mask counts: a detector's box may lack the tail. Stills: true",
    )
    segmenter: str = Field(
        default="unet",
        min_length=1,
        description='what finds the mask in a box: "unet", "grabcut", a network of '
        "`stream-dmr train` (.onnx), or a promptable model (.onnx)",
    )
