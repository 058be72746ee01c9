"""The manifest of a batch: a row names a video, where its fish are, and where it comes from."""

import csv
import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from stream_dmr import __version__
from stream_dmr.errors import UserError

COLUMNS = ("video", "calibration", "boxes", "masks", "vessel", "trip", "haul")
_FILES = COLUMNS[:4]


@dataclass(frozen=True, kw_only=True)
class Job:
    """One video. Paths are absolute, "" where there is none; it travels to workers as JSON."""

    name: str  # of its folder, unlike any other's
    video: str
    calibration: str = ""
    boxes: str = ""
    masks: str = ""
    vessel: str = ""
    trip: str = ""
    haul: str = ""
    config: str = ""
    template: str = "halibut"
    piece: str = ""  # of the video, where this is one; see `pieces`
    sightings: str = ""  # where the fish of a piece are, as its video's scout noted
    tracks: Sequence[int] = ()  # the fish that a piece measures
    first_frame: int = 0
    last_frame: int = 0
    share: float = 1.0  # of the work that the whole video is

    @property
    def label(self) -> str:
        """Unlike that of any other video, and of any other piece."""
        return f"{self.name}/{self.piece}" if self.piece else self.name

    @property
    def key(self) -> str:
        """Of all that its results depend on: a video that is done counts as done by it."""
        stamps = [_stamp(path) for path in (self.video, self.masks)]
        contents = [_content(path) for path in (self.calibration, self.boxes, self.config)]
        mesh = Path(self.template)
        contents += [_content(str(path)) for path in (mesh, mesh.with_suffix(".toml"))]
        made_of = [__version__, asdict(self), stamps, contents]
        return sha256(json.dumps(made_of).encode()).hexdigest()

    @property
    def num_bytes(self) -> int:
        """Of the video: by these the time left is estimated."""
        path = Path(self.video)
        return path.stat().st_size if path.is_file() else 0


def read_manifest(path: Path, *, config: Path | None, template: str) -> list[Job]:
    """The jobs of a manifest; its relative paths start from its own folder.

    Raises UserError where it can't be read or lacks its columns. Files that it names are not
    looked at here: a missing one is the failure of its own row.
    """
    rows = _rows(path)
    names = _names([row["video"] or "" for row in rows])
    mesh = template if not Path(template).is_file() else str(Path(template).resolve())
    shared = {"config": "" if config is None else str(config.resolve()), "template": mesh}
    jobs, home = [], path.resolve().parent
    for number, (row, name) in enumerate(zip(rows, names, strict=True), start=2):
        if not row["video"] or None in row:
            raise UserError(f"{path}, line {number}: expected {len(COLUMNS)} cells with a video")
        cells = {key: (row[key] or "").strip() for key in COLUMNS}
        files = {key: str(home / cells[key]) for key in _FILES if cells[key]}
        values: dict[str, Any] = cells | files | shared
        jobs.append(Job(name=name, **values))
    return jobs


def _rows(path: Path) -> list[dict[str | None, str | None]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            rows, columns = list(reader), reader.fieldnames or []
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path}: expected a manifest as CSV in UTF-8, got: {error}") from error
    if sorted(columns) != sorted(COLUMNS):
        raise UserError(
            f"{path}: expected the columns {','.join(COLUMNS)}, got {','.join(columns) or 'none'}"
        )
    if not rows:
        raise UserError(f"{path}: expected a row for each video, got none")
    return rows


def _names(videos: list[str]) -> list[str]:
    """A folder's name for each: that of the video, and a number where it comes again.

    None ends like the folder of a video that is being measured.
    """
    stems = [re.sub(r"[^A-Za-z0-9._-]+", "-", Path(v).stem).strip("-.") or "video" for v in videos]
    seen, names, taken = Counter[str](), list[str](), set[str]()
    for stem in stems:
        name = stem = stem.removesuffix(".part") or "video"
        while name in taken:
            seen[stem] += 1
            name = f"{stem}-{seen[stem] + 1}"
        taken.add(name)
        names.append(name)
    return names


def _stamp(path: str) -> list[int]:
    """Size and time of change: videos are too large to be read just for this."""
    try:
        status = Path(path).stat() if path else None
    except OSError:
        return []
    return [] if status is None else [status.st_size, status.st_mtime_ns]


def _content(path: str) -> str:
    try:
        return sha256(Path(path).read_bytes()).hexdigest() if path else ""
    except OSError:
        return ""
