"""`[crop_fish]`: how fish are cut out of the frame."""

from pydantic import Field

from stream_dmr.settings import Settings


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
    segmenter: str = Field(
        default="unet",
        min_length=1,
        description='what finds the mask in a box: "unet", "grabcut", a network of '
        "`stream-dmr train` (.onnx), or a promptable model (.onnx)",
    )
