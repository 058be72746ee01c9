"""The table [hauls] of config.toml."""

from pydantic import Field

from stream_dmr.settings import Settings


class HaulsSettings(Settings):
    """`[hauls]`: rules by which a run begins and ends hauls itself."""

    pause_min: float = Field(
        default=0.0,
        ge=0,
        description="a haul begins with a fish, and ends with the last one before so many minutes "
        "without any; 0: no hauls by rule",
    )
    end_speed_knots: float = Field(
        default=0.0,
        ge=0,
        description="such a haul also ends when the vessel goes faster for a minute, knots; 0: not",
    )
