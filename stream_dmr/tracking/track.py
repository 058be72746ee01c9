"""One followed fish: its predicted position, size, appearance, and certainty of identity."""

from collections import Counter, deque
from dataclasses import dataclass

import numpy as np
from filterpy.kalman import KalmanFilter
from jaxtyping import Float

from stream_dmr.detection.detector import Candidate
from stream_dmr.geometry import fraction_inside, longer_side
from stream_dmr.tracking.confirmation import FishEvidence
from stream_dmr.tracking.observation import Observation, dissimilarity, dissimilarity_if_covered
from stream_dmr.tracking.occlusion import IMPOSSIBLE, TrackSnapshot
from stream_dmr.tracking.split_blobs import PredictedSilhouette

# Chosen on simulated scenes and crossings by IDF1 and fish counted; see docs/research/tracking.md.
# Lengths are fractions of the fish's size, so that any zoom will do.
_POSITION_STD = 0.08  # of a candidate's center
_SPEED_STD = 0.5  # of a new fish, per frame
_ACCELERATION_STD = 0.06  # per frame squared
_LOG_AREA_STD = 0.5  # from frame to frame: flatfish turn edge-on within three
_DISSIMILARITY = 0.003  # of colours, per frame, that costs as much as one standard deviation
_MAX_DISSIMILAR_FRAMES = 10  # over which colours go on changing: fish turn, and are shaded
_PART_RATIO = 3.0  # of the colours of a part of a fish, to those of a whole fish
_COVERED_COST = 4.0  # of supposing that something covers part of the fish
_MAX_COST = 25.0  # of three squares (x, y, area), each about 1, and the colours
# Sizes between the predicted and the observed center: so many times the usual distance of this
# fish, within limits; the upper limit if its identity is uncertain, the last if it was seen only
# once and its speed is unknown.
_MAX_DEVIATIONS = 3.0
_MIN_GATE, _MAX_GATE, _FIRST_GATE = 0.3, 0.7, 1.2
_NEXT_GATE = 0.4  # least one in the next frame: a line that comes into the box, or a gaff, moves it
_SPEED_CHANGE = 0.2  # of the way that a lost fish is predicted to have gone
_MAX_SHORTENING = 0.93  # of the length, per frame: a fish that turns seems shorter than it is
_PIECE_VARIANCE_RATIO = 9.0  # variance of a piece's center over that of a whole candidate's
_LEARNING_RATE = 0.35  # of the area, per frame
_MEMORY = 0.8  # of the squared distances from predictions, per frame
_MIN_HIDEABLE_FRAMES = 3  # frames seen from which on a track is kept while another fish hides it
_MAX_MERGED_FRAMES = 30  # that fish may stay merged in one candidate
_SNAPSHOT_DELAY = 3  # frames: silhouettes are wrong some frames before a merge shows
_SETTLING_FRAMES = 5  # consecutive frames seen separately after which an identity is certain


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TrackedCandidate:
    """A track's candidate in one frame."""

    track_number: int  # from 1; a fish id is given at confirmation
    candidate: Candidate
    visible_fraction: float  # 0 to 1
    evidence: FishEvidence  # of all frames so far


class Track:
    """One fish, followed by a constant-velocity Kalman filter on the center of its box."""

    def __init__(self, observation: Observation, number: int, frame_index: int) -> None:
        """`frame_index`: the frame of the first observation."""
        self.observation, self.number, self.frame_index = observation, number, frame_index
        # As last seen separately: following pieces, position and size would drift.
        self._whole = observation
        self.area, self.colours = observation.area, observation.colours
        self.length = observation.length
        self.was_separate = not observation.is_piece  # always a piece: it may be no fish
        self.began_as_piece = observation.is_piece
        self.frames_beside = Counter[int]()  # by the number of a track that was seen in them, too
        self._evidence = FishEvidence(observation.candidate, self.size)
        self.lost_frames, self.frames_seen, self._merged_frames = 0, 1, 0
        self.snapshot: TrackSnapshot | None = None  # None while the identity is certain
        self._history: deque[TrackSnapshot] = deque(maxlen=_SNAPSHOT_DELAY)
        self._separate_frames = 1
        self._mean_square = (_MAX_GATE / _MAX_DEVIATIONS) ** 2  # of its distances, sizes
        self._colours_frame = frame_index  # in which `colours` were seen
        self._filter = KalmanFilter(dim_x=4, dim_z=2)  # center x, y; speed per frame
        self._filter.x = np.array([*observation.center, 0.0, 0.0])[:, None]
        self._filter.H = np.eye(2, 4)
        self._filter.R = np.eye(2) * (_POSITION_STD * self.size) ** 2
        self._filter.P = np.diag([_POSITION_STD**2] * 2 + [_SPEED_STD**2] * 2) * self.size**2
        self._history.append(self._current_snapshot())

    @property
    def size(self) -> float:
        """The longer side of the box, px."""
        return longer_side(self._whole.box)

    @property
    def center(self) -> Float[np.ndarray, "2"]:
        """Where the fish is, or is predicted to be; frame x, y in px."""
        return self._filter.x[:2, 0]

    @property
    def may_be_hidden(self) -> bool:
        """True once it was seen for long enough to be kept while another fish hides it."""
        return self.frames_seen >= _MIN_HIDEABLE_FRAMES

    @property
    def is_settled(self) -> bool:
        """True once it was seen separately for so long that its identity is certain again."""
        return self.lost_frames == 0 and self._separate_frames >= _SETTLING_FRAMES

    def predict(self, frame_index: int) -> None:
        """Predict to a frame; the fish counts as lost there until it is updated."""
        dt = frame_index - self.frame_index
        self.frame_index = frame_index
        self.lost_frames += dt
        F = np.eye(4)
        F[:2, 2:] = dt * np.eye(2)
        # Q = G G' sigma_a^2 for a constant acceleration within the step
        G = np.vstack([dt**2 / 2 * np.eye(2), dt * np.eye(2)])
        Q = G @ G.T * (_ACCELERATION_STD * self.size) ** 2
        self._filter.predict(F=F, Q=Q)
        for snapshot in self._history if self.snapshot is None else [self.snapshot]:
            snapshot.predict(F, Q)

    def merge_into(self, observation: Observation) -> None:
        """Keep a fish that is hidden, or hides another, somewhere inside this candidate."""
        self._merged_frames += 1
        if self._merged_frames > _MAX_MERGED_FRAMES:
            return
        self.lost_frames = 1
        own, other = self.observation.box, observation.box
        quarter = np.minimum(own[2:] - own[:2], other[2:] - other[:2]) / 4
        self._filter.x[:2, 0] = self.center.clip(other[:2] + quarter, other[2:] - quarter)
        self.make_uncertain()

    def update(self, observation: Observation) -> None:
        self.observation, self.lost_frames, self._merged_frames = observation, 0, 0
        self.frames_seen += 1
        self._evidence.add(observation.candidate, self.size)
        self._separate_frames = 0 if observation.is_piece else self._separate_frames + 1
        if observation.is_piece and self.was_separate:
            R = _PIECE_VARIANCE_RATIO * self._filter.R
            self._filter.update(observation.center[:, None], R=R)
            return
        if self.frames_seen > 2:  # before, the speed is not known
            square = self.distance(observation) ** 2
            self._mean_square = _MEMORY * self._mean_square + (1 - _MEMORY) * square
        self._whole = observation
        self.was_separate = not observation.is_piece
        self.length = max(observation.length, _MAX_SHORTENING * self.length)
        self._filter.update(observation.center[:, None])
        rate = max(_LEARNING_RATE, 1 / self.frames_seen)
        if not observation.touches_border or observation.area > self.area:  # else it is cut off
            self.area *= (observation.area / self.area) ** rate
        self.colours, self._colours_frame = observation.colours, self.frame_index
        if self.snapshot is None:
            self._history.append(self._current_snapshot())

    def _current_snapshot(self) -> TrackSnapshot:
        return TrackSnapshot(
            state=self._filter.x.copy(),
            covariance=self._filter.P.copy(),
            area=self.area,
            length=self.length,
            colours=self.colours,
        )

    def make_uncertain(self) -> TrackSnapshot:
        """Mark the identity as uncertain; returns the snapshot from before it became so."""
        if self.snapshot is None:
            self.snapshot = self._history[0]
        return self.snapshot

    def settle(self) -> None:
        self.snapshot = None
        self._history.clear()
        self._history.append(self._current_snapshot())

    def take_identity(self, number: int, snapshot: TrackSnapshot) -> None:
        """Continue as another fish: with its number and features, at this track's position."""
        if number != self.number:
            self.number, self.snapshot, self.colours = number, snapshot, snapshot.colours
            self.area, self.length = snapshot.area, snapshot.length

    def resume(self, observation: Observation) -> None:
        """Continue from the snapshot with an observation after a gap."""
        snapshot = self.make_uncertain()
        self._filter.x, self._filter.P = snapshot.state.copy(), snapshot.covariance.copy()
        self.update(observation)

    def cost(self, observation: Observation, *, is_only_one: bool = False) -> float:
        """Sum of squared deviations over their variances; `IMPOSSIBLE` beyond the gates.

        `is_only_one`: no other fish may be it, so it may have been faster or slower while lost.
        """
        gate = self._gate
        if is_only_one:
            way = self.lost_frames * float(np.hypot(*self._filter.x[2:, 0])) / max(self.size, 1.0)
            gate = min(gate + _SPEED_CHANGE * way, _FIRST_GATE)
        if self.distance(observation) > gate:
            return IMPOSSIBLE
        offset = observation.center - self.center
        S = self._filter.P[:2, :2] + self._filter.R  # S = HPH' + R
        growth = np.log(observation.area / self.area)
        if observation.touches_border:
            growth = max(growth, 0.0)
        num_steps = float(max(1, self.lost_frames))  # in which an unseen fish may have turned
        cost = offset @ np.linalg.solve(S, offset) + (growth / _LOG_AREA_STD) ** 2 / num_steps
        cost += self._cost_of_colours(observation)
        return float(cost) if cost < _MAX_COST else IMPOSSIBLE

    def distance(self, observation: Observation, *, steps: int = 0) -> float:
        """Sizes from the predicted place of the fish, or from where it is so many steps later."""
        ahead = self.center + steps * self._filter.x[2:, 0]
        return float(np.hypot(*(observation.center - ahead)) / max(self.size, 1.0))

    @property
    def _gate(self) -> float:
        """Sizes beyond which an observation shows another fish."""
        if self.frames_seen == 1:
            return _FIRST_GATE
        if self.snapshot is not None:
            return _MAX_GATE
        least = _NEXT_GATE if self.lost_frames <= 1 else _MIN_GATE
        return float(np.clip(_MAX_DEVIATIONS * np.sqrt(self._mean_square), least, _MAX_GATE))

    def _cost_of_colours(self, observation: Observation) -> float:
        passed = max(1, self.frame_index - self._colours_frame)
        is_cut_off = observation.touches_border
        allowed = _DISSIMILARITY * min(passed, _MAX_DISSIMILAR_FRAMES)
        if observation.is_piece or is_cut_off:
            allowed *= _PART_RATIO
        views = self.colours, observation.colours
        covered = _COVERED_COST + dissimilarity_if_covered(*views) / allowed
        return min(dissimilarity(*views, is_cut_off=is_cut_off) / allowed, covered)

    def fraction_inside(self, box: Float[np.ndarray, "4"]) -> float:
        """The fraction of this fish's predicted box that lies inside `box`."""
        predicted = (self._whole.box.reshape(2, 2) + self._predicted_offset).ravel()
        return fraction_inside(predicted, box)

    def predicted_silhouette(self) -> PredictedSilhouette | None:
        """The last separate silhouette at its predicted position; None from boxes alone."""
        shape = self._whole.candidate.foreground
        if shape is None:
            return None
        return PredictedSilhouette(
            shape=shape,
            corner=self._whole.box[:2] + self._predicted_offset,
            length_px=self.length,
            area_px=self.area,
            is_whole=self.was_separate,
        )

    @property
    def _predicted_offset(self) -> Float[np.ndarray, "2"]:
        """Offset in px from the center last seen separately to the predicted center."""
        return self.center - self._whole.center

    def is_in_frame(self, width: int, height: int) -> bool:
        """True if the predicted center lies inside the frame."""
        return bool(np.all(self.center >= 0) and np.all(self.center <= [width, height]))

    def tracked_candidate(self) -> TrackedCandidate:
        """This frame's candidate; at the frame's border its visible fraction follows its area."""
        is_cut = self.observation.touches_border
        return TrackedCandidate(
            track_number=self.number,
            candidate=self.observation.candidate,
            visible_fraction=min(1.0, self.observation.area / self.area) if is_cut else 1.0,
            evidence=self._evidence,
        )
