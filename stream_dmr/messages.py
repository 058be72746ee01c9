"""The messages that flow from stage to stage: one immutable type per stage, numpy inside.

Frame -> FishCrop -> FittedMesh -> LocalizedFish -> LengthEstimate

`slots` and `eq=False`: a generated `==` fails on arrays. Arrays are made read-only on the way in.
A fish that a stage can't handle is not dropped: its message contains the reason, and later stages
pass that reason on.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from stream_dmr.camera import Camera


class _ReadOnly:
    """A frozen dataclass whose arrays and mappings are read-only as well."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for name in _field_names(type(self)):
            value = getattr(self, name)
            if isinstance(value, np.ndarray) and value.flags.writeable:
                value = value.view()
                value.flags.writeable = False
            elif isinstance(value, dict):
                value = MappingProxyType(dict(value))
            else:
                continue
            object.__setattr__(self, name, value)


@cache
def _field_names(kind: type) -> frozenset[str]:
    """Field names of a message class, cached because `dataclasses.fields` is slow."""
    return frozenset(part.name for part in fields(kind))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Frame(_ReadOnly):
    """One picture of the source."""

    frame_index: int
    timestamp_ns: int
    image: UInt8[np.ndarray, "H W 3"]  # BGR
    source: str  # file name or address, for people


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FishMessage(_ReadOnly):
    """The first fields of each message of one fish in one frame."""

    frame_index: int
    timestamp_ns: int  # capture time
    track_id: int


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CropQuality:
    """Facts about a crop that later stages gate by."""

    touches_border: bool  # the mask reaches the edge of the frame or crop: part of it is outside
    visible_fraction: float  # of the fish, 0 to 1, by the annotations or the tracker
    sharpness: float  # variance of the Laplacian inside the mask, grey levels squared
    mask_area_px: float  # of the mask, in frame pixels
    # The IoU with the truth that nine in ten masks of this confidence reach; None: a given mask
    mask_confidence: float | None = None
    glare: float | None = None  # share of the mask that is blown out; None: an older recording
    # Change of the fish's length in a box that extends beyond its ends, over its length; None: not
    # looked at.
    length_doubt: float | None = None
    # Probability that the mask lacks snout or tail, by a network; 1 if another fish may hide one;
    # None: not judged.
    missing_end: float | None = None
    # Width of the edge at the ends, beyond that along the sides, over the length, as of a fish that
    # moves while the shutter is open; None: a still, or edges without contrast.
    end_blur: float | None = None


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FishEnds(_ReadOnly):
    """Snout and fork of the tail by a segmenter, and its confidence."""

    head_px: Float[np.ndarray, "2"]  # crop pixels
    tail_px: Float[np.ndarray, "2"]
    confidence: float  # probability that they are not the other way round, 0.5 to 1


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FishCrop(FishMessage):
    """One fish cut out of a frame, through an ideal pinhole camera of its own."""

    bbox_xyxy_px: Float[np.ndarray, "4"]  # half-open, frame pixels
    image: UInt8[np.ndarray, "S S 3"] | None  # BGR, lens distortion removed; None: not recorded
    mask: Bool[np.ndarray, "S S"]  # all False if nothing was segmented
    crop_camera: Camera  # of `image` and `mask`; the orientation is the frame camera's
    frame_camera: Camera  # with crop_camera it determines the exact crop-to-frame pixel map
    quality: CropQuality
    ends: FishEnds | None = None  # None if the segmenter does not find them
    # Pixels that an object in front of the fish may hide, neither fish nor water; None: no pixel.
    unknown: Bool[np.ndarray, "S S"] | None = None
    # Probability of each species by FAO code; empty without a classifier.
    species: Mapping[str, float] = field(default_factory=dict[str, float])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LossTerms:
    """The terms of eq. (3), each before its lambda."""

    iou: float
    boundary: float
    scale: float
    translation: float
    normal: float
    laplacian: float


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SolverReport:
    """How a fit went. `elapsed_ns` is the one field of all messages that no replay can repeat."""

    solver: str  # "adam", ...
    deformation: str  # "spine" | "linear-blend"
    iterations: int
    converged: bool
    stop_reason: str
    cold_start: bool
    elapsed_ns: int


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FittedShape(_ReadOnly):
    """The deformed template in the orientation of the camera, at a relative scale.

    The camera stands in the origin, so the coordinates project through the crop's K as they are;
    their common scale is arbitrary.
    """

    parameters: Float[np.ndarray, "P"]  # layout: stream_dmr.fitting.body
    vertices: Float[np.ndarray, "V 3"] | None  # None: not recorded, computed from `parameters`
    keypoints: Float[np.ndarray, "3 3"]  # head, center, tail
    keypoints_px: Float[np.ndarray, "3 2"]  # the same in frame pixels
    midline: Float[np.ndarray, "M 3"]  # head keypoint to tail keypoint
    iou: float  # of the hard silhouette with the mask
    losses: LossTerms
    covariance: Float[np.ndarray, "P P"] | None  # of `parameters`; None: not asked for
    length_std_ratio: float  # std of the arc length, as a fraction of it
    # Which of the run's candidate shapes the template was given; None: its own.
    candidate: int | None = None
    # Std of the arc length since the fish's shape isn't known exactly, as a fraction: an error that
    # all frames of a fish share. None: an older recording, or a solver that doesn't estimate it.
    shape_std_ratio: float | None = None
    # How far the body reaches beyond its center towards the reference plane, as a fraction of the
    # arc length: half its thickness for a fish on its side. None: an older recording.
    height_ratio: float | None = None


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FittedMesh(FishMessage):
    """The fit of one crop, or the reason why there is none."""

    shape: FittedShape | None  # None if there is a `refusal`
    report: SolverReport | None  # None if no solver ran
    quality: CropQuality
    refusal: str  # "" when fitted, else a Reason
    species: Mapping[str, float] = field(default_factory=dict[str, float])  # FishCrop's


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LocalizedFish(FishMessage):
    """One fish of one frame in millimetres, accepted or refused with its reason.

    Without a calibration the millimetres are None and the pixels and the bending ratio remain.
    """

    keypoints_px: Float[np.ndarray, "3 2"] | None  # head, center, tail
    keypoints_mm: Float[np.ndarray, "3 3"] | None  # the same in the camera frame
    midline_mm: Float[np.ndarray, "M 3"] | None
    bending_ratio: float | None  # arc over chord, eq. (13)
    length_mm: float | None
    length_std_mm: float | None  # without the part below
    iou: float | None
    accepted: bool  # may this frame count towards the fish's length?
    reason: str  # "" when accepted, else a Reason
    # Std over length of an error that all frames of a fish share: since its shape isn't known
    # exactly, and how far it hangs from the plane. None: an older recording.
    shared_std_ratio: float | None = None
    species: Mapping[str, float] = field(default_factory=dict[str, float])  # FishCrop's
    end_blur: float | None = None  # CropQuality's


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TrackEnded(FishMessage):
    """A fish that no later frame shows; frame and time are the last before its end."""

    # "lost": the tracker dropped it; "timeout": unseen for `track_timeout_s`; "end": of the source;
    # "restart": in view when an earlier run broke off; "pause": in view when no further clip came.
    cause: str

    @classmethod
    def after(cls, last: "Frame | FishMessage", track_id: int, cause: str) -> "TrackEnded":
        """The end of a track after the frame of this message."""
        return cls(
            frame_index=last.frame_index,
            timestamp_ns=last.timestamp_ns,
            track_id=track_id,
            cause=cause,
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LengthEstimate(FishMessage):
    """The length of one fish by its frames so far; `is_final` once its track has ended.

    Frame and time are those of the LocalizedFish that it follows.
    """

    is_frame_used: bool  # did that frame pass every gate, the filter's own included?
    frame_reason: str  # "" when used, else a Reason
    length_mm: float | None  # None until there are enough good frames
    length_std_mm: float | None
    ci95_mm: Float[np.ndarray, "2"] | None  # low, high
    frames_seen: int
    frames_used: int
    refused: Mapping[str, int]  # Reason -> number of frames
    first_frame: int
    last_frame: int
    first_timestamp_ns: int
    last_timestamp_ns: int
    status: str  # "measured", "measuring", or a Reason why there is no length
    is_final: bool
    smoothed_frames: Int[np.ndarray, "N"]  # frame indices of the RTS series, empty until final
    smoothed_mm: Float[np.ndarray, "N"]
    smoothed_std_mm: Float[np.ndarray, "N"]
    # What became of the fish; None until final, and if the run has no zones for it.
    fate: str | None = None
    fate_share: float | None = None  # of its body in that zone; None: its end was not seen
    # FAO 3-alpha of the species, or "unsure"; None until final, and without a classifier's look.
    species_code: str | None = None
    species_share: float | None = None  # posterior probability of the likeliest species
    # Std over length, since its ends are blurred by its motion; it only seems longer by that.
    blur_std_ratio: float = 0.0


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Position(_ReadOnly):
    """Place of the vessel by its receiver; degrees of WGS 84."""

    frame_index: int  # of the frame before it; 0: it came before the first
    timestamp_ns: int  # on the clock of the frames; before a video's start it is negative
    utc_ns: int | None  # the receiver's own time, ns since 1970; None: it gave no date
    latitude: float  # north is positive
    longitude: float  # east is positive
    speed_knots: float | None  # over ground
    course_deg: float | None  # over ground, clockwise from true north


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LearntShapes(_ReadOnly):
    """Mean shapes of the fish of a camera; fish first seen from here on may have them."""

    frame_index: int
    timestamp_ns: int
    names: str  # of the body form that each is like, joined by commas
    coefficients: Float[np.ndarray, "N W"]  # see fitting/shape/space.py
    covariances: Float[np.ndarray, "N W W"]
    shares: Float[np.ndarray, "N"]  # of the fish; the body forms have the rest of 1


Message = (
    Frame
    | FishCrop
    | FittedMesh
    | LocalizedFish
    | TrackEnded
    | LengthEstimate
    | Position
    | LearntShapes
)


def track_of(message: Message) -> int:
    """The id of the fish that a message is of; 0: of none."""
    return getattr(message, "track_id", 0)
