"""`[train]`: how the U-Net is trained."""

from pydantic import Field

from stream_dmr.settings import Settings


class TrainSettings(Settings):
    """`[train]`: how `stream-dmr train` trains the U-Net."""

    seed: int = Field(default=1, ge=0, description="equal seeds draw equal pictures")
    epochs: int = Field(default=34, ge=1, description="most epochs; fewer where nothing improves")
    crops_per_epoch: int = Field(
        default=2048, ge=32, description="pictures between two validations"
    )
    validation_crops: int = Field(
        default=512, ge=16, description="pictures of each validation, never trained on"
    )
    batch_size: int = Field(default=32, ge=2, le=1024, description="pictures per step")
    learning_rate: float = Field(default=2e-3, gt=0, le=0.1, description="highest step size")
    patience: int = Field(
        default=12, ge=1, description="epochs without improvement after which training ends"
    )
    own_share: float = Field(
        default=0.6,
        ge=0.05,
        le=1,
        description="share of the pictures that come from --images, the others are simulated",
    )
    bank_fish: int = Field(default=3000, ge=8, description="different fish to be simulated")
    bank_backgrounds: int = Field(
        default=1000, ge=8, description="different backgrounds to be simulated"
    )
    workers: int = Field(
        default=0,
        ge=0,
        le=64,
        description="processes that draw pictures; 0: the training process itself",
    )
    bfloat16: bool = Field(
        default=False,
        description="compute with half as many bits: twice as fast on processors that support it",
    )
