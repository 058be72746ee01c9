"""Where a batch keeps what, below its --out."""

from pathlib import Path
from urllib.parse import quote

VIDEOS = "videos.csv"  # what became of each video
VIDEO_FOLDERS = "videos"
OUTCOME = "outcome.json"  # what became of one, in its folder
KINDS = ("fish", "frames")  # of tables, one row each
RESULT_COLUMNS = ("status", "reason", "frames", "fish", "elapsed_s")
DONE, FAILED, WAITING = "done", "failed", "waiting"


def in_dataset(out: Path, kind: str, *, vessel: str, trip: str, name: str) -> Path:
    """The table of a video in the data set, partitioned as Hive does.

    Without a name, vessel or trip is that of no letters: pandas can't join others to what Hive has
    for none.
    """
    partition = Path(f"vessel={quote(vessel, safe='')}", f"trip={quote(trip, safe='')}")
    return out / "dataset" / kind / partition / f"{name}.parquet"
