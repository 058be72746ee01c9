"""The tables of config.toml that belong to a run as a whole: [drift] and [watch]."""

from pydantic import Field

from stream_dmr.settings import Settings


class DriftSettings(Settings):
    """`[drift]`: alarms of a run without an end; lengths measured since are marked."""

    sample_s: float = Field(
        default=5.0, gt=0, le=3600, description="between two pictures of the scene, s"
    )
    shift_px: float = Field(
        default=3.0, gt=0, description="the rail this far off its place is an alarm, frame px"
    )
    sharpness: float = Field(
        default=0.5, gt=0, lt=1, description="edges this much weaker than once are an alarm, ratio"
    )
    reference_fish: int = Field(
        default=50, ge=10, description="the first fish, by whose fits later ones are judged"
    )
    recent_fish: int = Field(default=30, ge=10, description="the latest fish, which are judged")
    worse_iou: float = Field(
        default=0.01, gt=0, lt=1, description="a median IoU lower by this is an alarm, if no chance"
    )


class WatchSettings(Settings):
    """`[watch]`: the status page, /metrics and /health of a run."""

    port: int = Field(
        default=0, ge=0, le=65535, description="where the status page is served; 0: nowhere"
    )
    host: str = Field(
        default="127.0.0.1",
        description="the address to listen on; any but this machine's own needs a token",
    )
    token_file: str = Field(
        default="",
        description='a file with the token that readers have to give; "": none on this machine',
    )
    stuck_s: float = Field(
        default=120.0,
        gt=0,
        description="a stage that has had one frame for so long is taken to hang, s",
    )
