"""What a report shows of each fish: every frame in a row, and the best frames whole."""

from collections.abc import Iterator
from dataclasses import dataclass, field

from stream_dmr.messages import FishCrop, FittedMesh, LengthEstimate, LocalizedFish
from stream_dmr.recording.messages.codec import decode
from stream_dmr.recording.messages.selection import EVERYTHING, Selection
from stream_dmr.recording.reading.open_recording import Recording, decoded_messages
from stream_dmr.recording.view.mesh_rebuilder import MeshRebuilder

Key = tuple[int, int]  # frame index, track id


@dataclass(frozen=True, kw_only=True)
class FrameRow:
    """One fish in one frame: its own length, and the running estimate after it."""

    fish: LocalizedFish
    estimate: LengthEstimate


@dataclass(frozen=True, kw_only=True)
class View:
    """One good look at a fish, as it was recorded: a season of masks would not fit in memory."""

    crop: bytes
    fit: bytes
    row: FrameRow

    @property
    def rank(self) -> tuple[bool, float]:
        """Better views are larger: used ones first, then those that the mesh fits best."""
        return self.row.estimate.is_frame_used, self.row.fish.iou or 0.0

    def decoded(self, meshes: MeshRebuilder) -> tuple[FishCrop, FittedMesh]:
        """Crop and fit, the fit with its vertices."""
        return decode(FishCrop, self.crop), meshes.with_vertices(decode(FittedMesh, self.fit))


@dataclass(kw_only=True)
class Track:
    """All of one fish."""

    rows: list[FrameRow] = field(default_factory=list)
    views: list[View] = field(default_factory=list)  # the best first

    def take(self, row: FrameRow, crop: bytes | None, fit: bytes | None, *, keep: int) -> None:
        """Add a frame, and keep it whole if it is one of the `keep` best so far."""
        self.rows.append(row)
        if crop is None or fit is None or row.fish.keypoints_px is None:
            return
        self.views.append(View(crop=crop, fit=fit, row=row))
        self.views.sort(key=lambda view: view.rank, reverse=True)
        del self.views[keep:]


def gather(
    recording: Recording, *, selection: Selection = EVERYTHING, keep: int = 3
) -> dict[int, Track]:
    """Every track of a recording with its `keep` best views. Raises RecordingError."""
    tracks: dict[int, Track] = {}
    for row, crop, fit in _rows(recording, selection):
        tracks.setdefault(row.fish.track_id, Track()).take(row, crop, fit, keep=keep)
    return tracks


def _rows(
    recording: Recording, selection: Selection
) -> Iterator[tuple[FrameRow, bytes | None, bytes | None]]:
    """Each fish in each frame, with the encodings of its crop and its fit."""
    crops, fits = dict[Key, bytes](), dict[Key, bytes]()
    located = dict[Key, LocalizedFish]()
    for message, payload in decoded_messages(
        recording, (FishCrop, FittedMesh, *_LENGTHS), selection
    ):
        key = message.frame_index, getattr(message, "track_id", 0)
        match message:
            case FishCrop():
                crops[key] = payload
            case FittedMesh():
                fits[key] = payload
            case LocalizedFish():
                located[key] = message
            case LengthEstimate() if (fish := located.pop(key, None)) is not None:
                yield (
                    FrameRow(fish=fish, estimate=message),
                    crops.pop(key, None),
                    fits.pop(key, None),
                )
            case _:
                pass


_LENGTHS = (LocalizedFish, LengthEstimate)
