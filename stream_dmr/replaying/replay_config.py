"""The settings of a replay: those that are given, and the recorded ones of the stages before it."""

from collections.abc import Mapping
from pathlib import Path

from stream_dmr.errors import UserError
from stream_dmr.replaying.replay_request import STAGES
from stream_dmr.running.config import Config, load_config, parse_config, toml_value

# The settings that a replay from a later stage on leaves as they were, by their stage.
_TABLES = {
    "read_frames": "crop",
    "detect_fish": "crop",
    "track_fish": "crop",
    "crop_fish": "crop",
    "fit_mesh": "fit",
    "localize": "localize",
}
_KEYS = {"species": {"model": "crop", "forms": "fit"}}  # of tables that several stages use


def replay_config(given: Path | None, recorded_toml: str, *, first: str) -> Config:
    """The settings of a replay from the stage `first` on.

    Of a given config.toml the recorded settings of the stages before `first` are left out. Raises
    UserError where it has others, and ConfigError where one of the two can't be read.
    """
    if given is not None and first == "crop":
        return load_config(given)
    recorded = parse_config(recorded_toml, where="the recording's config.toml")
    if given is None:
        return recorded
    config = load_config(given)
    changes: dict[str, object] = {}
    for table, stages in _stages_before(first, config).items():
        settings, earlier = getattr(config, table), getattr(recorded, table)
        for key, stage in stages.items():
            value, before = getattr(settings, key), getattr(earlier, key)
            is_said = table in config.model_fields_set and key in settings.model_fields_set
            if is_said and value != before:
                raise UserError(
                    f"--config {given} with --from {first}: expected the recorded [{table}] {key} "
                    f"= {toml_value(before)}, got {toml_value(value)}, which matters to an earlier "
                    f"stage; use --from {stage}, or leave it out of the file"
                )
        kept = {key: getattr(earlier, key) for key in stages}
        changes[table] = settings.model_copy(update=kept)
    return config.model_copy(update=changes)


def _stages_before(first: str, config: Config) -> Mapping[str, Mapping[str, str]]:
    """Table -> key -> stage, of the settings that belong to a stage before `first`."""
    keys = {
        table: dict.fromkeys(type(getattr(config, table)).model_fields, stage)
        for table, stage in _TABLES.items()
    }
    earlier = [*STAGES][: [*STAGES].index(first)]
    return {
        table: {key: stage for key, stage in stages.items() if stage in earlier}
        for table, stages in (keys | _KEYS).items()
    }
