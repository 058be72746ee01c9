"""frames.csv: one row a fish and frame."""

from pathlib import Path

from stream_dmr.csv_file import CsvFile
from stream_dmr.messages import LengthEstimate, LocalizedFish
from stream_dmr.recording.messages.record import Record
from stream_dmr.results.table_cells import number, numbers

FRAMES_COLUMNS = [
    *("frame_index", "timestamp_ns", "track_id"),
    *("head_u", "head_v", "center_u", "center_v", "tail_u", "tail_v"),
    *("head_x_mm", "head_y_mm", "head_z_mm"),
    *("center_x_mm", "center_y_mm", "center_z_mm"),
    *("tail_x_mm", "tail_y_mm", "tail_z_mm"),
    *("bending_ratio", "length_mm", "length_std_mm", "iou", "accepted", "reason"),
]
_MAX_BYTES = 64 << 20  # of one file of an endless run: some hours of two fish


class FramesTable:
    """Writes frames.csv; a sink of the recorder.

    A row waits for the running LengthEstimate that follows its LocalizedFish, since only that says
    whether the frame was used.
    """

    name = "frames.csv"

    def __init__(self, out_dir: Path, *, resume: bool = False, is_endless: bool = False) -> None:
        """With `resume`, the whole rows of an earlier run stay.

        In an endless run a large table is renamed frames-000001.csv and so on, and a file that the
        disk refuses is opened with a later row; the rows refused meanwhile are lost here, and are
        in the recording.
        """
        self._table = CsvFile(
            out_dir / self.name,
            FRAMES_COLUMNS,
            resume=resume,
            retry_open=is_endless,
            max_bytes=_MAX_BYTES if is_endless else None,
        )
        self._waiting: dict[tuple[int, int], LocalizedFish] = {}  # by track and frame

    def write(self, record: Record) -> None:
        """Take any record; raises OutputError where the disk refuses a row."""
        message = record.message
        if isinstance(message, LocalizedFish):
            self._waiting[message.track_id, message.frame_index] = message
        elif isinstance(message, LengthEstimate):
            fish = self._waiting.pop((message.track_id, message.frame_index), None)
            if fish is not None:
                self._table.add(frames_row(fish, message.is_frame_used, message.frame_reason))

    def close(self) -> None:
        """Write the rows that no estimate followed, with the localization's verdict. Idempotent."""
        try:
            for fish in self._waiting.values():
                self._table.add(frames_row(fish, fish.accepted, fish.reason))
        finally:
            self._waiting.clear()
            self._table.close()


def frames_row(fish: LocalizedFish, accepted: bool, reason: str) -> list[str]:
    """The cells of one fish in one frame, with the final verdict on the frame."""
    return [
        str(fish.frame_index),
        str(fish.timestamp_ns),
        str(fish.track_id),
        *numbers(fish.keypoints_px, 6),
        *numbers(fish.keypoints_mm, 9),
        number(fish.bending_ratio),
        number(fish.length_mm),
        number(fish.length_std_mm),
        number(fish.iou),
        "true" if accepted else "false",
        reason,
    ]
