"""The tables of config.toml that belong to a run as a whole: [drift], [watch] and [alerts]."""

from pydantic import Field

from stream_dmr.settings import Settings


class DriftSettings(Settings):
    """`[drift]`: alarms of an endless run; lengths measured during an alarm are flagged."""

    sample_s: float = Field(
        default=5.0, gt=0, le=3600, description="time between two pictures of the scene, s"
    )
    shift_px: float = Field(
        default=3.0, gt=0, description="a shift of the static scene that raises an alarm, frame px"
    )
    sharpness: float = Field(
        default=0.5,
        gt=0,
        lt=1,
        description="edge strength, relative to the first, below which an alarm is raised",
    )
    reference_fish: int = Field(
        default=50, ge=10, description="number of first fish whose fits are the reference"
    )
    recent_fish: int = Field(
        default=30, ge=10, description="number of latest fish that are compared with them"
    )
    worse_iou: float = Field(
        default=0.01,
        gt=0,
        lt=1,
        description="drop of the median IoU that raises an alarm, if significant",
    )


class WatchSettings(Settings):
    """`[watch]`: the status page, /metrics and /health of a run."""

    port: int = Field(
        default=0, ge=0, le=65535, description="port of the status page; 0: it is not served"
    )
    host: str = Field(
        default="127.0.0.1",
        description="address to listen on; any but this machine's own needs a token",
    )
    token_file: str = Field(
        default="",
        description='file with the access token; "": no token, on this machine only',
    )
    stuck_s: float = Field(
        default=120.0,
        gt=0,
        description="a stage that works on one frame for longer counts as hanging, s",
    )


class AlertSettings(Settings):
    """`[alerts]`: who is told when a run becomes unhealthy, and when it is healthy again."""

    webhook: str = Field(
        default="", description='address that gets a POST of JSON; "": nobody is told this way'
    )
    mail_to: str = Field(default="", description='mail address that is told; "": none')
    mail_from: str = Field(default="", description="mail address of the sender, and its login")
    mail_server: str = Field(
        default="", description="mail server that takes it, host or host:port (587)"
    )
    mail_password_file: str = Field(
        default="", description='file with the sender\'s password; "": the server asks for none'
    )
