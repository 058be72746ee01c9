"""The base of every table of `config.toml`: typed, strict and frozen."""

from pydantic import BaseModel, ConfigDict


class Settings(BaseModel):
    """Base class of a table of `config.toml`, defined beside the algorithm that uses it.

    Unknown keys, wrong types and values out of range raise pydantic's ValidationError, which
    `pipeline.config` turns into a ConfigError of one line.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)
