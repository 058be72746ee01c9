"""lengths.csv and frames.csv: the results for people and spreadsheets.

Values are rounded to six decimals, far below what is measured; blank means there is none.
"""

import csv
import io
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from stream_dmr.errors import OutputError
from stream_dmr.messages import LengthEstimate, LocalizedFish
from stream_dmr.recording.record import Record
from stream_dmr.recording.whole_file import WholeFile, rename_durably

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
_BLOCK_BYTES = 1 << 16


class Tables:
    """Writes each row as soon as it is known.

    A row of frames.csv waits for the running estimate that follows its LocalizedFish, since only
    that says whether the frame was used; a row of lengths.csv comes with the final estimate.
    """

    def __init__(self, out_dir: Path, *, resume: bool = False) -> None:
        """With `resume`, the rows of an earlier run stay, but for one that a crash left in part."""
        self._lengths = _Table(out_dir / "lengths.csv", LENGTHS_COLUMNS, resume=resume)
        self._frames = _Table(out_dir / "frames.csv", FRAMES_COLUMNS, resume=resume)
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
                self._lengths.add(lengths_row(message))

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
    table = _Table(draft, LENGTHS_COLUMNS)
    try:
        for estimate in estimates:
            table.add(lengths_row(estimate))
        table.sync()
        rename_durably(draft, path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    finally:
        table.close()


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


def _whole_lines(path: Path) -> int:
    """The bytes of a file up to the end of its last whole line."""
    with path.open("rb") as file:
        end = file.seek(0, os.SEEK_END)
        while end > 0:
            start = max(0, end - _BLOCK_BYTES)
            file.seek(start)
            newline = file.read(end - start).rfind(b"\n")
            if newline >= 0:
                return start + newline + 1
            end = start
    return 0


class _Table:
    """A CSV file with its header from the start, in which every row is whole."""

    def __init__(self, path: Path, columns: list[str], *, resume: bool = False) -> None:
        self._path = path
        try:
            keep = _whole_lines(path) if resume and path.exists() else 0
            self._file = WholeFile(path, keep=keep)
        except OSError as error:
            raise self._refusal(error) from error
        if keep == 0:
            self.add(columns)

    def add(self, row: list[str]) -> None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerow(row)
        try:
            self._file.write(text.getvalue().encode("utf-8", "backslashreplace"))
        except OSError as error:
            raise self._refusal(error) from error

    def sync(self) -> None:
        self._file.sync()

    def close(self) -> None:
        self._file.close()

    def _refusal(self, error: OSError) -> OutputError:
        return OutputError(
            f"{self._path}: expected a file to write to, got: {error.strerror}; "
            "make room or choose another --out"
        )
