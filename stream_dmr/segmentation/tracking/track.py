"""One followed fish: where it is, where it should be next, and what it looks like."""

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from filterpy.kalman import KalmanFilter
from jaxtyping import Float, UInt8

from stream_dmr.segmentation.detection.detector import Candidate, whole_pixels
from stream_dmr.segmentation.tracking.occlusion import Memory
from stream_dmr.segmentation.tracking.split_blobs import Expected, extent

# Standard deviations; those of motion are fractions of the fish's size, so that any zoom will do.
_PLACE_STD = 0.08  # of a candidate's middle
_SPEED_STD = 0.5  # of a new fish, per frame
_ACCELERATION_STD = 0.06  # per frame squared
_LOG_AREA_STD = 0.5  # from frame to frame: flatfish turn edge-on within three
_COLOUR_STD = 25.0  # grey levels: one side of a flatfish is dark, and turning shades it
_MOST_COST = 25.0  # a sum of four squares, each about 1
NEVER = 1e6
_FARTHEST = 1.2  # sizes between a fish and where it was expected
_SHORTER = 0.93  # times its length a fish may seem in the next frame, turning to or fro
_PIECE_DOUBT = 9.0  # times the variance of a candidate's middle is that of a piece's
_LEARN = 0.35  # of a fish's size and colour, per frame
_FLEETING = 2  # frames: what was seen in no more is not waited for
_MOST_WAITED = 30  # frames that two fish may stay one candidate
_BEFORE = 3  # frames before the first in which fish are seen to be one
_SETTLED = 5  # frames by itself


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Sighting:
    """One followed fish in one frame."""

    number: int  # of the track; not a fish's id yet
    candidate: Candidate
    visible_fraction: float  # 0 to 1


class Look:
    """What a candidate looks like to the tracker."""

    def __init__(
        self,
        image: UInt8[np.ndarray, "H W 3"],
        candidate: Candidate,
        *,
        whole: Candidate | None = None,
    ) -> None:
        """`whole`: the candidate that this is a piece of."""
        self.candidate, self.whole, self.is_piece = candidate, whole, whole is not None
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

    @property
    def outer_box(self) -> Float[np.ndarray, "4"]:
        """The box of the whole candidate."""
        return self.box if self.whole is None else self.whole.bbox_xyxy_px

    def share_in(self, box: Float[np.ndarray, "4"]) -> float:
        """The share of this box that lies in another."""
        return share_of(self.box, box)


class Track:
    """One fish, followed."""

    def __init__(self, look: Look, number: int, frame_index: int) -> None:
        self.look, self.number, self.frame_index = look, number, frame_index
        self._whole = look  # as last seen by itself; pieces would lead it astray, bit by bit
        self.area, self.colour, self.length = look.area, look.colour, look.length
        self.was_alone = not look.is_piece  # once at least: what is always a piece may be no fish
        self.lost_frames, self.frames_seen, self._waited = 0, 1, 0
        self.memory: Memory | None = None  # while it is not sure who this is
        self._before: deque[Memory] = deque(maxlen=_BEFORE)  # of the frames in which it was sure
        self._alone_frames = 1
        self._filter = KalmanFilter(dim_x=4, dim_z=2)  # middle x, y; speed per frame
        self._filter.x = np.array([*look.middle, 0.0, 0.0])[:, None]
        self._filter.H = np.eye(2, 4)
        self._filter.R = np.eye(2) * (_PLACE_STD * self.size) ** 2
        self._filter.P = np.diag([_PLACE_STD**2] * 2 + [_SPEED_STD**2] * 2) * self.size**2
        self._before.append(self._now())

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
        Q = drift @ drift.T * (_ACCELERATION_STD * self.size) ** 2
        self._filter.predict(F=F, Q=Q)
        for memory in self._before if self.memory is None else [self.memory]:
            memory.move(F, Q)

    @property
    def may_hide(self) -> bool:
        """Whether this was seen for long enough to be taken for a fish that another one hides."""
        return self.frames_seen > _FLEETING

    def wait(self, look: Look) -> None:
        """Another fish hides this one, or it hides the other: it is somewhere in the candidate."""
        self._waited += 1
        if self._waited > _MOST_WAITED:
            return
        self.lost_frames = 1
        quarter = np.minimum(self.look.box[2:] - self.look.box[:2], look.box[2:] - look.box[:2]) / 4
        inside = self.middle.clip(look.box[:2] + quarter, look.box[2:] - quarter)
        self._filter.x[:2, 0] = inside
        self.remember()

    def update(self, look: Look) -> None:
        """Take a candidate for this fish."""
        self.look, self.lost_frames, self._waited = look, 0, 0
        self.frames_seen += 1
        self._alone_frames = 0 if look.is_piece else self._alone_frames + 1
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
        if self.memory is None:
            self._before.append(self._now())

    def _now(self) -> Memory:
        return Memory(
            x=self._filter.x.copy(),
            P=self._filter.P.copy(),
            area=self.area,
            length=self.length,
            colour=self.colour,
        )

    def remember(self) -> Memory:
        """From now on it is not sure who this is: keep in mind what it was a little earlier.

        The shapes of fish that meet are wrong some frames before that shows.
        """
        if self.memory is None:
            self.memory = self._before[0]
        return self.memory

    @property
    def is_sure(self) -> bool:
        """Whether this was seen by itself for so long that what came before is settled."""
        return self.lost_frames == 0 and self._alone_frames >= _SETTLED

    def settle(self) -> None:
        """This is who it seems to be."""
        self.memory = None
        self._before.clear()
        self._before.append(self._now())

    def become(self, number: int, memory: Memory) -> None:
        """Be this fish from now on, here and as it looks now."""
        if number != self.number:
            self.number, self.memory = number, memory
            self.area, self.length, self.colour = memory.area, memory.length, memory.colour

    def resume(self, look: Look) -> None:
        """Be seen again, after a gap."""
        assert self.memory is not None
        self._filter.x, self._filter.P = self.memory.x.copy(), self.memory.P.copy()
        self.update(look)

    def cost(self, look: Look) -> float:
        """How little a candidate is this fish, as a sum of squares over their variances."""
        away = look.middle - self.middle
        if np.hypot(*away) > _FARTHEST * max(self.size, 1.0):
            return NEVER
        place = self._filter.P[:2, :2] + self._filter.R
        growth = np.log(look.area / self.area)
        if look.touches_border:
            growth = max(growth, 0.0)
        cost = away @ np.linalg.solve(place, away) + (growth / _LOG_AREA_STD) ** 2 / self._patience
        cost += np.sum((look.colour - self.colour) ** 2) / _COLOUR_STD**2
        return float(cost) if cost < _MOST_COST else NEVER

    @property
    def _patience(self) -> float:
        """What a fish turns in the frames in which it was not seen."""
        return float(max(1, self.lost_frames))

    def share_in(self, box: Float[np.ndarray, "4"]) -> float:
        """The share of the box where this fish is expected that lies in another."""
        return share_of(self._whole.box + np.tile(self._way, 2), box)

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


def share_of(box: Float[np.ndarray, "4"], other: Float[np.ndarray, "4"]) -> float:
    """The share of a box that lies in another."""
    overlap = np.minimum(box[2:], other[2:]) - np.maximum(box[:2], other[:2])
    return float(np.prod(np.maximum(overlap, 0)) / max(np.prod(box[2:] - box[:2]), 1e-9))
