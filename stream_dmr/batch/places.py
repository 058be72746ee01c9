"""Where a batch keeps what, below its --out."""

import csv
from pathlib import Path
from urllib.parse import quote

from stream_dmr.errors import OutputError

VIDEOS = "videos.csv"  # what became of each video
VIDEO_FOLDERS = "videos"
OUTCOME = "outcome.json"  # what became of one, in its folder
KINDS = ("fish", "frames")  # of tables, one row each
RESULT_COLUMNS = ("status", "reason", "frames", "fish", "elapsed_s")
VIDEO_COLUMNS = ("name", "video", "vessel", "trip", "haul", *RESULT_COLUMNS)
DONE, FAILED, WAITING = "done", "failed", "waiting"


def read_videos(out: Path) -> list[dict[str, str]]:
    """The rows of videos.csv. OutputError where it is damaged."""
    path = out / VIDEOS
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file, strict=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise OutputError(f"{path}: expected the videos of a batch, got: {error}") from error
    if not rows or any(len(row) != len(VIDEO_COLUMNS) for row in rows):
        raise OutputError(f"{path}: expected the columns {','.join(VIDEO_COLUMNS)}")
    return [dict(zip(VIDEO_COLUMNS, row, strict=True)) for row in rows[1:]]


def in_dataset(out: Path, kind: str, *, vessel: str, trip: str, name: str) -> Path:
    """The table of a video in the data set, partitioned as Hive does.

    Without a name, vessel or trip is that of no letters: pandas can't join others to what Hive has
    for none.
    """
    partition = Path(f"vessel={quote(vessel, safe='')}", f"trip={quote(trip, safe='')}")
    return out / "dataset" / kind / partition / f"{name}.parquet"
