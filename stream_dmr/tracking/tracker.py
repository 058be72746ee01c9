"""Multi-object tracking: each fish keeps its number through gaps, merged blobs and crossings.

A constant-velocity Kalman filter per fish and the cheapest assignment of fish to candidates, after
Bewley et al., "Simple online and realtime tracking", ICIP 2016. If fish meet, their boxes say
little, so area and colour weigh as well; a blob that contains several fish is split by
`split_blobs` or assigned to none of them, and `occlusion` settles their identities afterwards.

A fish has three numbers on its way. A detection's `source_id` comes from its annotation file or
from its track in the tracker, and stays inside of segmentation. `TrackNumbering` turns it into the
`track_id` of the FishCrop, once; all later messages, tables, databases and recordings have that.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from pydantic import Field
from scipy.optimize import linear_sum_assignment

from stream_dmr.detection.detector import Candidate
from stream_dmr.messages import Frame
from stream_dmr.settings import Settings
from stream_dmr.tracking.observation import Observation
from stream_dmr.tracking.occlusion import IMPOSSIBLE, reidentify
from stream_dmr.tracking.split_blobs import split_merged_blob
from stream_dmr.tracking.track import Track, TrackedCandidate

# Chosen on simulated scenes and crossings by IDF1 and fish counted; see docs/research/tracking.md.
_MIN_MERGED_FRACTION = 0.55  # of a fish's predicted box inside a candidate that contains the fish
_MIN_MERGED_AREA_RATIO = 1.3  # of a merged blob over the largest fish in it
_MAX_OVERLAP_OF_NEW = 0.3  # of a new candidate inside a followed fish's box; above, it is a part
_MAX_COVERED_FRAMES = 30  # that a fish may be hidden by another fish
_MIN_KNOWN_FRAMES = 8  # frames seen before a fish can be re-identified
_KNOWN_STEPS = 31  # frames whose median step is the usual one
_MAX_STEPS = 60  # that count, where a broken file's times are none
_LEAST_STEP_NS = 100_000  # a shorter one is no step: times that repeat are 1 ns later. Chosen
# Sizes within which a fish is seen again where it should be after a gap, or as if there were none.
_NEAR, _NEAR_NEXT = 0.4, 0.2  # chosen on simulated rails, see docs/research/tracking.md
_MIN_PAUSE_NS = 2_000_000_000  # chosen: by then another fish may hang in a fish's place
# An exposure that changes at once changes all colours: the light in which they are compared follows
# within some thirty frames. A few grey levels of dark water are noise, and say nothing of fish in a
# lamp's light. Chosen.
_LIGHT_RATE, _LEAST_CHANGE, _LEAST_LEVELS, _LIGHT_STEP_PX = 0.04, 0.04, 4, 16
_MIN_FRAMES_BESIDE = 3  # in which a newcomer and a fish were seen at once: they are two


class TrackerSettings(Settings):
    """The part of `[track_fish]` about following fish from frame to frame."""

    max_lost_frames: int = Field(
        default=7, ge=0, description="a fish unseen for more consecutive frames is gone"
    )
    max_hidden_frames: int = Field(
        default=0,
        ge=0,
        description="a fish lost in the open is re-identified within so many frames; 0 at a rail, "
        "where the next fish soon hangs in its place",
    )
    across_frames: bool = Field(
        default=True, description="false: each picture stands for itself, as with --stills"
    )
    min_score: float = Field(
        default=0.3, ge=0, le=1, description="least score of a detector's candidate that counts"
    )


class Tracker:
    """Follows every candidate; `confirmation` decides which tracks are fish."""

    def __init__(self, settings: TrackerSettings) -> None:
        self._settings = settings
        self._tracks: list[Track] = []
        self._hidden: list[Track] = []  # lost for longer, but may come out from behind something
        self._num_started = 0
        self._light = 0.0  # median grey level + 1 of late; 0: unknown
        self._last_ns: int | None = None  # capture time of the last frame
        self._steps_ns: deque[int] = deque(maxlen=_KNOWN_STEPS)  # from one to the next of late
        self._now = 0  # usual steps that passed; all counts of frames are of these

    @property
    def is_following(self) -> bool:
        """True while anything is seen, or was seen often enough that it may come again."""
        return any(track.lost_frames == 0 or track.may_be_hidden for track in self._tracks)

    @property
    def open_numbers(self) -> set[int]:
        """The numbers of the tracks that a later frame may show."""
        return {track.number for track in (*self._tracks, *self._hidden)}

    def forget_tracks(self) -> None:
        """End all tracks; their numbers are not used again."""
        self._tracks, self._hidden = [], []

    def step(self, frame: Frame, candidates: Sequence[Candidate]) -> list[TrackedCandidate]:
        """The tracks seen in a frame. Frames must come in order; some may be missing."""
        if self._settings.across_frames:
            frame = self._in_steady_light(frame)
        observations = [
            Observation(frame.image, candidate)
            for candidate in candidates
            if candidate.score >= self._settings.min_score
        ]
        if not self._advance(frame.timestamp_ns, observations) or not self._settings.across_frames:
            self.forget_tracks()
        for track in (*self._tracks, *self._hidden):
            track.predict(self._now)
        observations = [piece for blob in observations for piece in self._split(frame, blob)]
        observations = self._without_merged(observations)
        unassigned = self._assign(observations)
        self._keep_covered(observations)
        self._drop_lost(frame)
        self._start_tracks(self._reidentify(unassigned))
        seen = [track.number for track in self._tracks if track.lost_frames == 0]
        for track in self._tracks:
            is_newcomer = track.began_as_piece and track.frames_seen < _MIN_KNOWN_FRAMES
            if is_newcomer and track.lost_frames == 0:
                track.frames_beside.update(seen)
        return [
            t.tracked_candidate() for t in self._tracks if t.lost_frames == 0 and t.was_separate
        ]

    def _in_steady_light(self, frame: Frame) -> Frame:
        """The frame in the light of those before it."""
        light = 1.0 + float(np.median(frame.image[::_LIGHT_STEP_PX, ::_LIGHT_STEP_PX, 1]))
        self._light += _LIGHT_RATE * (light - self._light) if self._light else light
        gain = self._light / light
        if abs(gain - 1) < _LEAST_CHANGE or abs(self._light - light) < _LEAST_LEVELS:
            return frame
        return replace(frame, image=cv2.convertScaleAbs(frame.image, alpha=gain))

    def _advance(self, timestamp_ns: int, observations: Sequence[Observation]) -> bool:
        """Go on to a frame's time; False after a pause, as of a camera that films what moves.

        Pictures that a camera or a network lost leave a gap in the times, not in the indices.
        """
        last_ns, self._last_ns = self._last_ns, timestamp_ns
        if last_ns is None:
            return True
        step_ns = timestamp_ns - last_ns
        before_ns = self._steps_ns[-1] if self._steps_ns else step_ns
        if step_ns >= _LEAST_STEP_NS:
            self._steps_ns.append(step_ns)
        usual_ns = float(np.median(self._steps_ns or [_LEAST_STEP_NS]))
        steps = int(np.clip(round(step_ns / usual_ns), 1, _MAX_STEPS))
        if self._num_near(observations, 1, _NEAR_NEXT) > self._num_near(observations, steps, _NEAR):
            steps = 1  # a picture stands, or the times of clips leave a gap where nothing is lost
        self._now += steps
        longest = (self._settings.max_lost_frames + 1) * max(usual_ns, before_ns)
        return step_ns <= max(_MIN_PAUSE_NS, longest)

    def _num_near(self, observations: Sequence[Observation], steps: int, near: float) -> int:
        """How many fish of the last frame are seen near where they should be after these steps."""
        return sum(
            any(track.distance(seen, steps=steps) < near for seen in observations)
            for track in self._tracks
            if track.lost_frames == 0
        )

    def _inside(self, observation: Observation) -> list[Track]:
        """The tracks whose predicted box lies mostly inside an observation's."""
        return [
            track
            for track in self._tracks
            if track.fraction_inside(observation.box) > _MIN_MERGED_FRACTION
        ]

    def _split(self, frame: Frame, observation: Observation) -> list[Observation]:
        """The pieces of a blob that several fish share; `[observation]` for any other."""
        inside = self._inside(observation)
        fish = [track for track in inside if track.may_be_hidden]
        new = [track for track in inside if track.began_as_piece and not track.may_be_hidden]
        if len(fish) == len(new) == 1:  # of more, each would make new ones of its parts
            fish += new
        largest = max((track.area for track in fish), default=np.inf)
        is_merged = observation.area >= _MIN_MERGED_AREA_RATIO * largest
        if not is_merged or any(track.observation.touches_border for track in fish):
            return [observation]
        silhouettes = [track.predicted_silhouette() for track in fish]
        pieces = split_merged_blob(
            observation.candidate, [known for known in silhouettes if known is not None]
        )
        if len(pieces) < 2:
            return [observation]
        return [Observation(frame.image, piece, whole=observation.candidate) for piece in pieces]

    def _without_merged(self, observations: Sequence[Observation]) -> list[Observation]:
        """Drop observations that contain several fish; those fish are kept inside them."""
        separate = []
        for observation in observations:
            fish = [track for track in self._inside(observation) if track.may_be_hidden]
            largest = max((track.area for track in fish), default=0.0)
            if len(fish) > 1 and observation.area > _MIN_MERGED_AREA_RATIO * largest:
                for track in fish:
                    track.merge_into(observation)
            else:
                separate.append(observation)
        return separate

    def _assign(self, observations: Sequence[Observation]) -> list[Observation]:
        """Update each track with its observation; returns the unassigned observations."""
        if not self._tracks or not observations:
            return list(observations)
        costs = np.array([[track.cost(seen) for seen in observations] for track in self._tracks])
        assigned = set()
        for row, column in zip(*linear_sum_assignment(costs), strict=True):
            if costs[row, column] < IMPOSSIBLE:
                self._tracks[row].update(observations[column])
                assigned.add(column)
        left = [seen for i, seen in enumerate(observations) if i not in assigned]
        return [seen for seen in left if not self._resume_lost(seen, left)]

    def _resume_lost(self, seen: Observation, others: Sequence[Observation]) -> bool:
        """Go on with the only lost fish that an observation may show, if it is the only such one.

        A gaff hides a fish for some frames, in which it may be hauled faster or slower.
        """
        if seen.is_piece:
            return False
        lost = [track for track in self._tracks if track.lost_frames > 1 and track.snapshot is None]
        alike = [track for track in lost if track.cost(seen, is_only_one=True) < IMPOSSIBLE]
        if len(alike) != 1:
            return False
        if sum(alike[0].cost(other, is_only_one=True) < IMPOSSIBLE for other in others) > 1:
            return False
        alike[0].update(seen)
        return True

    def _keep_covered(self, observations: Sequence[Observation]) -> None:
        """Keep lost fish that are predicted behind another fish that has just been seen."""
        for track in self._tracks:
            if track.lost_frames > 0 and track.may_be_hidden:
                for observation in observations:
                    if track.fraction_inside(observation.box) > _MIN_MERGED_FRACTION:
                        track.merge_into(observation)
                        break

    def _drop_lost(self, frame: Frame) -> None:
        """Drop tracks that left the frame or were lost for too long, unless they may be hidden."""
        height, width = frame.image.shape[:2]
        tracks = [track for track in self._tracks if track.is_in_frame(width, height)]
        max_lost_frames = self._settings.max_lost_frames
        self._tracks = [track for track in tracks if track.lost_frames <= max_lost_frames]
        lost = [track for track in tracks if track.lost_frames > max_lost_frames]
        self._hidden = [
            track
            for track in (*self._hidden, *lost)
            if track.lost_frames - 1 <= self._max_hidden_frames(track)  # this frame may show it
            and track.frames_seen >= _MIN_KNOWN_FRAMES
            and not track.observation.touches_border
        ]

    def _max_hidden_frames(self, track: Track) -> int:
        is_covered = track.snapshot is not None and track.snapshot.is_covered
        return max(self._settings.max_hidden_frames, _MAX_COVERED_FRAMES if is_covered else 0)

    def _start_tracks(self, observations: Sequence[Observation]) -> None:
        """Start a track for each observation that is no part of a fish that is seen."""
        seen = [track for track in self._tracks if track.lost_frames == 0]
        for observation in observations:
            is_apart = not any(
                observation.fraction_inside(track.observation.box) > _MAX_OVERLAP_OF_NEW
                for track in seen
            )
            if observation.is_piece or is_apart:
                self._num_started += 1
                self._tracks.append(Track(observation, self._num_started, self._now))

    def _reidentify(self, unassigned: Sequence[Observation]) -> list[Observation]:
        """Settle the identities of fish that were merged or lost; return what is still unassigned.

        Tracks too young to be known count as new observations: they may be an older fish, unless
        they came into its blob while it was seen there.
        """
        may_be_behind = self._settings.max_hidden_frames > 0
        for track in self._tracks:
            is_unclear = (may_be_behind and track.lost_frames > 0) or track.observation.is_piece
            if is_unclear and track.frames_seen >= _MIN_KNOWN_FRAMES:
                track.make_uncertain()
        uncertain = [t for t in (*self._tracks, *self._hidden) if t.snapshot is not None]
        lost = [track.number for track in uncertain if track.lost_frames > 0]
        young = [
            t
            for t in self._tracks
            if t.frames_seen < _MIN_KNOWN_FRAMES
            and t.lost_frames == 0
            and all(t.frames_beside[number] < _MIN_FRAMES_BESIDE for number in lost)
        ]
        new = [*unassigned, *(track.observation for track in young)]
        new = [seen for seen in new if not seen.is_piece and not seen.touches_border]
        taken = self._exchange(uncertain, new)
        self._tracks = [t for t in self._tracks if t not in young or t.observation not in taken]
        self._tracks += [track for track in self._hidden if track.lost_frames == 0]
        self._hidden = [track for track in self._hidden if track.lost_frames > 0]
        self._settle(uncertain)
        return [seen for seen in unassigned if seen not in taken]

    def _exchange(
        self, uncertain: Sequence[Track], new: Sequence[Observation]
    ) -> list[Observation]:
        """Reassign the uncertain fish to their tracks' and to new observations; return the taken.

        If a track shows another fish, the fish's number and snapshot move to it.
        """
        owners = [t for t in uncertain if t.lost_frames == 0 and not t.observation.is_piece]
        if not uncertain or not (owners or new):
            return []
        observations = [*(track.observation for track in owners), *new]
        fish = [(track.number, track.make_uncertain()) for track in uncertain]
        fish_of = reidentify(
            [snapshot for _, snapshot in fish],
            [uncertain.index(track) for track in owners],
            observations,
        )
        track_of = {row: owners[i] for i, row in fish_of.items() if i < len(owners)}
        _distribute_others(track_of, uncertain)
        for row, track in track_of.items():
            track.take_identity(*fish[row])
        taken = {i: row for i, row in fish_of.items() if i >= len(owners)}
        for i, row in taken.items():
            track_of[row].resume(observations[i])
        return [observations[i] for i in taken]

    def _settle(self, uncertain: Sequence[Track]) -> None:
        """Settle fish seen separately; keep the others inside the blobs that may hide them."""
        seen = [track for track in uncertain if track.lost_frames == 0]
        for track in uncertain:
            others = seen if track.lost_frames else [track]
            blobs = [other.observation.outer_box for other in others]
            track.make_uncertain().constrain_to_one_of(blobs)
        lost = [track.make_uncertain() for track in uncertain if track.lost_frames > 0]
        for track in seen:
            if track.is_settled and not any(fish.is_inside(track.observation.box) for fish in lost):
                track.settle()


def _distribute_others(track_of: dict[int, Track], uncertain: Sequence[Track]) -> None:
    """Give every fish without a track one of the left-over tracks, its own if possible.

    `track_of`: tracks by the fish's index in `uncertain`; completed in place.
    """
    spare = [track for track in uncertain if track not in track_of.values()]
    rows = [row for row in range(len(uncertain)) if row not in track_of]
    for row in sorted(rows, key=lambda row: uncertain[row] not in spare):  # own tracks first
        track_of[row] = uncertain[row] if uncertain[row] in spare else spare[0]
        spare.remove(track_of[row])


class TrackNumbering:
    """Assigns track ids, each to one fish of the output folder, from 1.

    An annotated fish keeps the id of its file; tracked fish are numbered as they come. Both follow
    on the ids of earlier runs in the same folder.
    """

    def __init__(self, *, keeps_source_ids: bool) -> None:
        """`keeps_source_ids`: the ids of annotation files, instead of new numbers."""
        self._keeps_source_ids = keeps_source_ids
        self._last_id = 0  # of earlier runs
        self._ids: dict[int, int] = {}  # by source id

    def resume_after(self, track_id: int) -> None:
        """Number all fish after this id of an earlier run; call it before the first fish."""
        self._last_id = track_id

    def track_id(self, source_id: int) -> int:
        """The id of a fish, always the same for the same `source_id`."""
        if self._keeps_source_ids:
            return self._last_id + source_id
        return self._ids.setdefault(source_id, self._last_id + len(self._ids) + 1)
