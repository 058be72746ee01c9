"""Reads each fish of a recording: all of its frames, and its best views in full."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import NamedTuple

from stream_dmr.lengths.kalman import SmoothLengthSettings
from stream_dmr.messages import FishCrop, FittedMesh, LengthEstimate, LocalizedFish
from stream_dmr.recording.messages.codec import decode
from stream_dmr.recording.messages.selection import EVERYTHING, Selection
from stream_dmr.recording.reading.open_recording import Recording, decoded_messages
from stream_dmr.recording.view.mesh_rebuilder import MeshRebuilder
from stream_dmr.results.edited_lengths import length_of_frames
from stream_dmr.results.track_edits import TrackEdits
from stream_dmr.results.verdicts_table import AddedFrame

_Key = tuple[int, int]  # frame index, track id


@dataclass(frozen=True, kw_only=True)
class ReviewedTracks:
    """What reviewers changed of the tracks."""

    edits: TrackEdits
    added: Mapping[int, Sequence[AddedFrame]]  # by track id
    settings: SmoothLengthSettings  # of the run


@dataclass(frozen=True, kw_only=True)
class FishFrame:
    """One fish in one frame: its own length, and the running estimate after it."""

    fish: LocalizedFish
    estimate: LengthEstimate


class Encoded(NamedTuple):
    """What a recording holds of one fish in one frame, encoded; None: nothing."""

    crop: bytes | None
    fit: bytes | None
    has_picture: bool  # of the crop


@dataclass(frozen=True, kw_only=True)
class RecordedView:
    """One fish in one frame with its crop and fit, encoded: a season of masks fills no memory."""

    crop: bytes
    fit: bytes
    row: FishFrame
    has_picture: bool  # of the crop

    @property
    def rank(self) -> tuple[bool, bool, float]:
        """For sorting; the best view is the largest.

        Used frames come first, then those that the recording has a picture of, then by their IoU.
        """
        return self.row.estimate.is_frame_used, self.has_picture, self.row.fish.iou or 0.0

    def decode(self, meshes: MeshRebuilder) -> tuple[FishCrop, FittedMesh]:
        """Crop and fit, the fit with its vertices."""
        return decode(FishCrop, self.crop), meshes.with_vertices(decode(FittedMesh, self.fit))


@dataclass(kw_only=True)
class RecordedTrack:
    """All frames of one fish, and its best views."""

    rows: list[FishFrame] = field(default_factory=list[FishFrame])
    views: list[RecordedView] = field(default_factory=list[RecordedView])  # the best first

    def add(self, row: FishFrame, encoded: Encoded, *, max_views: int) -> None:
        """Add a frame; keep its crop and fit if it is among the `max_views` best so far."""
        self.rows.append(row)
        crop, fit, has_picture = encoded
        if crop is None or fit is None or row.fish.keypoints_px is None:
            return
        self.views.append(RecordedView(crop=crop, fit=fit, row=row, has_picture=has_picture))
        self.views.sort(key=lambda view: view.rank, reverse=True)
        del self.views[max_views:]

    def filter_again(self, settings: SmoothLengthSettings) -> None:
        """Compute the running estimates from the frames in their order."""
        fish = sorted((row.fish for row in self.rows), key=lambda one: one.frame_index)
        running = length_of_frames(fish, settings)[:-1]
        self.rows = [FishFrame(fish=f, estimate=e) for f, e in zip(fish, running, strict=True)]


def read_tracks(
    recording: Recording,
    *,
    selection: Selection = EVERYTHING,
    max_views: int = 3,
    reviewed: ReviewedTracks | None = None,
) -> dict[int, RecordedTrack]:
    """Every fish of a recording with its `max_views` best views. Raises RecordingError.

    Without `reviewed` fish are the recorded tracks.
    """
    tracks: dict[int, RecordedTrack] = {}
    added = () if reviewed is None else _added_rows(reviewed, selection)
    for row, encoded in chain(_read_rows(recording, selection), added):
        fish = row.fish
        if reviewed is not None:
            fish_id = reviewed.edits.fish_of(fish.track_id, fish.frame_index)
            row = replace(row, fish=replace(fish, track_id=fish_id))
        track = tracks.setdefault(row.fish.track_id, RecordedTrack())
        track.add(row, encoded, max_views=max_views)
    if reviewed is not None:
        for fish_id in tracks.keys() & reviewed.edits.fish.keys():
            tracks[fish_id].filter_again(reviewed.settings)
    return tracks


def _added_rows(
    reviewed: ReviewedTracks, selection: Selection
) -> Iterator[tuple[FishFrame, Encoded]]:
    """The frames of added fish, each with the running estimate of its fish."""
    for track_id, frames in reviewed.added.items():
        if selection.tracks is not None and track_id not in selection.tracks:
            continue
        fish = [decode(LocalizedFish, frame.fish) for frame in frames]
        running = length_of_frames(fish, reviewed.settings)[:-1]
        for frame, one, estimate in zip(frames, fish, running, strict=True):
            encoded = Encoded(frame.crop, frame.fit, has_picture=False)
            yield FishFrame(fish=one, estimate=estimate), encoded


def _read_rows(recording: Recording, selection: Selection) -> Iterator[tuple[FishFrame, Encoded]]:
    """Each fish in each frame, with the encodings of its crop and its fit."""
    crops, fits = dict[_Key, tuple[bytes, bool]](), dict[_Key, bytes]()
    located = dict[_Key, LocalizedFish]()
    kinds = (FishCrop, FittedMesh, LocalizedFish, LengthEstimate)
    for message, payload in decoded_messages(recording, kinds, selection):
        key = message.frame_index, getattr(message, "track_id", 0)
        match message:
            case FishCrop():
                crops[key] = payload, message.image is not None
            case FittedMesh():
                fits[key] = payload
            case LocalizedFish():
                located[key] = message
            case LengthEstimate() if (fish := located.pop(key, None)) is not None:
                row = FishFrame(fish=fish, estimate=message)
                crop, has_picture = crops.pop(key, (None, False))
                yield row, Encoded(crop, fits.pop(key, None), has_picture)
            case _:
                pass
