"""The settings of a replay: those that are given, and the recorded ones of the stages before it."""

from collections.abc import Callable, Mapping
from pathlib import Path

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


def replay_config(
    given: Path | None,
    recorded_toml: str,
    *,
    first: str,
    on_notice: Callable[[str], None] = lambda line: None,
) -> Config:
    """The settings of a replay from the stage `first` on.

    Of a given config.toml the recorded settings of the stages before `first` are left out;
    `on_notice` is told of those that it has otherwise. Raises ConfigError where one of the two
    can't be read.
    """
    if given is not None and first == "crop":
        return load_config(given)
    recorded = parse_config(recorded_toml, where="the recording's config.toml")
    if given is None:
        return recorded
    config = load_config(given)
    changes: dict[str, object] = {}
    unused: list[str] = []
    for table, stages in _stages_before(first, config).items():
        settings, earlier = getattr(config, table), getattr(recorded, table)
        said = settings.model_fields_set if table in config.model_fields_set else ()
        kept = {key: getattr(earlier, key) for key in stages}
        unused += [
            f"[{table}] {key} = {toml_value(value)}"
            for key, value in kept.items()
            if key in said and getattr(settings, key) != value
        ]
        changes[table] = settings.model_copy(update=kept)
    if unused:
        on_notice(
            f"--config {given}: settings of stages before {first} stay as they were recorded: "
            + ", ".join(unused)
        )
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
