"""The manifest of a batch: a row names a video, where its fish are, and where it comes from."""

import csv
import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path

from stream_dmr import __version__
from stream_dmr.errors import UserError

COLUMNS = ("video", "calibration", "boxes", "masks", "vessel", "trip", "haul")


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
    tracks: Sequence[int] = ()  # of a piece of the video: the fish that are measured
    first_frame: int = 0
    last_frame: int = 0
    share: float = 1.0  # of the work that the whole video is

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
    def num_bytes(self) -> float:
        """Of the video: by these the time left is estimated."""
        path = Path(self.video)
        return self.share * path.stat().st_size if path.is_file() else 0.0


def read_manifest(path: Path, *, config: Path | None, template: str) -> list[Job]:
    """The jobs of a manifest; its relative paths start from its own folder.

    Raises UserError where it can't be read or lacks its columns. Files that it names are not
    looked at here: a missing one is the failure of its own row.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
            columns = reader.fieldnames or []
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path}: expected a manifest as CSV in UTF-8, got: {error}") from error
    missing = [name for name in COLUMNS if name not in columns]
    unknown = [name for name in columns if name not in COLUMNS]
    if missing or unknown:
        raise UserError(
            f"{path}: expected the columns {','.join(COLUMNS)}, got {','.join(columns) or 'none'}"
        )
    if not rows:
        raise UserError(f"{path}: expected a row for each video, got none")
    names = _names([row["video"] or "" for row in rows])
    home = path.resolve().parent
    mesh = template if not Path(template).is_file() else str(Path(template).resolve())
    jobs = []
    for number, (row, name) in enumerate(zip(rows, names, strict=True), start=2):
        if not row["video"] or None in row:
            raise UserError(f"{path}, line {number}: expected {len(COLUMNS)} cells with a video")
        files = {key: str(home / row[key]) if row[key] else "" for key in COLUMNS[:4]}
        origin = {key: (row[key] or "").strip() for key in COLUMNS[4:]}
        jobs.append(
            Job(
                name=name,
                video=files["video"],
                calibration=files["calibration"],
                boxes=files["boxes"],
                masks=files["masks"],
                vessel=origin["vessel"],
                trip=origin["trip"],
                haul=origin["haul"],
                config="" if config is None else str(config.resolve()),
                template=mesh,
            )
        )
    return jobs


def _names(videos: list[str]) -> list[str]:
    """A folder's name for each: that of the video, and a number where it comes again."""
    stems = [re.sub(r"[^A-Za-z0-9._-]+", "-", Path(v).stem).strip("-.") or "video" for v in videos]
    seen, names, taken = Counter[str](), list[str](), set[str]()
    for stem in stems:
        name = stem
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
