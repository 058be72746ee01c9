"""Who is who from frame to frame: each fish keeps its id through gaps and crossings.

A constant-velocity Kalman filter per fish and the cheapest assignment of all fish to all
candidates, as in Bewley et al. ("Simple online and realtime tracking", ICIP 2016). Where two fish
meet their boxes say little, so size and colour weigh as well, and a candidate that swallows two
fish is neither of them; who is who when they part is settled by `memory`. filterpy and SciPy do the
work: the tracking libraries that allow this use either bring a second OpenCV (`trackers`), forbid
today's NumPy (`norfair`) or know boxes alone.
"""

from collections.abc import Sequence

import numpy as np
from pydantic import Field
from scipy.optimize import linear_sum_assignment

from stream_dmr.messages import Frame
from stream_dmr.segmentation.detection.detector import Candidate
from stream_dmr.segmentation.tracking.occlusion import who_is_who
from stream_dmr.segmentation.tracking.split_blobs import part
from stream_dmr.segmentation.tracking.track import NEVER, Look, Sighting, Track
from stream_dmr.settings import Settings

_SWALLOWED = 0.55  # of a fish's expected box inside a candidate
_SWOLLEN = 1.3  # times the larger of two fish: a candidate that is both
_BESIDE = 0.3  # of a candidate inside a followed fish's box: a part of it, no new fish
_COVERED_FRAMES = 30  # that another fish may hide one
_KNOWN = 8  # frames after which a fish is known well enough to be known again


class TrackerSettings(Settings):
    """The part of `[track_fish]` that says how fish are followed from frame to frame."""

    max_lost_frames: int = Field(
        default=7, ge=0, description="a fish unseen for more frames in a row is gone"
    )
    max_hidden_frames: int = Field(
        default=0,
        ge=0,
        description="a fish lost in the open is known again within so many frames; 0 at a rail, "
        "where the next fish soon hangs in its place",
    )
    min_score: float = Field(
        default=0.3, ge=0, le=1, description="least score of a detector's candidate that counts"
    )


class Tracker:
    """Follows every candidate; which of the tracks are fish is for others to say."""

    def __init__(self, settings: TrackerSettings) -> None:
        self._settings = settings
        self._tracks: list[Track] = []
        self._hidden: list[Track] = []  # lost for longer, but perhaps behind something
        self._started = 0

    def step(self, frame: Frame, candidates: Sequence[Candidate]) -> list[Sighting]:
        """The tracks seen in a frame, by number. Frames must come in order; some may be missing."""
        looks = [Look(frame.image, c) for c in candidates if c.score >= self._settings.min_score]
        for track in (*self._tracks, *self._hidden):
            track.predict(frame.frame_index)
        looks = [piece for look in looks for piece in self._part(frame, look)]
        swallowed = self._swallowed(looks)
        looks = [look for i, look in enumerate(looks) if i not in swallowed]
        free = self._assign(looks)
        self._hide(looks)
        self._drop_lost(frame)
        free = self._recognise(free)
        seen = [track for track in self._tracks if track.lost_frames == 0]
        for look in free:
            is_beside = not any(look.share_in(track.look.box) > _BESIDE for track in seen)
            if look.is_piece or is_beside:
                self._started += 1
                self._tracks.append(Track(look, self._started, frame.frame_index))
        return [t.sighting() for t in self._tracks if t.lost_frames == 0 and t.was_alone]

    def _part(self, frame: Frame, look: Look) -> list[Look]:
        """A candidate, or its pieces where several fish share it."""
        inside = [t for t in self._tracks if t.may_hide and t.share_in(look.box) > _SWALLOWED]
        largest = max((track.area for track in inside), default=np.inf)
        if look.area < _SWOLLEN * largest or any(t.look.touches_border for t in inside):
            return [look]
        expected = [track.expected() for track in inside]
        pieces = part(look.candidate, [one for one in expected if one is not None])
        if len(pieces) < 2:
            return [look]
        return [Look(frame.image, piece, whole=look.candidate) for piece in pieces]

    def _swallowed(self, looks: Sequence[Look]) -> set[int]:
        """The candidates that are several fish at once; those fish wait until they part."""
        found = set()
        for i, look in enumerate(looks):
            inside = [t for t in self._tracks if t.may_hide and t.share_in(look.box) > _SWALLOWED]
            largest = max((track.area for track in inside), default=0.0)
            if len(inside) > 1 and look.area > _SWOLLEN * largest:
                found.add(i)
                for track in inside:
                    track.wait(look)
        return found

    def _hide(self, looks: Sequence[Look]) -> None:
        """Let fish wait that should be where another one has just been seen: they are behind it."""
        for track in self._tracks:
            if track.lost_frames > 0 and track.may_hide:
                for look in looks:
                    if track.share_in(look.box) > _SWALLOWED:
                        track.wait(look)
                        break

    def _assign(self, looks: Sequence[Look]) -> list[Look]:
        """Give each track its candidate; the candidates left over are returned."""
        if not self._tracks or not looks:
            return list(looks)
        costs = np.array([[track.cost(look) for look in looks] for track in self._tracks])
        taken = set()
        for row, column in zip(*linear_sum_assignment(costs), strict=True):
            if costs[row, column] < NEVER:
                self._tracks[row].update(looks[column])
                taken.add(column)
        return [look for i, look in enumerate(looks) if i not in taken]

    def _drop_lost(self, frame: Frame) -> None:
        height, width = frame.image.shape[:2]
        tracks = [track for track in self._tracks if track.is_inside(width, height)]
        most = self._settings.max_lost_frames
        self._tracks = [track for track in tracks if track.lost_frames <= most]
        gone = [track for track in tracks if track.lost_frames > most]
        self._hidden = [
            track
            for track in (*self._hidden, *gone)
            if track.lost_frames - 1 <= self._most_hidden_frames(track)  # it may be seen yet
            and track.frames_seen >= _KNOWN
            and not track.look.touches_border
        ]

    def _most_hidden_frames(self, track: Track) -> int:
        is_covered = track.memory is not None and track.memory.is_covered
        return max(self._settings.max_hidden_frames, _COVERED_FRAMES if is_covered else 0)

    def _recognise(self, free: Sequence[Look]) -> list[Look]:
        """Say who is who among fish that were one, or were lost; the looks of others remain."""
        for track in self._tracks:
            if track.frames_seen >= _KNOWN and (track.lost_frames > 0 or track.look.is_piece):
                track.remember()
        unsure = [t for t in (*self._tracks, *self._hidden) if t.memory is not None]
        young = [t for t in self._tracks if t.frames_seen < _KNOWN and t.lost_frames == 0]
        new = [*free, *(track.look for track in young)]
        new = [look for look in new if not look.is_piece and not look.touches_border]
        taken = self._identify(unsure, new)
        self._tracks = [t for t in self._tracks if t not in young or t.look not in taken]
        self._tracks += [track for track in self._hidden if track.lost_frames == 0]
        self._hidden = [track for track in self._hidden if track.lost_frames > 0]
        self._settle(unsure)
        return [look for look in free if look not in taken]

    def _identify(self, unsure: Sequence[Track], new: Sequence[Look]) -> list[Look]:
        """Give their looks and new ones to the fish that they are likeliest; returns those given.

        A track goes on as another fish where that is so; the numbers wander, not the tracks.
        """
        owners = [t for t in unsure if t.lost_frames == 0 and not t.look.is_piece]
        if not unsure or not (owners or new):
            return []
        looks = [*(track.look for track in owners), *new]
        fish = [(track.number, track.remember()) for track in unsure]
        owned = [unsure.index(track) for track in owners]
        who = who_is_who([memory for _, memory in fish], owned, looks)
        tracks = {row: owners[column] for column, row in who.items() if column < len(owners)}
        spare = [track for track in unsure if track not in tracks.values()]
        rows = [row for row in range(len(unsure)) if row not in tracks]
        for row in sorted(rows, key=lambda row: unsure[row] not in spare):  # first those that stay
            tracks[row] = unsure[row] if unsure[row] in spare else spare[0]
            spare.remove(tracks[row])
        for row, track in tracks.items():
            track.become(*fish[row])
        given = {column: row for column, row in who.items() if column >= len(owners)}
        for column, row in given.items():
            tracks[row].resume(looks[column])
        return [looks[column] for column in given]

    def _settle(self, unsure: Sequence[Track]) -> None:
        """Who is alone is sure again; the others are in what hides them, wherever it moves."""
        seen = [track for track in unsure if track.lost_frames == 0]
        for track in unsure:
            boxes = [one.look.outer_box for one in (seen if track.lost_frames else [track])]
            track.remember().stay_inside_one_of(boxes)
        lost = [track.remember() for track in unsure if track.lost_frames > 0]
        for track in seen:
            if track.is_sure and not any(one.is_inside(track.look.box) for one in lost):
                track.settle()
