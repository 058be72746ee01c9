"""Small bodies, their poses and their exact crops: what the tests of template to fit share."""

import numpy as np
import torch
import trimesh
from hypothesis import strategies as st

from stream_dmr.camera import Camera
from stream_dmr.fitting.body import rest_vector
from stream_dmr.fitting.paper.torch_body import Deformed, Rig, deform, project, silhouette, spine
from stream_dmr.messages import CropQuality, FishCrop
from stream_dmr.template.template import canonical_template

# Small tensors: threads cost more than they bring, tenfold where test runs share the cores.
torch.set_num_threads(1)

seeds = st.integers(0, 2**32 - 1)

# Off the axis, so that nothing passes only because the midline is straight.
POINTS = {
    "keypoints": np.array([[-0.40, 0.02, 0.0], [0.03, 0.0, 0.0], [0.42, -0.01, 0.005]]),
    "joints": np.array([[-0.15, 0.03, 0.006], [0.17, -0.02, 0.0]]),
}
STRAIGHT = {
    "keypoints": np.array([[-0.42, 0.0, 0.0], [0.0, 0.0, 0.0], [0.42, 0.0, 0.0]]),
    "joints": np.array([[-0.14, 0.0, 0.0], [0.18, 0.0, 0.0]]),
}


def fish_mesh(*, subdivisions=1):
    """A closed body with a blunt head at -x and a slender tail: 12, 42, 162, ... vertices."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    x, y, z = mesh.vertices.T
    taper = 1 - 0.7 * x
    return trimesh.Trimesh(
        np.stack([0.5 * x, 0.16 * y * taper, 0.06 * z * taper], axis=1), mesh.faces, process=False
    )


def fish_template(*, subdivisions=1, points=POINTS):
    return canonical_template(fish_mesh(subdivisions=subdivisions), points, name="fish")


def fish_rig(*, subdivisions=1, points=POINTS, device="cpu"):
    return Rig.from_template(fish_template(subdivisions=subdivisions, points=points), device=device)


def rest_parameters(num_joints, *, batch=1):
    """A batch of parameters of the template at rest, one body length at depth 1."""
    return torch.as_tensor(rest_vector(num_joints)).repeat(batch, 1)


def random_flat(rng, *, batch=1, num_joints=2, size=1.0):
    """Parameters with everything in motion; `size` 1 is about as wild as a fish gets."""
    flat = rest_parameters(num_joints, batch=batch)
    step = size * np.array(
        [1.0] * 3 + [0.1] * 2 + [0.3] + ([0.5] * 3 + [0.05] * 3 + [0.1] + [0.3] * 6) * num_joints
    )
    return flat + torch.as_tensor(rng.normal(size=flat.shape) * step)


def pose(rng, *, in_plane_rad, scale=0.25, bend_rad=0.35):
    """Parameters of a hooked fish that mostly shows its broad side, rigid but for its bends."""
    flat = rest_parameters(2)
    flat[0, :3] = torch.as_tensor([*rng.normal(size=2) * 0.15, in_plane_rad])
    flat[0, 5] = np.log(scale)
    flat[0, 6:].view(2, 13)[:, :3] = torch.as_tensor(
        rng.normal(size=(2, 3)) * [0.15, 0.15, bend_rad]
    )
    return flat


FRAME_CAMERA = Camera(
    width=1920,
    height=1080,
    K=np.array([[1500.0, 0, 960], [0, 1490.0, 540], [0, 0, 1]]),
    distortion=np.array([-0.1, 0.02, 0.001, -0.001, 0.0]),
)


def crop_camera(*, size=96):
    """Looks past the middle of the frame, so that the crop's principal point lies outside it."""
    return FRAME_CAMERA.crop(center_px=np.array([1300.0, 400.0]), side_px=500.0, size=size)


def anchor(camera):
    """Where a fit's root rests: at depth 1 on the ray through the middle of the crop."""
    middle = np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]])
    return torch.as_tensor(camera.back_project(middle)[0])


def picture(flat, rig, camera) -> tuple[np.ndarray, Deformed]:
    """The exact silhouette of a deformed template, and the deformed template."""
    deformed = deform(rig, flat, spine)
    pixels = project(deformed.vertices + anchor(camera), torch.as_tensor(camera.K))
    return silhouette(pixels, rig, size=camera.width)[0].numpy(), deformed


def crop_from_mask(mask, *, camera=None, frame_index=1, track_id=1):
    return FishCrop(
        frame_index=frame_index,
        timestamp_ns=40_000_000 * frame_index,
        track_id=track_id,
        bbox_xyxy_px=np.array([1050.0, 150.0, 1550.0, 650.0]),
        image=np.zeros((*mask.shape, 3), np.uint8),
        mask=mask,
        crop_camera=camera or crop_camera(size=len(mask)),
        frame_camera=FRAME_CAMERA,
        quality=CropQuality(
            touches_border=False, visible_fraction=1.0, sharpness=1.0, mask_area_px=4.0 * mask.sum()
        ),
    )


def crop_of(flat, rig, *, size=96, frame_index=1, track_id=1):
    """The crop that an errorless segmenter makes of a deformed template."""
    camera = crop_camera(size=size)
    covered, _ = picture(flat, rig, camera)
    return crop_from_mask(covered >= 0.5, camera=camera, frame_index=frame_index, track_id=track_id)
