"""lengths.csv and frames.csv: the results for people and spreadsheets.

Values are rounded to six decimals, far below what is measured; blank means there is none.
"""

from collections.abc import Iterable
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
from jaxtyping import Float

from stream_dmr.csv_file import CsvFile
from stream_dmr.errors import OutputError
from stream_dmr.files import rename_durably, writing_to
from stream_dmr.messages import LengthEstimate, LocalizedFish
from stream_dmr.recording.messages.record import Record

LENGTHS_COLUMNS = [
    *("track_id", "length_mm", "length_std_mm", "ci95_low_mm", "ci95_high_mm"),
    *("frames_seen", "frames_used", "first_frame", "last_frame", "first_time", "last_time"),
    "status",
]
FRAMES_COLUMNS = [
    *("frame_index", "timestamp_ns", "track_id"),
    *("head_u", "head_v", "center_u", "center_v", "tail_u", "tail_v"),
    *("head_x_mm", "head_y_mm", "head_z_mm"),
    *("center_x_mm", "center_y_mm", "center_z_mm"),
    *("tail_x_mm", "tail_y_mm", "tail_z_mm"),
    *("bending_ratio", "length_mm", "length_std_mm", "iou", "accepted", "reason"),
]
_LARGEST_BYTES = 64 << 20  # of frames.csv, before it is set aside: some hours of two fish


class Tables:
    """Writes each row as soon as it is known.

    A row of frames.csv waits for the running estimate that follows its LocalizedFish, since only
    that says whether the frame was used; a row of lengths.csv comes with the final estimate.
    """

    def __init__(self, out_dir: Path, *, resume: bool = False, is_endless: bool = False) -> None:
        """With `resume`, the rows of an earlier run stay, but for one that a crash left in part.

        Of a run without an end, frames.csv becomes frames-000001.csv and so on where it is large,
        and what the disk refuses is tried again: a file with every row, a row of lengths.csv with
        the next one. A row of frames.csv that it refuses is left out.
        """
        again = {"resume": resume, "retry_open": is_endless}
        self._lengths = CsvFile(out_dir / "lengths.csv", LENGTHS_COLUMNS, **again)
        self._lengths_refused: list[list[str]] = []
        self._is_endless = is_endless
        self._frames = CsvFile(
            out_dir / "frames.csv",
            FRAMES_COLUMNS,
            **again,
            max_bytes=_LARGEST_BYTES if is_endless else None,
        )
        self._waiting: dict[tuple[int, int], LocalizedFish] = {}

    def write(self, record: Record) -> None:
        """Take any record; OutputError where the disk refuses a row."""
        message = record.message
        if isinstance(message, LocalizedFish):
            self._waiting[message.track_id, message.frame_index] = message
        elif isinstance(message, LengthEstimate):
            fish = self._waiting.pop((message.track_id, message.frame_index), None)
            if fish is not None:
                self._frames.add(frames_row(fish, message.is_frame_used, message.frame_reason))
            if message.is_final:
                self._add_length(lengths_row(message))

    def _add_length(self, row: list[str]) -> None:
        self._lengths_refused.append(row)
        try:
            while self._lengths_refused:
                self._lengths.add(self._lengths_refused[0])
                del self._lengths_refused[0]
        except OutputError:
            if not self._is_endless:
                self._lengths_refused.clear()
            raise

    def close(self) -> None:
        """Write the rows that no estimate followed, with their own verdict. Idempotent."""
        try:
            for fish in self._waiting.values():
                self._frames.add(frames_row(fish, fish.accepted, fish.reason))
        finally:
            self._waiting.clear()
            self._frames.close()
            self._lengths.close()


def write_lengths(path: Path, estimates: Iterable[LengthEstimate]) -> None:
    """Write lengths.csv anew, so that at any moment the old or the new one is there whole.

    Raises OutputError where the disk refuses it.
    """
    draft = path.with_suffix(".csv.part")
    try:
        with closing(CsvFile(draft, LENGTHS_COLUMNS)) as table, writing_to(path):
            for estimate in estimates:
                table.add(lengths_row(estimate))
            table.sync()
            rename_durably(draft, path)
    except BaseException:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
        raise


def lengths_row(estimate: LengthEstimate) -> list[str]:
    """The row of a final estimate; times are seconds, exact to the nanosecond."""
    return [
        str(estimate.track_id),
        _number(estimate.length_mm),
        _number(estimate.length_std_mm),
        *_numbers(estimate.ci95_mm, 2),
        str(estimate.frames_seen),
        str(estimate.frames_used),
        str(estimate.first_frame),
        str(estimate.last_frame),
        seconds(estimate.first_timestamp_ns),
        seconds(estimate.last_timestamp_ns),
        estimate.status,
    ]


def frames_row(fish: LocalizedFish, accepted: bool, reason: str) -> list[str]:
    """The row of one fish in one frame, with the verdict on it."""
    return [
        str(fish.frame_index),
        str(fish.timestamp_ns),
        str(fish.track_id),
        *_numbers(fish.keypoints_px, 6),
        *_numbers(fish.keypoints_mm, 9),
        _number(fish.bending_ratio),
        _number(fish.length_mm),
        _number(fish.length_std_mm),
        _number(fish.iou),
        "true" if accepted else "false",
        reason,
    ]


def seconds(timestamp_ns: int) -> str:
    """Nanoseconds as seconds with nine decimals, by integers only."""
    sign = "-" if timestamp_ns < 0 else ""
    whole, rest = divmod(abs(timestamp_ns), 1_000_000_000)
    return f"{sign}{whole}.{rest:09d}"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.6f}"


def _numbers(values: Float[np.ndarray, "..."] | None, count: int) -> list[str]:
    return [""] * count if values is None else [_number(float(value)) for value in values.flat]
