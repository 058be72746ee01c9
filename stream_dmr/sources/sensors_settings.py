"""The table [sensors] of config.toml."""

from datetime import UTC, datetime

from pydantic import Field, field_validator

from stream_dmr.settings import Settings


class SensorsSettings(Settings):
    """`[sensors]`: how positions of `run --nmea` are read, and tied to the frames."""

    start_utc: str = Field(
        default="",
        description='when a video began, such as "2026-11-22T06:00:00Z"; "": not known; '
        "cameras and folders of clips have times of their own",
    )
    offset_s: float = Field(
        default=0.0, description="added to the times of the frames to get the receiver's UTC, s"
    )
    max_gap_s: float = Field(
        default=60.0,
        gt=0,
        le=1e9,
        description="between positions further apart than this none is interpolated, s",
    )
    silence_s: float = Field(
        default=15.0, gt=0, description="a receiver that is silent for longer is a problem, s"
    )
    max_speed_knots: float = Field(
        default=60.0,
        gt=0,
        description="a position that needs more speed than this is a jump, and left out, knots",
    )
    keep_s: float = Field(
        default=10.0,
        ge=0,
        le=1e9,
        description="time between the positions that lengths.db keeps, s; a recording has all",
    )
    baud: int = Field(default=4800, ge=300, le=921600, description="of a serial receiver, bit/s")

    @field_validator("start_utc")
    @classmethod
    def _is_a_time(cls, text: str) -> str:
        if text:
            utc_ns_of(text)
        return text

    @property
    def zero_utc_ns(self) -> int | None:
        """The receiver's UTC at the first moment of a video, ns since 1970; None: not known."""
        return utc_ns_of(self.start_utc) + self.offset_ns if self.start_utc else None

    @property
    def offset_ns(self) -> int:
        return round(self.offset_s * 1e9)


def utc_ns_of(text: str) -> int:
    """A time in ISO 8601 as ns since 1970, in UTC if it has no zone. ValueError if it is no time.

    Digits after the microsecond are left out.
    """
    try:
        moment = datetime.fromisoformat(text.strip())
    except ValueError as error:
        raise ValueError(
            f"a time in ISO 8601 such as 2026-11-22T06:00:00Z, got {text!r}"
        ) from error
    moment = moment.replace(tzinfo=moment.tzinfo or UTC) - datetime(1970, 1, 1, tzinfo=UTC)
    return (moment.days * 86_400 + moment.seconds) * 1_000_000_000 + moment.microseconds * 1000
