"""Frames of a simulated scene before its backdrop."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int16, UInt8, UInt16

from stream_dmr.simulation.rail_scene import RailScene, Visit
from stream_dmr.simulation.render import Patch, draw_fish_patch, frame_window, paste
from stream_dmr.simulation.simulated_fish import PosedFish, noise

# The numbers of this file were chosen by eye.
_RAIL_PX = 58
_SEA_MARGIN_PX = 240  # amplitude of the drift of the layers of the sea
_GAFF_PX = 13
_SUBPIXEL = 4  # fractional bits, OpenCV's `shift`

# Colour map of the waves: grey level -> BGR, from troughs over green slopes to foam.
_SEA_STOPS = [0, 70, 130, 185, 212, 235, 255]
_SEA_BGR = np.array(
    [
        *([38, 30, 18], [66, 56, 34], [98, 88, 60], [140, 130, 100], [176, 170, 146]),
        *([218, 216, 205], [240, 240, 236]),
    ]
)


class Backdrop:
    """Sea and vessel of one scene; `draw(frame_index)` returns a new picture of them."""

    def __init__(self, rng: np.random.Generator, *, width: int, height: int) -> None:
        self._width, self._height = width, height
        big = (height + _SEA_MARGIN_PX, width + _SEA_MARGIN_PX)
        self._swell = _grey(
            0.8 * noise(rng, *big, grain_px=(90.0, 34.0)) + _ripples(rng, big, 11.0)
        )
        self._chop = _grey(_ripples(rng, big, 5.0) + 0.5 * _ripples(rng, big, 2.2))
        channels = [np.interp(np.arange(256), _SEA_STOPS, channel) for channel in _SEA_BGR.T]
        self._colours = np.stack(channels, axis=-1).astype(np.uint8)[:, None]
        self._rail, self._rail_mask = _draw_rail(rng, width)
        self._drift = rng.uniform(0.0, 2 * np.pi, 2)
        self.roller_px = np.array([width * rng.uniform(0.35, 0.65), _RAIL_PX - 14.0])
        _draw_roller(self._rail, self._rail_mask, self.roller_px)

    def draw(self, frame_index: int) -> UInt8[np.ndarray, "H W 3"]:
        """The sea at this frame, and the vessel in front of it, BGR."""
        swell = self._cut(self._swell, speed=0.021, frame_index=frame_index, phase=self._drift[0])
        chop = self._cut(self._chop, speed=-0.033, frame_index=frame_index, phase=self._drift[1])
        waves = cv2.addWeighted(swell, 0.62, chop, 0.38, 0.0)
        image = cv2.applyColorMap(waves, self._colours)
        top = image[: len(self._rail)]
        top[self._rail_mask] = self._rail[self._rail_mask]
        return image

    def _cut(
        self, layer: UInt8[np.ndarray, "A B"], *, speed: float, frame_index: int, phase: float
    ) -> UInt8[np.ndarray, "H W"]:
        turn = speed * frame_index + phase
        x, y = (np.array([np.cos(turn), np.sin(turn)]) + 1) / 2 * (_SEA_MARGIN_PX - 1)
        return layer[int(y) : int(y) + self._height, int(x) : int(x) + self._width]


def draw_line(
    image: UInt8[np.ndarray, "H W 3"],
    *,
    mouth_px: Float[np.ndarray, "2"],
    roller_px: Float[np.ndarray, "2"],
) -> None:
    """Draw the gangion from the fish's mouth up towards the roller, out of the picture."""
    top = np.array([(mouth_px[0] + roller_px[0]) / 2, -40.0])
    line = (_fixed(mouth_px), _fixed(top))
    cv2.line(image, *line, (52, 60, 62), 4, cv2.LINE_AA, _SUBPIXEL)
    cv2.line(image, *line, (186, 200, 200), 2, cv2.LINE_AA, _SUBPIXEL)


def draw_hook(image: UInt8[np.ndarray, "H W 3"], *, mouth_px: Float[np.ndarray, "2"]) -> None:
    """Draw the shank and bend of a circle hook in the fish's mouth, over the fish."""
    center = _fixed(mouth_px - np.array([2.5, 1.0]))
    axes = (4 << _SUBPIXEL, 5 << _SUBPIXEL)
    cv2.ellipse(image, center, axes, 0, -40, 200, (150, 156, 158), 2, cv2.LINE_AA, _SUBPIXEL)


def draw_gaff(
    image: UInt8[np.ndarray, "H W 3"],
    *,
    hand_px: Float[np.ndarray, "2"],
    tip_px: Float[np.ndarray, "2"],
) -> Bool[np.ndarray, "H W"]:
    """Draw a pole with a steel hook from hand to tip; return the pixels that it covers."""
    hand, tip = _fixed(hand_px), _fixed(tip_px)
    colours = ((44, 72, 104), _GAFF_PX), ((84, 122, 160), _GAFF_PX - 5), ((130, 165, 196), 2)
    for colour, thickness in colours:
        cv2.line(image, hand, tip, colour, thickness, cv2.LINE_AA, _SUBPIXEL)
    along = (tip_px - hand_px) / (np.linalg.norm(tip_px - hand_px) + 1e-9)
    bend = _fixed(tip_px + 12 * np.array([-along[1], along[0]]))
    angle = float(np.degrees(np.arctan2(along[1], along[0])))
    covered = np.zeros(image.shape[:2], np.uint8)
    arc = (bend, (12 << _SUBPIXEL, 12 << _SUBPIXEL), angle, -90, 110)
    cv2.ellipse(image, *arc, (165, 168, 168), 5, cv2.LINE_AA, _SUBPIXEL)
    cv2.ellipse(covered, *arc, 1, 5, cv2.LINE_8, _SUBPIXEL)
    cv2.line(covered, hand, tip, 1, _GAFF_PX, cv2.LINE_8, _SUBPIXEL)
    return covered.astype(bool)


def _fixed(pixel: Float[np.ndarray, "2"]) -> tuple[int, int]:
    """A pixel in OpenCV's fixed-point numbers, with `_SUBPIXEL` fractional bits."""
    x, y = np.round(pixel * (1 << _SUBPIXEL)).astype(int).tolist()
    return x, y


def _ripples(
    rng: np.random.Generator, size: tuple[int, int], grain: float
) -> Float32[np.ndarray, "A B"]:
    """Waves with crests: ridged noise, 2.6 times longer along x than along y."""
    ridged = 1 - np.abs(noise(rng, *size, grain_px=(2.6 * grain, grain)))
    return ridged.astype(np.float32)


def _grey(waves: Float32[np.ndarray, "A B"]) -> UInt8[np.ndarray, "A B"]:
    scaled = 110 + 48 * (waves - waves.mean()) / waves.std()
    return np.clip(scaled, 0, 255).astype(np.uint8)


def _draw_rail(
    rng: np.random.Generator, width: int
) -> tuple[UInt8[np.ndarray, "R W 3"], Bool[np.ndarray, "R W"]]:
    """Picture and mask of the vessel's side: painted steel with streaks of rust and a worn edge."""
    height = _RAIL_PX + 24
    slope = rng.uniform(-14.0, 14.0)
    edge = _RAIL_PX + slope * np.linspace(-1.0, 1.0, width)
    y = np.arange(height)[:, None]
    paint = 128 + 5 * noise(rng, height, width, grain_px=(30.0, 8.0))
    paint += 3 * noise(rng, height, width, grain_px=(1.0, 1.0))
    steel = paint[..., None] * np.array([0.92, 0.98, 0.96], np.float32)
    rust = np.clip(noise(rng, height, width, grain_px=(3.0, 26.0)) - 1.1, 0.0, 1.0)[..., None]
    steel = steel * (1 - rust) + rust * np.array([38, 66, 112], np.float32)
    lip = np.exp(-(((y - edge + 6) / 4.0) ** 2))[..., None]
    steel = steel * (1 - 0.55 * lip) + 0.55 * lip * 190
    steel *= (0.6 + 0.4 * np.clip((edge - y) / 4.0, 0.0, 1.0))[..., None]  # its shadowed underside
    return np.clip(steel, 0, 255).astype(np.uint8), y < edge


def _draw_roller(
    rail: UInt8[np.ndarray, "R W 3"], mask: Bool[np.ndarray, "R W"], center: Float[np.ndarray, "2"]
) -> None:
    """Draw the drum that the groundline runs over into `rail`, and add it to `mask`."""
    x, y = np.round(center).astype(int).tolist()
    covered = mask.astype(np.uint8)
    for half, colour in ((30, (40, 42, 44)), (24, (92, 96, 98)), (10, (150, 154, 156))):
        box = (x - 3 * half // 2, y - half // 2), (x + 3 * half // 2, y + half // 2)
        cv2.rectangle(rail, *box, colour, -1, cv2.LINE_AA)
        cv2.rectangle(covered, *box, 1, -1)
    mask |= covered.astype(bool)


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
    # Noise in grey levels, larger than the frames; every frame takes a random window of it:
    # independent noise for every frame would take longer than all the rest.
    size = (camera.height + _NOISE_MARGIN_PX, camera.width + _NOISE_MARGIN_PX, 3)
    rng = np.random.default_rng((scene.seed, _SENSOR))
    noise = scene.preset.noise_levels * rng.standard_normal(size, np.float32)
    noise = np.round(noise).astype(np.int16)
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
    # Far fish first, so that near fish cover them.
    for visit in sorted(visits, key=lambda v: -posed[v.fish.track_id].keypoints[1, 2]):
        track_id = visit.fish.track_id
        patch = _draw_fish(scene, visit, posed[track_id], image, backdrop, frame_index)
        mask = ragged(patch.mask, rng, amplitude_px=scene.preset.ragged_px)
        rows, columns, inside = frame_window(patch, image.shape[1], image.shape[0])
        labels[rows, columns][mask[inside]] = track_id
        num_pixels[track_id] = int(mask.sum())
    for visit in visits:
        labels[_draw_gaff(scene, visit, posed[visit.fish.track_id], image, frame_index)] = 0
    y, x = rng.integers(_NOISE_MARGIN_PX, size=2)
    grain = noise[y : y + image.shape[0], x : x + image.shape[1]]
    return FilmedFrame(
        frame_index=frame_index,
        image=cv2.add(image, grain, dtype=cv2.CV_8U),
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
    earlier = scene.pose(visit, max(frame_index - 1, visit.first_frame))
    motion = (center_px - camera.project(earlier.keypoints)[1]) * preset.exposure_frames
    paste(image, patch, defocus_px=preset.defocus_px, motion_px=motion)
    draw_hook(image, mouth_px=mouth_px)
    return patch


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
