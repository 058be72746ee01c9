"""The base of every table of `config.toml`: typed, strict and frozen."""

from pydantic import BaseModel, ConfigDict


class Settings(BaseModel):
    """One table of `config.toml`; it lives beside the algorithm that it steers.

    Unknown keys and wrong types are refused; `config.py` turns the refusal into one clear line.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)
