"""Open the results of a folder: recording, database, learnt meshes.

The meshes of the shapes that a run learnt, in its folder: template.ply, template-2.ply, ...

Others may call a mesh of their own so. A run's are known by the first line of their TOML.
"""

import re
from collections.abc import Iterator
from functools import cache
from hashlib import sha256
from pathlib import Path

import numpy as np

from stream_dmr.errors import OutputError, RecordingError
from stream_dmr.fitting.shape.candidates import AUTO, load_shapes
from stream_dmr.messages import Message
from stream_dmr.recording.codec import encode
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.reading import Recording, files_of, header_at, open_recordings
from stream_dmr.recording.selection import EVERYTHING, Selection
from stream_dmr.recording.topics import TOPICS, MessageTypes, Topics
from stream_dmr.store.batch_folder import VIDEO_FOLDERS, VIDEOS
from stream_dmr.store.fish import Fish, database_of, read_runs
from stream_dmr.template.template import Template
from stream_dmr.template.template_file import bundled_names

_UNKNOWN = "unknown"


def open_results(path: Path, *, template: str = AUTO) -> Recording:
    """The recording of a run's folder or a recording itself; a `LostRecording` if it is gone.

    `template`: the run's, if known. Raises RecordingError if there is neither a recording nor a
    lengths.db.
    """
    if (path / VIDEOS).is_file() and not _has_recording(path):
        raise RecordingError(
            f"{path}: expected a recording or the --out of one run, got that of a batch; give one "
            f"of its {VIDEO_FOLDERS}/NAME, or read the fish of all in dataset/fish"
        )
    database = database_of(path)
    if database is None or _has_recording(path):
        return open_recordings([path], of_all_runs=True)
    return LostRecording(database, template)


def _has_recording(path: Path) -> bool:
    try:
        return bool(files_of(path))
    except RecordingError:
        return False


class LostRecording:
    """A recording without messages; its header has the facts of the last run in lengths.db."""

    def __init__(self, database: Path, template: str = AUTO) -> None:
        """Raises OutputError if the database can't be read."""
        facts = [*read_runs(database).values()][-1:]
        self.header = RunHeader(
            source=facts[0].source if facts else _UNKNOWN,
            command=facts[0].command if facts else _UNKNOWN,
            config_toml="",
            template=_template_by(facts[0].template_sha256 if facts else "", template),
        )
        self.metadata: dict[str, str] = {}
        self.is_thinned = True
        self.ends_early = False
        self.warnings = [
            f"{database.parent}: no recording (.mcap, .rrd) is left, so this is what "
            f"{database.name} has: no frames, pictures or meshes, and [fisheries] of --config or "
            "the defaults"
        ]

    def payloads(
        self, kinds: MessageTypes, selection: Selection = EVERYTHING, *, of: Topics = TOPICS
    ) -> Iterator[tuple[type[Message], bytes]]:
        return iter(())

    def carried_over(self) -> Iterator[bytes]:
        return iter(())

    def video(self, selection: Selection = EVERYTHING) -> Iterator[bytes]:
        return iter(())


def require_recording(recording: Recording, *, where: object, what: str) -> None:
    """Raise RecordingError if a recording that `what` needs is gone."""
    if isinstance(recording, LostRecording):
        raise RecordingError(
            f"{where}: expected a recording for {what}, found no .mcap and no .rrd; lengths.db "
            "has the lengths, which `export --fish`, `--tables` and `report` give"
        )


def template_of_fish(recording: Recording, fish: Fish) -> Template:
    """The template by which a fish was measured, also if its part of the recording was deleted."""
    template = header_at(recording, fish.estimate.last_timestamp_ns).template
    made_by = fish.facts.template_sha256
    return template if _sha256_of(template) == made_by else _template_by(made_by, AUTO)


@cache
def _sha256_of(template: Template) -> str:
    return sha256(encode(template)).hexdigest()


@cache
def _template_by(hash_hex: str, likely: str) -> Template:
    """The likely or the bundled template with this SHA-256.

    Nothing is known of another template, not even its tail: it was only in the recording.
    """
    for name in (likely, AUTO, *bundled_names()):
        template, _ = load_shapes(name)
        if _sha256_of(template) == hash_hex:
            return template
    midline = np.linspace([-0.5, 0.0, 0.0], [0.5, 0.0, 0.0], 3)
    return Template(
        name=_UNKNOWN,
        rest_vertices=np.zeros((0, 3)),
        faces=np.zeros((0, 3), np.int64),
        keypoints=midline,
        joints=midline[1:2].repeat(2, axis=0),
        midline=midline,
    )


LEARNT = "template.ply"  # of the largest stock
MADE_BY_RUN = "stream-dmr run"
_NAMES = re.compile(r"template(-\d+)?\.(ply|toml)")


def learnt_files(folder: Path) -> list[Path]:
    """The meshes that runs wrote into a folder, and their TOMLs."""
    return [path for path in _so_named(folder) if is_mesh_by(MADE_BY_RUN, path)]


def require_free_names(folder: Path, *, overwrite: bool) -> None:
    """Raise OutputError if a foreign file has a name that a learnt mesh would get.

    With `overwrite` it may be replaced.
    """
    for path in _so_named(folder):
        if not (overwrite or is_mesh_by(MADE_BY_RUN, path)):
            raise OutputError(
                f"{path}: expected a name that is free for the learnt shape of the fish, it is "
                "taken; rename it, or choose another --out"
            )


def is_mesh_by(command: str, path: Path) -> bool:
    """True for a mesh whose TOML says that `command` made it, and for that TOML."""
    mark = mesh_comment(command, "").encode()
    try:
        with path.with_suffix(".toml").open("rb") as file:
            return file.read(len(mark) + 2) == b"# " + mark
    except OSError:
        return False


def mesh_comment(command: str, what: str) -> str:
    """The first line of a learnt mesh's TOML, without its `# `."""
    return f"made by {command}: {what}"


def _so_named(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("template*") if _NAMES.fullmatch(path.name))
