"""The frames of a scene: pictures, label masks and boxes. The truth is not made here."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int16, UInt8, UInt16

from stream_dmr.simulation.backdrop import Backdrop, draw_gaff, draw_hook, draw_line
from stream_dmr.simulation.rail_scene import RailScene, Visit
from stream_dmr.simulation.render import Patch, draw_fish_patch, frame_window, paste
from stream_dmr.simulation.simulated_fish import PosedFish

# Keys of independent streams of random numbers; `rail_scene` and `skin` have the others.
_BACKDROP, _FRAME, _SENSOR = 8, 9, 10
_GAFF_FROM, _GAFF_UNTIL = 0.36, 0.66  # of a fish's visit; chosen
_NOISE_MARGIN_PX = 256
_MIN_BOX_PIXELS = 30  # a fish with fewer visible pixels has no box; chosen


@dataclass(frozen=True, eq=False, kw_only=True)
class VisibleBox:
    """The tight box around the visible mask of one fish in one frame."""

    frame_index: int
    track_id: int
    xywh_px: tuple[int, int, int, int]
    visible_fraction: float  # of its silhouette's pixels: not hidden, not outside the picture


@dataclass(frozen=True, eq=False, kw_only=True)
class FilmedFrame:
    """One frame with its annotations."""

    frame_index: int
    image: UInt8[np.ndarray, "H W 3"]
    labels: UInt16[np.ndarray, "H W"]  # track id, 0 is background
    boxes: list[VisibleBox]


def film(scene: RailScene) -> Iterator[FilmedFrame]:
    """The frames of a scene, from 1; the same scene gives the same frames."""
    camera = scene.calibration.camera
    backdrop = Backdrop(
        np.random.default_rng((scene.seed, _BACKDROP)), width=camera.width, height=camera.height
    )
    noise = _draw_sensor_noise(scene)
    for frame_index in range(1, scene.num_frames + 1):
        yield _render_frame(scene, backdrop, noise, frame_index)


def _render_frame(
    scene: RailScene, backdrop: Backdrop, noise: Int16[np.ndarray, "A B 3"], frame_index: int
) -> FilmedFrame:
    rng = np.random.default_rng((scene.seed, _FRAME, frame_index))
    image = backdrop.draw(frame_index)
    labels = np.zeros(image.shape[:2], np.uint16)
    num_pixels: dict[int, int] = {}
    visits = scene.visits_at(frame_index)
    posed = {visit.fish.track_id: scene.pose(visit, frame_index) for visit in visits}
    # Far ones first, so that near ones cover them.
    for visit in sorted(visits, key=lambda v: -posed[v.fish.track_id].keypoints[1, 2]):
        track_id = visit.fish.track_id
        patch = _draw_fish(scene, visit, posed[track_id], image, backdrop, frame_index)
        mask = ragged(patch.mask, rng, amplitude_px=scene.preset.ragged_px)
        rows, columns, inside = frame_window(patch, image.shape[1], image.shape[0])
        labels[rows, columns][mask[inside]] = track_id
        num_pixels[track_id] = int(mask.sum())
    for visit in visits:
        labels[_draw_gaff(scene, visit, posed[visit.fish.track_id], image, frame_index)] = 0
    return FilmedFrame(
        frame_index=frame_index,
        image=_expose(image, rng, noise),
        labels=labels,
        boxes=_boxes(labels, num_pixels, frame_index),
    )


def ragged(
    mask: Bool[np.ndarray, "H W"], rng: np.random.Generator, *, amplitude_px: float
) -> Bool[np.ndarray, "H W"]:
    """Shift the outline by smooth noise of this standard deviation, like a segmenter's errors."""
    if amplitude_px == 0.0:
        return mask
    inside = mask.astype(np.uint8)
    # Distance to the outline, which lies half a pixel beyond the outermost pixel centres.
    depth = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - 0.5
    distance = np.where(mask, depth, 0.5 - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5))
    shift = cv2.GaussianBlur(rng.standard_normal(mask.shape, np.float32), (0, 0), 4.0)
    return distance + amplitude_px * shift / shift.std() > 0.0


def _draw_fish(
    scene: RailScene,
    visit: Visit,
    posed: PosedFish,
    image: UInt8[np.ndarray, "H W 3"],
    backdrop: Backdrop,
    frame_index: int,
) -> Patch:
    """Draw line, fish and hook into the picture; return the fish's patch."""
    camera, preset = scene.calibration.camera, scene.preset
    mouth_px, center_px = camera.project(posed.keypoints)[:2]
    patch = draw_fish_patch(posed, camera=camera, seed=scene.seed)
    draw_line(image, mouth_px=mouth_px, roller_px=backdrop.roller_px)
    motion = (center_px - _center_before(scene, visit, frame_index)) * preset.exposure_frames
    paste(image, patch, defocus_px=preset.defocus_px, motion_px=motion)
    draw_hook(image, mouth_px=mouth_px)
    return patch


def _center_before(scene: RailScene, visit: Visit, frame_index: int) -> Float[np.ndarray, "2"]:
    """Pixel of the center keypoint one frame ago; in the first frame, of this frame."""
    earlier = scene.pose(visit, max(frame_index - 1, visit.first_frame))
    return scene.calibration.camera.project(earlier.keypoints)[1]


def _draw_gaff(
    scene: RailScene,
    visit: Visit,
    posed: PosedFish,
    image: UInt8[np.ndarray, "H W 3"],
    frame_index: int,
) -> Bool[np.ndarray, "H W"]:
    """Draw the gaff across a gaffed fish, for a third of its visit; return the covered pixels."""
    progress = visit.progress(frame_index)
    if not visit.is_gaffed or progress is None or not _GAFF_FROM <= progress <= _GAFF_UNTIL:
        return np.zeros(image.shape[:2], bool)
    stroke = (progress - _GAFF_FROM) / (_GAFF_UNTIL - _GAFF_FROM)
    keypoints_px = scene.calibration.camera.project(posed.keypoints)
    target = keypoints_px[0] + (0.25 + 0.5 * stroke) * (keypoints_px[2] - keypoints_px[0])
    side = 1.0 if visit.fish.track_id % 2 else -1.0
    hand = np.array([target[0] + side * 560.0, -30.0])
    reach = (target - hand) / np.linalg.norm(target - hand)
    return draw_gaff(image, hand_px=hand, tip_px=target + 70.0 * reach)


def _boxes(
    labels: UInt16[np.ndarray, "H W"], num_pixels: dict[int, int], frame_index: int
) -> list[VisibleBox]:
    """Tight boxes of the visible masks; a pixel extends from its index to the next."""
    boxes = []
    for track_id, pixels in sorted(num_pixels.items()):
        visible = (labels == track_id).astype(np.uint8)
        seen = int(cv2.countNonZero(visible))
        if seen >= _MIN_BOX_PIXELS:
            x, y, width, height = cv2.boundingRect(visible)
            boxes.append(
                VisibleBox(
                    frame_index=frame_index,
                    track_id=track_id,
                    xywh_px=(x, y, width, height),
                    visible_fraction=seen / pixels,
                )
            )
    return boxes


def _draw_sensor_noise(scene: RailScene) -> Int16[np.ndarray, "A B 3"]:
    """Noise in grey levels, larger than the frames; every frame takes a random window of it.

    Independent noise for every frame would take longer than all the rest.
    """
    rng = np.random.default_rng((scene.seed, _SENSOR))
    camera = scene.calibration.camera
    size = (camera.height + _NOISE_MARGIN_PX, camera.width + _NOISE_MARGIN_PX, 3)
    noise = scene.preset.noise_levels * rng.standard_normal(size, np.float32)
    return np.round(noise).astype(np.int16)


def _expose(
    image: UInt8[np.ndarray, "H W 3"], rng: np.random.Generator, noise: Int16[np.ndarray, "A B 3"]
) -> UInt8[np.ndarray, "H W 3"]:
    """The picture with sensor noise added."""
    height, width = image.shape[:2]
    y, x = rng.integers(_NOISE_MARGIN_PX, size=2)
    return cv2.add(image, noise[y : y + height, x : x + width], dtype=cv2.CV_8U)
