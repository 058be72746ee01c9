"""The table [watch] of config.toml."""

from pydantic import Field

from stream_dmr.settings import Settings


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
