"""The fish of Table 1: simulated passages of known lengths, each filmed by two cameras.

The rig: the simulator's camera (1280 x 960, about 1300 px focal length, some 5 m from the plane)
and a second one like it, 800 mm to its right, looking the same way; both are calibrated without
error. Masks come with the preset's ragged edges, drawn for each camera, and with the gaff and
the other fish in front. No picture is encoded: the labels of the film are used as they are.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from stream_dmr.camera import Calibration, ReferencePlane
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.crop import CropFishSettings, Detection, crop_fish
from stream_dmr.segmentation.open_segmenter import GrabCutSegmenter
from stream_dmr.simulation.film import FilmedFrame, film
from stream_dmr.simulation.rail_scene import FPS, RailScene, make_scene

FISH_PER_SCENE = 18  # 41 scenes, each with a camera and a plane of its own, are 738 fish
FRAMES_PER_SCENE = 151  # 12 of them for each fish
BASELINE_MM = 800.0
FIRST_SEED = 738_000
_SECOND_CAMERA_SEED = (
    1_000_000  # added to the seed: the second camera's masks have errors of their own
)
_CHAIN = CropFishSettings()
_STEREO = CropFishSettings(crop_size_px=256)  # about the frame's own resolution


class Sighting(NamedTuple):
    """One fish in one frame."""

    crop: FishCrop  # by the first camera, as the chain crops it
    pair: tuple[FishCrop, FishCrop] | None  # by both, larger; None where the second saw nothing
    other: FishCrop | None = None  # by the second camera, as the chain crops it


class FilmedScene(NamedTuple):
    """All that is seen of the fish of one scene, and the truth."""

    calibration: Calibration  # of the first camera
    truth_mm: dict[int, float]  # by track id
    frames: list[list[Sighting]]
    second: Calibration | None = None


def table_scene(index: int) -> RailScene:
    """The scene number `index` of the table, from 0."""
    return make_scene(
        num_fish=FISH_PER_SCENE,
        num_frames=FRAMES_PER_SCENE,
        preset="severe",
        seed=FIRST_SEED + index,
    )


def film_passages(scene: RailScene, *, with_second: bool) -> FilmedScene:
    """Film a scene; `with_second` by both cameras, which takes twice as long."""
    first = scene.calibration
    second = replace(scene, calibration=_beside(first), seed=scene.seed + _SECOND_CAMERA_SEED)
    if with_second:
        shots = zip(film(scene), film(second), strict=True)
    else:
        shots = ((shot, None) for shot in film(scene))
    return FilmedScene(
        calibration=first,
        second=second.calibration,
        truth_mm={visit.fish.track_id: visit.fish.length_mm for visit in scene.visits},
        frames=[list(_sightings(*pair, first, second.calibration)) for pair in shots],
    )


def _beside(calibration: Calibration) -> Calibration:
    """The second camera: all points lie further left for it."""
    plane = calibration.plane
    translation_mm = plane.translation_mm - np.array([BASELINE_MM, 0.0, 0.0])
    return Calibration(
        camera=calibration.camera,
        plane=ReferencePlane(rotation=plane.rotation, translation_mm=translation_mm),
    )


def _sightings(
    left: FilmedFrame, right: FilmedFrame | None, first: Calibration, second: Calibration
) -> Iterator[Sighting]:
    ours = dict(chain_crops(left, first))
    if right is None:
        yield from (Sighting(_seen(crop), None) for crop in ours.values())
        return
    lefts, rights = dict(_crops(left, first, _STEREO)), dict(_crops(right, second, _STEREO))
    theirs = dict(chain_crops(right, second))
    for track_id, crop in ours.items():
        both, other = None, None
        if track_id in rights:
            both, other = (_seen(lefts[track_id]), _seen(rights[track_id])), theirs[track_id]
        yield Sighting(_seen(crop), both, None if other is None else _seen(other))


def _seen(crop: FishCrop) -> FishCrop:
    """Without its picture, which no method looks at and which takes most of the memory."""
    return replace(crop, image=None)


def chain_crops(shot: FilmedFrame, calibration: Calibration) -> Iterator[tuple[int, FishCrop]]:
    """Every fish of a frame by its track id, with its picture, as the chain cuts it out."""
    yield from _crops(shot, calibration, _CHAIN)


def _crops(
    shot: FilmedFrame, calibration: Calibration, settings: CropFishSettings
) -> Iterator[tuple[int, FishCrop]]:
    """Every fish of a frame by its track id, cut out as the chain does from boxes and masks."""
    frame = Frame(
        frame_index=shot.frame_index,
        timestamp_ns=shot.frame_index * 1_000_000_000 // FPS,
        image=shot.image,
        source="simulation",
    )
    for box in shot.boxes:
        detection = Detection(
            source_id=box.track_id,
            bbox_xyxy_px=_corners(box.xywh_px),
            mask=shot.labels == box.track_id,
            visible_fraction=box.visible_fraction,
        )
        crop = crop_fish(
            frame,
            detection,
            frame_camera=calibration.camera,
            settings=settings,
            segmenter=GrabCutSegmenter(),  # not arguments: the mask is given
        )
        yield box.track_id, replace(crop, track_id=box.track_id)


def _corners(xywh_px: tuple[int, int, int, int]) -> Float[np.ndarray, "4"]:
    x, y, width, height = xywh_px
    return np.array([x, y, x + width, y + height], np.float64)
