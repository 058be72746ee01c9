"""Names and places of the files of a batch, below its --out."""

import csv
from pathlib import Path
from urllib.parse import quote

from stream_dmr.errors import OutputError, reason_of
from stream_dmr.tables import original_cell

VIDEOS = "videos.csv"  # the outcome of each video
VIDEO_FOLDERS = "videos"
OUTCOME = "outcome.json"  # in the folder of a video that a batch measured, or tried to
FAILED_OUTCOME = "outcome-failed.json"  # of a later try, beside the results of an earlier try
TABLE_KINDS = ("fish", "frames")  # tables of the data set
# Columns of VIDEOS and the fields of an Outcome that they hold.
OUTCOME_COLUMNS = {
    "status": "status",
    "reason": "reason",
    "frames": "num_frames",
    "fish": "num_fish",
    "elapsed_s": "elapsed_s",
}
VIDEO_COLUMNS = ("name", "video", "vessel", "trip", "haul", *OUTCOME_COLUMNS)
DONE, FAILED, WAITING = "done", "failed", "waiting"


def results_folder(name: str, out: Path) -> Path:
    return out / VIDEO_FOLDERS / name


def unfinished_folder(name: str, out: Path) -> Path:
    return out / VIDEO_FOLDERS / f"{name}.part"


def read_videos(out: Path) -> list[dict[str, str]]:
    """The rows of videos.csv. Raises OutputError if it is damaged."""
    path = out / VIDEOS
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file, strict=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise OutputError(
            f"{path}: expected the videos of a batch, got: {reason_of(error)}"
        ) from error
    if not rows or any(len(row) != len(VIDEO_COLUMNS) for row in rows):
        raise OutputError(f"{path}: expected the columns {','.join(VIDEO_COLUMNS)}")
    cells = ([original_cell(cell) for cell in row] for row in rows[1:])
    return [dict(zip(VIDEO_COLUMNS, row, strict=True)) for row in cells]


def dataset_file(out: Path, kind: str, *, vessel: str, trip: str, name: str) -> Path:
    """The Parquet file of a video in the data set, in Hive's partitions.

    A missing vessel or trip is the empty string: pandas can't join other partitions to Hive's
    `__HIVE_DEFAULT_PARTITION__`.
    """
    partition = Path(f"vessel={quote(vessel, safe='')}", f"trip={quote(trip, safe='')}")
    return out / "dataset" / kind / partition / f"{name}.parquet"
