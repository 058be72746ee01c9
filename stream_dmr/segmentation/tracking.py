"""Who is who from frame to frame: each fish keeps its id through gaps and crossings.

A constant-velocity Kalman filter per fish and the cheapest assignment of all fish to all
candidates, as in Bewley et al. ("Simple online and realtime tracking", ICIP 2016). Where two fish
meet their boxes say little, so size and colour weigh as well, and a candidate that swallows two
fish is neither of them. filterpy and SciPy do the work: the tracking libraries that allow this
use either bring a second OpenCV (`trackers`), forbid today's NumPy (`norfair`) or know boxes alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from filterpy.kalman import KalmanFilter
from jaxtyping import Float, UInt8
from pydantic import Field
from scipy.optimize import linear_sum_assignment

from stream_dmr.messages import Frame
from stream_dmr.segmentation.detector import Candidate, whole_pixels
from stream_dmr.segmentation.parting import Expected, extent, part
from stream_dmr.settings import Settings

# Standard deviations; those of motion are fractions of the fish's size, so that any zoom will do.
_PLACE_STD = 0.08  # of a candidate's middle
_SPEED_STD = 0.5  # of a new fish, per frame
_ACCELERATION_STD = 0.06  # per frame squared
_LOG_AREA_STD = 0.5  # from frame to frame: flatfish turn edge-on within three
_COLOUR_STD = 25.0  # grey levels: one side of a flatfish is dark, and turning shades it
_MOST_COST = 25.0  # a sum of four squares, each about 1
_NEVER = 1e6
_FARTHEST = 1.2  # sizes between a fish and where it was expected
_SHORTER = 0.93  # times its length a fish may seem in the next frame, turning to or fro
_PIECE_DOUBT = 9.0  # times the variance of a candidate's middle is that of a piece's
_LEARN = 0.35  # of a fish's size and colour, per frame
_SWALLOWED = 0.55  # of a fish's expected box inside a candidate
_SWOLLEN = 1.3  # times the larger of two fish: a candidate that is both
_FLEETING = 2  # frames: what was seen in no more is not waited for
_MOST_WAITED = 30  # frames that two fish may stay one candidate
_BESIDE = 0.3  # of a candidate inside a followed fish's box: a part of it, no new fish


class TrackerSettings(Settings):
    """The part of `[track_fish]` that says how fish are followed from frame to frame."""

    max_lost_frames: int = Field(
        default=7, ge=0, description="a fish unseen for more frames in a row is gone"
    )
    min_score: float = Field(
        default=0.3, ge=0, le=1, description="least score of a detector's candidate that counts"
    )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Sighting:
    """One followed fish in one frame."""

    number: int  # of the track; not a fish's id yet
    candidate: Candidate
    visible_fraction: float  # 0 to 1


class Tracker:
    """Follows every candidate; which of the tracks are fish is for others to say."""

    def __init__(self, settings: TrackerSettings) -> None:
        self._settings = settings
        self._tracks: list[_Track] = []
        self._started = 0

    def step(self, frame: Frame, candidates: Sequence[Candidate]) -> list[Sighting]:
        """The tracks seen in a frame, by number. Frames must come in order; some may be missing."""
        looks = [_Look(frame.image, c) for c in candidates if c.score >= self._settings.min_score]
        for track in self._tracks:
            track.predict(frame.frame_index)
        looks = [piece for look in looks for piece in self._part(frame, look)]
        swallowed = self._swallowed(looks)
        looks = [look for i, look in enumerate(looks) if i not in swallowed]
        free = self._assign(looks)
        self._hide(looks)
        self._drop_lost(frame)
        seen = [track for track in self._tracks if track.lost_frames == 0]
        for look in free:
            is_beside = not any(look.share_in(track.look.box) > _BESIDE for track in seen)
            if look.is_piece or is_beside:
                self._started += 1
                self._tracks.append(_Track(look, self._started, frame.frame_index))
        return [t.sighting() for t in self._tracks if t.lost_frames == 0 and t.was_alone]

    def _part(self, frame: Frame, look: "_Look") -> list["_Look"]:
        """A candidate, or its pieces where several fish share it."""
        inside = [t for t in self._tracks if t.may_hide and t.share_in(look.box) > _SWALLOWED]
        largest = max((track.area for track in inside), default=np.inf)
        if look.area < _SWOLLEN * largest or any(t.look.touches_border for t in inside):
            return [look]
        expected = [track.expected() for track in inside]
        pieces = part(look.candidate, [one for one in expected if one is not None])
        if len(pieces) < 2:
            return [look]
        return [_Look(frame.image, piece, is_piece=True) for piece in pieces]

    def _swallowed(self, looks: Sequence["_Look"]) -> set[int]:
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

    def _hide(self, looks: Sequence["_Look"]) -> None:
        """Let fish wait that should be where another one has just been seen: they are behind it."""
        for track in self._tracks:
            if track.lost_frames > 0 and track.may_hide:
                for look in looks:
                    if track.share_in(look.box) > _SWALLOWED:
                        track.wait(look)
                        break

    def _assign(self, looks: Sequence["_Look"]) -> list["_Look"]:
        """Give each track its candidate; the candidates left over are returned."""
        if not self._tracks or not looks:
            return list(looks)
        costs = np.array([[track.cost(look) for look in looks] for track in self._tracks])
        taken = set()
        for row, column in zip(*linear_sum_assignment(costs), strict=True):
            if costs[row, column] < _NEVER:
                self._tracks[row].update(looks[column])
                taken.add(column)
        return [look for i, look in enumerate(looks) if i not in taken]

    def _drop_lost(self, frame: Frame) -> None:
        height, width = frame.image.shape[:2]
        self._tracks = [
            track
            for track in self._tracks
            if track.lost_frames <= self._settings.max_lost_frames
            and track.is_inside(width, height)
        ]


class _Look:
    """What a candidate looks like to the tracker."""

    def __init__(
        self, image: UInt8[np.ndarray, "H W 3"], candidate: Candidate, *, is_piece: bool = False
    ) -> None:
        self.candidate, self.is_piece = candidate, is_piece
        self.box = candidate.bbox_xyxy_px
        self.middle = (self.box[:2] + self.box[2:]) / 2
        x0, y0, x1, y1 = whole_pixels(self.box)
        fish = candidate.foreground
        if fish is None:  # a box's corners are sea
            fish = np.zeros((y1 - y0, x1 - x0), np.uint8)
            axes = ((x1 - x0) // 3, (y1 - y0) // 3)
            cv2.ellipse(fish, ((x1 - x0) // 2, (y1 - y0) // 2), axes, 0, 0, 360, 1, cv2.FILLED)
        self.area = float(max(1, np.count_nonzero(fish)))
        self.length = extent(fish > 0)[1]
        part = image[y0:y1, x0:x1]
        self.colour = np.array(
            cv2.mean(part, fish[: part.shape[0], : part.shape[1]].astype(np.uint8))[:3]
        )
        height, width = image.shape[:2]
        self.touches_border = bool(min(x0, y0, width - x1, height - y1) <= 1)

    def share_in(self, box: Float[np.ndarray, "4"]) -> float:
        """The share of this box that lies in another."""
        return _share_in(self.box, box)


class _Track:
    """One fish, followed."""

    def __init__(self, look: _Look, number: int, frame_index: int) -> None:
        self.look, self.number, self.frame_index = look, number, frame_index
        self._whole = look  # as last seen by itself; pieces would lead it astray, bit by bit
        self.area, self.colour, self.length = look.area, look.colour, look.length
        self.was_alone = not look.is_piece  # once at least: what is always a piece may be no fish
        self.lost_frames, self.frames_seen, self._waited = 0, 1, 0
        self._filter = KalmanFilter(dim_x=4, dim_z=2)  # middle x, y; speed per frame
        self._filter.x = np.array([*look.middle, 0.0, 0.0])[:, None]
        self._filter.H = np.eye(2, 4)
        self._filter.R = np.eye(2) * (_PLACE_STD * self.size) ** 2
        self._filter.P = np.diag([_PLACE_STD**2] * 2 + [_SPEED_STD**2] * 2) * self.size**2

    @property
    def size(self) -> float:
        """The longer side of the box, px."""
        return float(max(self._whole.box[2:] - self._whole.box[:2]))

    @property
    def middle(self) -> Float[np.ndarray, "2"]:
        """Where the fish is, or is expected, px."""
        return self._filter.x[:2, 0]

    def predict(self, frame_index: int) -> None:
        """Move on to a frame; a fish is lost there until it is updated."""
        dt = frame_index - self.frame_index
        self.frame_index = frame_index
        self.lost_frames += dt
        F = np.eye(4)
        F[:2, 2:] = dt * np.eye(2)
        drift = np.vstack([dt**2 / 2 * np.eye(2), dt * np.eye(2)])
        self._filter.predict(F=F, Q=drift @ drift.T * (_ACCELERATION_STD * self.size) ** 2)

    @property
    def may_hide(self) -> bool:
        """Whether this was seen for long enough to be taken for a fish that another one hides."""
        return self.frames_seen > _FLEETING

    def wait(self, look: _Look) -> None:
        """Another fish hides this one, or it hides the other: it is somewhere in the candidate."""
        self._waited += 1
        if self._waited > _MOST_WAITED:
            return
        self.lost_frames = 1
        quarter = np.minimum(self.look.box[2:] - self.look.box[:2], look.box[2:] - look.box[:2]) / 4
        inside = self.middle.clip(look.box[:2] + quarter, look.box[2:] - quarter)
        self._filter.x[:2, 0] = inside

    def update(self, look: _Look) -> None:
        """Take a candidate for this fish."""
        self.look, self.lost_frames, self._waited = look, 0, 0
        self.frames_seen += 1
        if look.is_piece and self.was_alone:
            self._filter.update(look.middle[:, None], R=_PIECE_DOUBT * self._filter.R)
            return
        self._whole = look
        self.was_alone = not look.is_piece
        self.length = max(look.length, _SHORTER * self.length)
        self._filter.update(look.middle[:, None])
        rate = max(_LEARN, 1 / self.frames_seen)
        if not look.touches_border or look.area > self.area:  # what is cut off shows too little
            self.area *= (look.area / self.area) ** rate
        self.colour = self.colour + rate * (look.colour - self.colour)

    def cost(self, look: _Look) -> float:
        """How little a candidate is this fish, as a sum of squares over their variances."""
        away = look.middle - self.middle
        if np.hypot(*away) > _FARTHEST * max(self.size, 1.0):
            return _NEVER
        place = self._filter.P[:2, :2] + self._filter.R
        growth = np.log(look.area / self.area)
        if look.touches_border:
            growth = max(growth, 0.0)
        cost = away @ np.linalg.solve(place, away) + (growth / _LOG_AREA_STD) ** 2 / self._patience
        cost += np.sum((look.colour - self.colour) ** 2) / _COLOUR_STD**2
        return float(cost) if cost < _MOST_COST else _NEVER

    @property
    def _patience(self) -> float:
        """What a fish turns in the frames in which it was not seen."""
        return float(max(1, self.lost_frames))

    def share_in(self, box: Float[np.ndarray, "4"]) -> float:
        """The share of the box where this fish is expected that lies in another."""
        return _share_in(self._whole.box + np.tile(self._way, 2), box)

    def expected(self) -> Expected | None:
        """The fish's last shape, moved on; None where the detector gives no shapes."""
        shape = self._whole.candidate.foreground
        corner = self._whole.box[:2] + self._way
        if shape is None:
            return None
        return Expected(
            shape=shape,
            corner=corner,
            length_px=self.length,
            area_px=self.area,
            is_whole=self.was_alone,
        )

    @property
    def _way(self) -> Float[np.ndarray, "2"]:
        """From where the whole fish was seen to where it is expected, px."""
        return self.middle - self._whole.middle

    def is_inside(self, width: int, height: int) -> bool:
        """Whether the fish is in the picture, as far as one can tell."""
        return bool(np.all(self.middle >= 0) and np.all(self.middle <= [width, height]))

    def sighting(self) -> Sighting:
        """This frame's part of the track."""
        is_cut = self.look.touches_border
        return Sighting(
            number=self.number,
            candidate=self.look.candidate,
            visible_fraction=min(1.0, self.look.area / self.area) if is_cut else 1.0,
        )


def _share_in(box: Float[np.ndarray, "4"], other: Float[np.ndarray, "4"]) -> float:
    overlap = np.minimum(box[2:], other[2:]) - np.maximum(box[:2], other[:2])
    return float(np.prod(np.maximum(overlap, 0)) / max(np.prod(box[2:] - box[:2]), 1e-9))
