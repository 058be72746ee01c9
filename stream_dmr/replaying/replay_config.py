"""The settings of a replay: those that are given, and the recorded ones of the stages before it."""

from collections.abc import Callable, Mapping
from pathlib import Path

from stream_dmr.replaying.replay_request import STAGES
from stream_dmr.running.conditions import lying, stills
from stream_dmr.running.config import Config, load_config, parse_config, toml_value

_READ = "read"  # comes before all stages of a replay, whose frames are those of the recording
# The settings that a replay from a later stage on leaves as they were, by their stage.
_TABLES = {
    "read_frames": _READ,
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
    recorded = parse_config(recorded_toml, where="the recording's config.toml")
    if given is None:
        return recorded
    mine = load_config(given)
    config = _in_conditions_of(recorded, mine)
    changes: dict[str, object] = {}
    unused: list[str] = []
    for table, stages in _stages_before(first, config).items():
        settings, earlier = getattr(config, table), getattr(recorded, table)
        said = getattr(mine, table).model_fields_set if table in mine.model_fields_set else ()
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


def _in_conditions_of(recorded: Config, given: Config) -> Config:
    """The given settings with those of --pose lying and --stills, where the run had these."""
    config = given
    if recorded.localize.rests_on_plane and "rests_on_plane" not in given.localize.model_fields_set:
        config = lying(config)
    is_stills = not recorded.track_fish.across_frames
    if is_stills and "across_frames" not in given.track_fish.model_fields_set:
        config = stills(config, is_calibrated=True)  # the size of pictures stays as recorded
    return config


def _stages_before(first: str, config: Config) -> Mapping[str, Mapping[str, str]]:
    """Table -> key -> stage, of the settings that belong to a stage before `first`."""
    keys = {
        table: dict.fromkeys(type(getattr(config, table)).model_fields, stage)
        for table, stage in _TABLES.items()
    }
    earlier = {_READ, *[*STAGES][: [*STAGES].index(first)]}
    return {
        table: {key: stage for key, stage in stages.items() if stage in earlier}
        for table, stages in (keys | _KEYS).items()
    }
