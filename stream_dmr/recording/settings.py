"""The table [recording] of config.toml."""

from typing import Literal

from pydantic import Field

from stream_dmr.settings import Settings


class RecordingSettings(Settings):
    """What is recorded, and how exactly. `docs/recording.md` says what each choice costs."""

    mcap: bool = Field(default=True, description="write recording.mcap, the record of truth")
    rrd: bool = Field(default=True, description="write recording.rrd, the view for Rerun")
    rrd_messages: bool = Field(
        default=True,
        description="put the exact messages into the .rrd too, so that it can be replayed alone",
    )
    frames: Literal["reference", "jpeg"] = Field(
        default="jpeg",
        description="pictures of the source in the .mcap: a reference into it, or as JPEG",
    )
    crops: Literal["png", "jpeg"] = Field(
        default="png", description="pictures of the crops: exact as PNG, or as JPEG"
    )
    jpeg_quality: int = Field(
        default=85, ge=1, le=100, description="quality of every JPEG, 1 to 100 (no unit)"
    )
    flush_s: float = Field(
        default=1.0, gt=0, le=60, description="the most that a crash may lose, seconds of recording"
    )
