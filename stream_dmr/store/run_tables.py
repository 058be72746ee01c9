"""Write lengths.csv and frames.csv."""

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stream_dmr.errors import OutputError
from stream_dmr.files import replacing
from stream_dmr.messages import LengthEstimate, LocalizedFish
from stream_dmr.recording.record import Record
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.schema import flags_in_status
from stream_dmr.tables import CsvFile, cells, column_kinds, seconds


@dataclass(frozen=True, kw_only=True, slots=True)
class FishRow:
    """One fish: a row of lengths.csv. `pandas.DataFrame(run.fish)` makes a table of many.

    The fields are the columns, in their order; the comments stand in docs/files.md.
    """

    track_id: int  # number of the fish, never used twice
    length_mm: float | None  # snout to tail keypoint along the body; empty where `status` says why
    length_std_mm: float | None  # its standard deviation
    ci95_low_mm: float | None  # its 95 % interval
    ci95_high_mm: float | None
    frames_seen: int  # frames with this fish; those that counted
    frames_used: int
    first_frame: int  # of the fish
    last_frame: int
    first_time: float  # capture times, s (cameras: since 1970), exact to the nanosecond
    last_time: float
    # `measured`, or [why there is no length](troubleshooting.md#reasons); with `; may count twice`
    # for a fish that was in view at a crash, `; cut off` at a stop or at damage of the source,
    # `; blurred` for one whose ends are, as by a long exposure
    status: str


LENGTHS_COLUMNS = list(column_kinds(FishRow))


class LengthsTable:
    """lengths.csv of a run in progress.

    It begins (with `resume`) and ends as a whole export of the store, so that no crash loses a row
    of either; meanwhile each finished fish is appended.
    """

    def __init__(
        self,
        out_dir: Path,
        store: LengthStore,
        *,
        resume: bool = False,
        on_refusal: Callable[[str], None] | None = None,
    ) -> None:
        """Raises OutputError if the disk refuses the table.

        With `on_refusal`, this gets the reason instead, here and later: a refused row is tried
        again with the next row, and the whole table at the end and by the next run.
        """
        self._path, self._store, self._on_refusal = out_dir / "lengths.csv", store, on_refusal
        self.trouble = ""  # why the last row could not be written; "" when all are
        self._waiting: deque[LengthEstimate] = deque()
        if resume:
            self._export()
        self._rows = CsvFile(
            self._path, LENGTHS_COLUMNS, resume=resume, retry_open=on_refusal is not None
        )

    def add(self, estimate: LengthEstimate) -> None:
        self._waiting.append(estimate)
        try:
            while self._waiting:
                estimate = self._waiting[0]
                flags = self._store.flags_of(estimate.track_id)
                self._rows.add(lengths_row(estimate, flags))
                self._waiting.popleft()
            self.trouble = ""
        except OutputError as error:
            self._refuse(error)

    def close(self) -> None:
        """Write the whole table from the store. Idempotent."""
        self._rows.close()
        self._export()

    def _export(self) -> None:
        # Its file lacks fish, which the next run exports, or is elsewhere.
        if self._store.trouble or self._store.lost:
            return
        try:
            write_lengths(self._path, self._store.estimates(), self._store.flags())
        except OutputError as error:
            self._refuse(error)

    def _refuse(self, error: OutputError) -> None:
        if self._on_refusal is None:
            raise error
        self.trouble = str(error)
        self._on_refusal(str(error))


def write_lengths(
    path: Path, estimates: Iterable[LengthEstimate], flags: Mapping[int, Sequence[str]]
) -> None:
    """Replace lengths.csv in one step.

    `flags`: of the fish that have some, by track id. Raises OutputError if the disk refuses it.
    """
    with replacing(path) as draft, closing(CsvFile(draft, LENGTHS_COLUMNS)) as table:
        for estimate in estimates:
            table.add(lengths_row(estimate, flags.get(estimate.track_id, ())))
        table.sync()


def lengths_row(estimate: LengthEstimate, flags: Sequence[str] = ()) -> list[str]:
    """The cells of a final estimate; times in seconds, exact to the nanosecond."""
    low, high = (None, None) if estimate.ci95_mm is None else estimate.ci95_mm.tolist()
    return cells(
        FishRow,
        estimate,
        ci95_low_mm=low,
        ci95_high_mm=high,
        first_time=seconds(estimate.first_timestamp_ns),
        last_time=seconds(estimate.last_timestamp_ns),
        status=f"{estimate.status}{flags_in_status(flags)}",
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameRow:
    """One fish in one frame: a row of frames.csv. None where there is no value."""

    frame_index: int  # the frame; its capture time
    timestamp_ns: int
    track_id: int  # the fish
    head_u: float | None  # keypoints in the frame, px
    head_v: float | None
    center_u: float | None
    center_v: float | None
    tail_u: float | None
    tail_v: float | None
    head_x_mm: float | None  # the same in the camera frame (x right, y down, z forward)
    head_y_mm: float | None
    head_z_mm: float | None
    center_x_mm: float | None
    center_y_mm: float | None
    center_z_mm: float | None
    tail_x_mm: float | None
    tail_y_mm: float | None
    tail_z_mm: float | None
    # length along the body over the straight distance from head to tail
    bending_ratio: float | None
    # what this frame says of the length, and its std without what all frames of the fish share:
    # its shape, its distance from the plane
    length_mm: float | None
    length_std_mm: float | None
    iou: float | None  # overlap of the fitted mesh with the mask, 0 to 1
    # `true` if it counted when it was measured; by all frames of the fish an `outlier` may count
    accepted: bool
    reason: str  # [why it did not](troubleshooting.md#reasons)


FRAMES_COLUMNS = list(column_kinds(FrameRow))
_POINTS = ("head", "center", "tail")
_POINTS_PX = [f"{point}_{axis}" for point in _POINTS for axis in "uv"]
_POINTS_MM = [f"{point}_{axis}_mm" for point in _POINTS for axis in "xyz"]
_MAX_BYTES = 64 << 20  # of one file of an endless run: some hours of two fish


class FramesTable:
    """Writes frames.csv; a sink of the recorder.

    A row waits for the running LengthEstimate that follows its LocalizedFish, which alone contains
    whether the frame was used.
    """

    name = "frames.csv"

    def __init__(
        self,
        out_dir: Path,
        *,
        resume: bool = False,
        is_endless: bool = False,
        on_closed: Callable[[Path], None] = lambda path: None,
    ) -> None:
        """With `resume`, the whole rows of an earlier run stay.

        In an endless run a large table is renamed frames-000001.csv and so on, and `on_closed` gets
        its name; a file that the disk refuses is opened with a later row, and the rows refused
        meanwhile are only in the recording.
        """
        self._table = CsvFile(
            out_dir / self.name,
            FRAMES_COLUMNS,
            resume=resume,
            retry_open=is_endless,
            max_bytes=_MAX_BYTES if is_endless else None,
            on_renamed=on_closed,
        )
        self._waiting: dict[tuple[int, int], LocalizedFish] = {}  # by track and frame

    def write(self, record: Record) -> None:
        """Take any record; raises OutputError if the disk refuses a row, or the file is lost."""
        message = record.message
        if isinstance(message, LocalizedFish) and not record.is_second:
            self._waiting[message.track_id, message.frame_index] = message
        elif isinstance(message, LengthEstimate):
            fish = self._waiting.pop((message.track_id, message.frame_index), None)
            if fish is not None:
                self._table.add(frames_row(fish, message.is_frame_used, message.frame_reason))
                return
        self._table.require_name()  # else it would pass for a written row

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
    points = _named(_POINTS_PX, fish.keypoints_px) | _named(_POINTS_MM, fish.keypoints_mm)
    return cells(FrameRow, fish, **points, accepted=accepted, reason=reason)


def _named(names: Sequence[str], values: np.ndarray | None) -> dict[str, float | None]:
    if values is None:
        return dict.fromkeys(names)
    return dict(zip(names, values.ravel().tolist(), strict=True))
