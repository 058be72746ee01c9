"""Reads single tables of the settings that a recording's run had."""

import tomllib
from typing import TypeVar

from stream_dmr.recording.reading.open_recording import Recording
from stream_dmr.settings import Settings

Table = TypeVar("Table", bound=Settings)


def recorded_settings(recording: Recording, table: str, kind: type[Table]) -> Table:
    """The table `[table]` of the run's config.toml; defaults where an older run had none."""
    config = tomllib.loads(recording.header.config_toml)
    return kind.model_validate(config.get(table, {}))
