"""Absolute 3D localization of a fitted fish by the paper's closed form (Sec. 2.3, eq. 6-13).

The fit knows the fish's shape in the orientation of the camera, but not its scale. The scale comes
from the reference plane: the center lies on it (eq. 9-11), head and tail lie on the rays through
their pixels (eq. 6-8) and, seen from the center, in the directions of the fitted shape (eq. 12).
The keypoints of a fish that lies on the plane are as high above it as such bodies rest.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from pydantic import Field

from stream_dmr.camera import Calibration, ReferencePlane
from stream_dmr.geometry import arc_length, arc_lengths, bending_ratio, misfit
from stream_dmr.messages import CropQuality, FittedMesh, FittedShape, LocalizedFish
from stream_dmr.reasons import Reason
from stream_dmr.settings import Settings

_MIN_ANGLE_RAD = 1e-3  # between two lines, for their intersection to mean anything
# Heights of head, center and tail of a fish that lies on its side, over half its thickness at the
# center. A stiff body holds all three at 1; a limp body lowers the tail to 0, and the snout to its
# own half thickness. Neither is known of a fish, so the ends are halfway between.
_LYING_HEIGHTS = np.array([0.5, 1.0, 0.25])
_LYING_END_STD = 0.25  # of both ends' heights together: from stiff to limp is four stds
# Relative std of a body form's thickness: thickness over length differs so much among specimens of
# one species, by how full they are.
_THICKNESS_STD = 0.3
# Std of a fish's log length by its mask: by 1 - its confidence, by how much the length changes in a
# longer box, and by the square of the probability that it lacks an end; with and without that
# probability. All frames of a fish share it: a dark tail is dark in all of them. Fitted to
# photographs that the networks never saw; see docs/research/real-pictures.md.
_MASK_STDS, _UNJUDGED_MASK_STDS = (0.08, 0.3, 0.12), (0.12, 0.35, 0.0)
_HEIGHT_ROUNDS = 3  # the height goes with the length, which goes with the height


class LocalizeSettings(Settings):
    """`[localize]`: from the fitted shape to millimetres, and which frames count."""

    bending: bool = Field(
        default=True,
        description="length along the bent body; false: chord only, the paper's ablation",
    )
    min_iou: float = Field(
        default=0.85,
        ge=0,
        le=1,
        description="poorest fit that counts, silhouette IoU with mask; less of slender fish",
    )
    min_visible_fraction: float = Field(
        default=0.7, ge=0, le=1, description="least visible part of a fish that counts, 0 to 1"
    )
    min_mask_confidence: float = Field(
        default=0.36,
        ge=0,
        le=1,
        description="least mask confidence that counts; given masks have none",
    )
    max_missing_end: float = Field(
        default=0.98,
        ge=0,
        le=1,
        description="greatest probability that snout or tail is missing from the mask of a frame "
        "that counts; judged in stills",
    )
    max_length_std_ratio: float = Field(
        default=0.2, gt=0, description="largest std of a fit's length that counts, over length"
    )
    refuse_border: bool = Field(
        default=True, description="refuse frames whose mask touches the edge of the picture"
    )
    rests_on_plane: bool = Field(
        default=False,
        description="fish lie on the reference plane, their ends lower than their middle",
    )
    plane_std_mm: float = Field(
        default=25.0, gt=0, description="std of the centers' distance from the plane, mm"
    )
    bending_std: float = Field(
        default=0.15, ge=0, description="std of what bending adds to a length, as a fraction of it"
    )
    slant_std_rad: float = Field(
        default=0.1, ge=0, description="std of the angle at which the body is seen, rad"
    )
    misfit_std: float = Field(
        default=0.08,
        ge=0,
        description="std that the misfit of an IoU of 0.9 adds to a length, as a fraction of it",
    )
    max_slant_rad: float = Field(
        default=0.8, gt=0, description="largest slant of a fish that counts; 0 is broadside, rad"
    )
    max_bow_ratio: float = Field(
        default=0.35,
        gt=0,
        description="furthest that a midline may bow towards or away from the camera, over its "
        "length; that of a half circle is 0.32",
    )
    max_bending_ratio: float = Field(
        default=3.0,
        gt=1,
        description="largest arc over chord of a midline; that of a half circle is 1.57",
    )


class Unlocatable(Exception):
    """This shape has no place in millimetres, for this reason."""

    def __init__(self, reason: Reason) -> None:
        super().__init__(reason)
        self.reason = reason


@dataclass(frozen=True, eq=False, kw_only=True)
class Location:
    """A fish in the camera frame, in millimetres."""

    keypoints_mm: Float[np.ndarray, "3 3"]  # H', C', T'
    midline_mm: Float[np.ndarray, "M 3"]
    length_mm: float
    length_std_mm: float | None  # without the shared part; None if the fit has no std
    # Of the errors that all frames of the fish share: its own shape, its distance from the plane,
    # and ends that its masks lack.
    shared_std_ratio: float
    slant_rad: float  # of the chord from the plane across the line of sight: 0 is broadside
    bow_ratio: float  # of the midline from its chord along the line of sight, over its length
    bending_ratio: float  # arc over chord


def center_on_plane(ray: Float[np.ndarray, "3"], plane: ReferencePlane) -> Float[np.ndarray, "3"]:
    """C' of eq. (9)-(11): where the center's ray (X_c, Y_c, 1) meets the reference plane, in mm.

    Raises Unlocatable if it meets the plane behind the camera, or never.
    """
    with np.errstate(divide="ignore"):
        depth_mm = float(plane.depth_mm(ray[None])[0])
    if not (np.isfinite(depth_mm) and depth_mm > 0):
        raise Unlocatable(Reason.PLANE_BEHIND_CAMERA)
    return depth_mm * ray


def intersect(
    ray: Float[np.ndarray, "3"],
    center_mm: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "3"]:
    """H' (or T'): the line m * ray of eq. (7) meets the line C' + a * direction of eq. (12).

    With noise the lines pass each other; the point nearest to both is taken, the middle of
    their common perpendicular. `direction` is h' - C' = h - c, at any scale.
    Raises Unlocatable if the lines are nearly parallel, or meet behind the camera or on the far
    side of the center.
    """
    size = np.linalg.norm(direction)
    if size == 0:
        raise Unlocatable(Reason.KEYPOINTS_COINCIDE)
    along_ray, along_body = ray / np.linalg.norm(ray), direction / size
    if np.linalg.norm(np.cross(along_ray, along_body)) < np.sin(_MIN_ANGLE_RAD):
        raise Unlocatable(Reason.SEEN_END_ON)
    # m * along_ray - a * along_body = C', three equations for two unknowns
    m, a = np.linalg.lstsq(np.column_stack([along_ray, -along_body]), center_mm, rcond=None)[0]
    if m <= 0 or a <= 0:
        raise Unlocatable(Reason.KEYPOINTS_DISAGREE)
    return (m * along_ray + center_mm + a * along_body) / 2


def locate_keypoints(
    keypoints: Float[np.ndarray, "3 3"],
    keypoints_px: Float[np.ndarray, "3 2"],
    calibration: Calibration,
) -> Float[np.ndarray, "3 3"]:
    """H', C', T' in mm (eq. 6-12) of the fitted head, center, tail at a relative scale.

    Only differences of `keypoints` are used. Raises Unlocatable.
    """
    head, center, tail = keypoints
    rays = calibration.camera.back_project(keypoints_px)
    center_mm = center_on_plane(rays[1], calibration.plane)
    head_mm = intersect(rays[0], center_mm, head - center)
    tail_mm = intersect(rays[2], center_mm, tail - center)
    return np.stack([head_mm, center_mm, tail_mm])


def mask_std_ratio(quality: CropQuality) -> float:
    """Std of the log length by errors of a found mask at its ends; 0 for a given mask."""
    if quality.mask_confidence is None:
        return 0.0
    missing = quality.missing_end
    stds = _UNJUDGED_MASK_STDS if missing is None else _MASK_STDS
    causes = 1 - quality.mask_confidence, quality.length_doubt or 0.0, (missing or 0.0) ** 2
    return float(np.linalg.norm(np.multiply(stds, causes)))


def locate(
    shape: FittedShape, quality: CropQuality, calibration: Calibration, settings: LocalizeSettings
) -> Location:
    """Where the fish is and how long, by eq. (13): |H'T'| times the bending ratio of the fit.

    Without `settings.bending` the length is |H'T'| alone. Raises Unlocatable.
    """
    numbers = (shape.keypoints, shape.keypoints_px, shape.midline)
    if not all(np.isfinite(array).all() for array in numbers):
        raise Unlocatable(Reason.POOR_FIT)
    ratio = bend(shape)
    if ratio is None:
        raise Unlocatable(Reason.KEYPOINTS_COINCIDE)
    if settings.rests_on_plane:
        keypoints_mm, height_std = lying_keypoints(shape, ratio, calibration)
    else:
        keypoints_mm = locate_keypoints(shape.keypoints, shape.keypoints_px, calibration)
        height_std = 0.0
    chord_mm = float(np.linalg.norm(keypoints_mm[0] - keypoints_mm[2]))
    length_mm = chord_mm * ratio if settings.bending else chord_mm
    slant_rad = slant(keypoints_mm)
    missed = misfit(shape.iou, quality.mask_area_px, shape.keypoints_px)
    parts = [
        shape.length_std_ratio,
        # Two joints can't follow every bend, and the outline doesn't show it.
        settings.bending_std * (1.0 - chord_mm / length_mm),
        # The length is the seen length over cos(slant): d log / d slant is tan(slant).
        settings.slant_std_rad * np.tan(slant_rad),
        # A misfit of the body may be anything; little of it is the mask's own roughness.
        settings.misfit_std * (missed / 0.1) ** 3,
    ]
    std_mm = length_mm * float(np.linalg.norm(parts))
    # A fish hangs as far off the plane in its last frame as in its first, so this does not average
    # out over its frames. A center off the plane by d scales the whole fish by d over the camera's
    # distance from the plane, along its normal: |R_3 . T|, which is the depth where the camera
    # looks at it squarely.
    plane_std = settings.plane_std_mm / calibration.plane.distance_mm
    shared = [shape.shape_std_ratio or 0.0, plane_std, height_std, mask_std_ratio(quality)]
    # The center becomes C' and the chord |H'T'|, so that the arc length is the one of eq. (13).
    scale = chord_mm / np.linalg.norm(shape.midline[0] - shape.midline[-1])
    return Location(
        keypoints_mm=keypoints_mm,
        midline_mm=keypoints_mm[1] + scale * (shape.midline - shape.keypoints[1]),
        length_mm=length_mm,
        length_std_mm=std_mm if np.isfinite(std_mm) else None,
        shared_std_ratio=float(np.linalg.norm(shared)),
        slant_rad=slant_rad,
        bow_ratio=bow_ratio(shape.midline, keypoints_mm[1]),
        bending_ratio=ratio,
    )


def bow_ratio(midline: Float[np.ndarray, "M 3"], toward: Float[np.ndarray, "3"]) -> float:
    """How far a midline is from its chord in the direction `toward`, at most, over its length."""
    arc = arc_lengths(midline)
    share = (arc / arc[-1])[:, None]
    chord = midline[0] + share * (midline[-1] - midline[0])
    along = (midline - chord) @ toward / np.linalg.norm(toward)
    return float(np.abs(along).max() / arc[-1])


def lying_keypoints(
    shape: FittedShape, bending: float, calibration: Calibration
) -> tuple[Float[np.ndarray, "3 3"], float]:
    """H', C', T' in mm of a fish that lies on the plane, and the std of the log length by heights.

    Each keypoint is where its ray meets the plane of its own height: gravity determines how such a
    fish lies, so the fit's slants are not used. A point at height h, with the camera at distance D
    from the plane, is at 1 - h / D of its ray. Raises Unlocatable.
    """
    rays = calibration.camera.back_project(shape.keypoints_px)
    on_plane_mm = np.stack([center_on_plane(ray, calibration.plane) for ray in rays])
    distance_mm = calibration.plane.distance_mm
    keypoints_mm, half_thickness_mm = on_plane_mm, 0.0
    for _ in range(_HEIGHT_ROUNDS):
        chord_mm = float(np.linalg.norm(keypoints_mm[0] - keypoints_mm[2]))
        half_thickness_mm = (shape.height_ratio or 0.0) * chord_mm * bending
        nearer = np.clip(1 - _LYING_HEIGHTS * half_thickness_mm / distance_mm, 0.1, 1)
        keypoints_mm = on_plane_mm * nearer[:, None]
    end_std = np.hypot(_LYING_END_STD, _LYING_HEIGHTS[[0, 2]].mean() * _THICKNESS_STD)
    return keypoints_mm, float(end_std * half_thickness_mm / distance_mm)


def bend(shape: FittedShape) -> float | None:
    """Bending ratio of the fitted midline; None if its ends coincide or it isn't finite."""
    if not np.isfinite(shape.midline).all() or np.array_equal(shape.midline[0], shape.midline[-1]):
        return None
    return bending_ratio(shape.midline)


def slant(keypoints_mm: Float[np.ndarray, "3 3"]) -> float:
    """Angle in rad, 0 to pi / 2, of the chord H'T' from the plane across the center's ray."""
    head, center, tail = keypoints_mm
    along = abs(float((head - tail) @ center))
    return float(np.arcsin(min(along / np.linalg.norm(head - tail) / np.linalg.norm(center), 1.0)))


def quality_refusal(
    shape: FittedShape, quality: CropQuality, settings: LocalizeSettings
) -> Reason | None:
    """The first gate that a frame fails; None if it passes all."""
    missed = misfit(shape.iou, quality.mask_area_px, shape.keypoints_px)
    # "not >=" rather than "<", so that NaN fails
    checks = {
        Reason.TOUCHES_BORDER: settings.refuse_border and quality.touches_border,
        Reason.MOSTLY_HIDDEN: not quality.visible_fraction >= settings.min_visible_fraction,
        Reason.UNSURE_MASK: quality.mask_confidence is not None
        and not quality.mask_confidence >= settings.min_mask_confidence,
        Reason.END_NOT_SEEN: not (quality.missing_end or 0.0) <= settings.max_missing_end,
        Reason.POOR_FIT: not missed <= 1 - settings.min_iou,
        Reason.UNCERTAIN: not 0 <= shape.length_std_ratio <= settings.max_length_std_ratio,
    }
    return next((reason for reason, failed in checks.items() if failed), None)


def localize(
    mesh: FittedMesh, *, settings: LocalizeSettings, calibration: Calibration | None
) -> LocalizedFish:
    """Place one fit in millimetres and decide whether it may count towards the fish's length.

    A frame that fails a gate keeps its millimetres, if it has any, for reviewers.
    """
    if mesh.shape is None:
        return _message(mesh, mesh.refusal)
    if calibration is None:
        return _message(mesh, Reason.NO_CALIBRATION)
    reason = quality_refusal(mesh.shape, mesh.quality, settings)
    try:
        location = locate(mesh.shape, mesh.quality, calibration, settings)
        if location.slant_rad > settings.max_slant_rad:
            reason = reason or Reason.TURNED_AWAY
        is_bent = location.bending_ratio > settings.max_bending_ratio
        if is_bent or location.bow_ratio > settings.max_bow_ratio:
            reason = reason or Reason.BENT_TOO_FAR
        if mesh.quality.mask_area_px > arc_length(mesh.shape.keypoints_px) ** 2:
            reason = reason or Reason.KEYPOINTS_COINCIDE
        return _message(mesh, reason, location)
    except Unlocatable as problem:
        return _message(mesh, reason or problem.reason)


def _message(
    mesh: FittedMesh, reason: str | None, location: Location | None = None
) -> LocalizedFish:
    shape = mesh.shape
    return LocalizedFish(
        frame_index=mesh.frame_index,
        timestamp_ns=mesh.timestamp_ns,
        track_id=mesh.track_id,
        keypoints_px=None if shape is None else shape.keypoints_px,
        keypoints_mm=None if location is None else location.keypoints_mm,
        midline_mm=None if location is None else location.midline_mm,
        bending_ratio=None if shape is None else bend(shape),
        length_mm=None if location is None else location.length_mm,
        length_std_mm=None if location is None else location.length_std_mm,
        iou=None if shape is None else shape.iou,
        accepted=not reason,
        reason=reason or "",
        shared_std_ratio=None if location is None else location.shared_std_ratio,
        end_blur=mesh.quality.end_blur,
        species=mesh.species,
    )
