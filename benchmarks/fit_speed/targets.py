"""Masks to fit: simulated fish, frame after frame, and bodies that the template matches exactly."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from stream_dmr.camera import Camera
from stream_dmr.fitting.body import (
    JOINT_ROTATION,
    LOG_SIZE,
    NUM_PER_JOINT,
    NUM_ROOT,
    ROOT_ROTATION,
    ROOT_TRANSLATION,
    Body,
    rest_vector,
)
from stream_dmr.fitting.solver.spine import KINDS, deform
from stream_dmr.messages import CropQuality, FishCrop, Frame
from stream_dmr.segmentation.crop import CropFishSettings, Detection, crop_fish
from stream_dmr.segmentation.open_segmenter import GrabCutSegmenter
from stream_dmr.simulation.rail_scene import RailScene, Visit, make_scene
from stream_dmr.simulation.simulated_fish import (
    HALIBUT,
    JOINT_ARCS,
    SimulatedBody,
    keypoints,
    straight_body,
)
from stream_dmr.template.template import Template, canonical_template
from tests.support.simulated_view import draw_mask

_NUM_FRAMES = 60


class FramePair(NamedTuple):
    """One fish in two frames, one after the other, and the normal of the plane that it hangs in."""

    before: FishCrop
    now: FishCrop
    plane_normal: Float[np.ndarray, "3"]


class KnownTarget(NamedTuple):
    """A crop of the template itself, bent by the fit's own deformation: IoU 1 can be reached."""

    crop: FishCrop
    parameters: Float[np.ndarray, "P"]
    bend_rad: float


def species_template() -> Template:
    """The simulated species' mean body."""
    return body_template(HALIBUT)


def body_template(simulated: SimulatedBody) -> Template:
    """A simulated body with 577 vertices: as fine as the bundled templates."""
    mesh = straight_body(simulated, num_rings=36, num_sides=16)
    points = {"keypoints": keypoints(), "joints": keypoints(JOINT_ARCS)}
    body = trimesh.Trimesh(mesh.points, mesh.faces, process=False)
    return canonical_template(body, points, name="simulated halibut")


def draw_pair(*, size: int, seed: int, preset: str = "realistic") -> FramePair:
    """A random fish in the middle of its passage, whole in both frames, cut out at `size` px."""
    scene = make_scene(num_fish=1, num_frames=_NUM_FRAMES, preset=preset, seed=seed)
    visit = scene.visits[0]
    middle = visit.first_frame + len(visit.poses) // 2
    before, now = (_crop(scene, visit, index, size=size) for index in (middle - 1, middle))
    return FramePair(before, now, np.ascontiguousarray(scene.calibration.plane.rotation[:, 2]))


def draw_known(body: Body, *, size: int, seed: int, most_bend_rad: float) -> KnownTarget:
    """Any turn in the picture, up to 40 degrees of roll and 15 of tilt, bent about any axis."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_euler(
        "zyx", [rng.uniform(-np.pi, np.pi), rng.normal(0, 0.13), rng.uniform(-0.7, 0.7)]
    )
    bend, slant = rng.uniform(0, most_bend_rad), rng.uniform(0, 2 * np.pi)
    parameters = rest_vector(len(body.joints))
    parameters[ROOT_ROTATION] = turn.as_rotvec()
    joints = parameters[NUM_ROOT:].reshape(-1, NUM_PER_JOINT)
    share = np.linspace(-0.5, 0.5, len(joints))[:, None]
    axis = np.array([0.0, np.cos(slant), np.sin(slant)])
    joints[:, JOINT_ROTATION] = _joint_bend(body, parameters, share * axis, bend) * share * axis
    return _known_crop(body, parameters, size=size, bend_rad=bend)


def _joint_bend(
    body: Body, parameters: Float[np.ndarray, "P"], turns: Float[np.ndarray, "J 3"], bend: float
) -> float:
    """How far the joints turn so that head and tail differ by `bend`: weights aren't 0 and 1."""
    low, high = 0.0, 2.0 * bend + 1e-3
    for _ in range(30):
        middle = (low + high) / 2
        trial = parameters.copy()
        trial[NUM_ROOT:].reshape(-1, NUM_PER_JOINT)[:, JOINT_ROTATION] = middle * turns
        steps = np.diff(deform(body, KINDS["spine"], trial)[body.num_vertices + 3 :], axis=0)
        ends = steps[[0, -1]] / np.linalg.norm(steps[[0, -1]], axis=1, keepdims=True)
        low, high = (middle, high) if np.arccos(ends[0] @ ends[1]) < bend else (low, middle)
    return low


def _known_crop(
    body: Body, parameters: Float[np.ndarray, "P"], *, size: int, bend_rad: float
) -> KnownTarget:
    """The body in the middle of a crop, filling all but 15 % on each side."""
    parameters = parameters.copy()
    parameters[LOG_SIZE] = np.log(0.12)
    for _ in range(3):  # depth differs along the body, so centering takes a few rounds
        points, low, high = _placed(body, parameters)
        parameters[ROOT_TRANSLATION] -= (low + high) / 2 / np.exp(parameters[LOG_SIZE])
    points, low, high = _placed(body, parameters)
    focal = 0.77 * size / float((high - low).max())
    middle = (size - 1) / 2
    K = np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])
    camera = Camera(width=size, height=size, K=K, distortion=np.zeros(5))
    mask = draw_mask(points, body.faces, camera=camera)
    return KnownTarget(crop_of_mask(mask, camera), parameters, bend_rad)


def _placed(
    body: Body, parameters: Float[np.ndarray, "P"]
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Vertices before the camera, and the corners of the box around their rays."""
    points = deform(body, KINDS["spine"], parameters)[: body.num_vertices] + np.array(
        [0.0, 0.0, 1.0]
    )
    rays = points[:, :2] / points[:, 2:]
    return points, rays.min(axis=0), rays.max(axis=0)


def _crop(scene: RailScene, visit: Visit, frame_index: int, *, size: int) -> FishCrop:
    camera = scene.calibration.camera
    posed = scene.pose(visit, frame_index)
    mask = draw_mask(posed.vertices, posed.faces, camera=camera)
    detection = Detection(source_id=1, bbox_xyxy_px=_box(mask), visible_fraction=1.0, mask=mask)
    image = np.zeros((*mask.shape, 3), np.uint8)
    frame = Frame(frame_index=frame_index, timestamp_ns=0, image=image, source="simulation")
    settings = CropFishSettings(crop_size_px=size)
    crop = crop_fish(
        frame, detection, frame_camera=camera, settings=settings, segmenter=GrabCutSegmenter()
    )
    return replace(crop, track_id=1)


def _box(mask: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "4"]:
    rows, columns = np.nonzero(mask)
    return np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], np.float64)


def crop_of_mask(mask: Bool[np.ndarray, "S S"], camera: Camera) -> FishCrop:
    """A crop without a picture."""
    return FishCrop(
        frame_index=1,
        timestamp_ns=0,
        track_id=1,
        bbox_xyxy_px=_box(mask),
        image=np.zeros((*mask.shape, 3), np.uint8),
        mask=mask,
        crop_camera=camera,
        frame_camera=camera,
        quality=CropQuality(
            touches_border=False,
            visible_fraction=1.0,
            sharpness=0.0,
            mask_area_px=float(mask.sum()),
        ),
    )
