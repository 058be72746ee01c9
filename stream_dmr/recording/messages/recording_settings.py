"""The table [recording] of config.toml."""

from typing import Literal

from pydantic import Field

from stream_dmr.settings import Settings


class RecordingSettings(Settings):
    """What is recorded, and how exactly. `docs/files.md` says what each choice keeps."""

    mcap: bool = Field(default=True, description="write recording.mcap, the record of truth")
    rrd: bool = Field(default=True, description="write recording.rrd, the view for Rerun")
    rrd_messages: bool = Field(
        default=True,
        description="put the messages into the .rrd too, so that it can be replayed alone",
    )
    frames: Literal["reference", "jpeg", "h264"] = Field(
        default="reference",
        description='the source\'s pictures: "reference" (number and checksum), "jpeg", '
        '"h264" (small, for the eye)',
    )
    crops: Literal["few", "none", "jpeg", "png"] = Field(
        default="few",
        description='pictures of the crops beside their masks: "few" (of each fish of a camera '
        'whose frames are not kept), "none", "jpeg", "png" (exact)',
    )
    meshes: Literal["parameters", "vertices"] = Field(
        default="parameters",
        description='of each fit: its "parameters", or "vertices" and covariance as well',
    )
    jpeg_quality: int = Field(
        default=85, ge=1, le=100, description="quality of every JPEG, 1 to 100 (no unit)"
    )
    h264_crf: int = Field(
        default=25, ge=0, le=51, description="coarseness of H.264 pictures, x264's CRF (no unit)"
    )
    view_rate_hz: float = Field(
        default=6.0,
        gt=0,
        le=1000,
        description="pictures and meshes drawn into the .rrd per second; plots have every frame",
    )
    view_px: int = Field(
        default=960,
        ge=64,
        description="pictures in the .rrd are halved until no side is longer, px",
    )
    foxglove: bool = Field(
        default=False,
        description="also write topics for Foxglove Studio into the .mcap, as often as the .rrd's",
    )
    flush_s: float = Field(
        default=0.5,
        gt=0,
        le=60,
        description="longest time that data wait for the disk, s: what a crash may lose; those of "
        "the .rrd four times as long",
    )
    segment_s: float = Field(
        default=60.0,
        ge=2,
        description="duration of one recording file of a live source, s",
    )
    segment_mb: float = Field(
        default=512.0, ge=1, description="largest .mcap of one recording file of a live source, MB"
    )
    keep_free_gb: float = Field(
        default=2.0,
        ge=0,
        description="free space below which the oldest of these files are deleted, GB; 0: never",
    )

    @property
    def keeps_crops(self) -> bool:
        """True where the pictures of all crops are recorded."""
        return self.crops in ("jpeg", "png")

    def keeps_photographs(self, *, is_live: bool) -> bool:
        """True where some crops of each fish are all that will be left to see of it."""
        return is_live and self.crops == "few" and self.frames == "reference"
