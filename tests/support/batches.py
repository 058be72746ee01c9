"""Small batches of crops and poses that tests of fits share."""

import numpy as np
import torch

from stream_dmr.fitting.body import JOINT_ROTATION, NUM_PER_JOINT, NUM_ROOT
from stream_dmr.fitting.paper.torch_body import Rig
from stream_dmr.template.template_file import load_template
from tests.support.shapes import POINTS, crop_of, fish_template, pose

THREE_JOINTS = {
    **POINTS,
    "joints": np.array([[-0.2, 0.03, 0.006], [0.0, -0.01, 0.002], [0.2, -0.02, 0.0]]),
}
TEMPLATES = {
    "2 joints": fish_template(),
    "3 joints": fish_template(points=THREE_JOINTS),
    "halibut": load_template("halibut"),
}
RIGS = {name: Rig.from_template(template) for name, template in TEMPLATES.items()}
# A plane that looks past the camera, so that no component of its normal is 0.
PLANE_NORMAL = np.array([0.2, -0.3, 0.93]) / np.linalg.norm([0.2, -0.3, 0.93])


def crops_of_poses(name, seed, *, batch=3, size=96):
    """Crops of hooked fish and the parameters that they were drawn with."""
    rng = np.random.default_rng(seed)
    flats = [pose(rng, in_plane_rad=rng.uniform(-np.pi, np.pi)) for _ in range(batch)]
    crops = [crop_of(flat, RIGS[name], size=size) for flat in flats]
    return crops, torch.cat(flats).numpy()


def moved(flats, seed, *, size=1.0):
    """Parameters some pixels off, as fish may have moved since the frame before."""
    rng, near = np.random.default_rng(seed), flats.copy()
    near[:, :NUM_ROOT] += (
        size * rng.normal(size=(len(near), NUM_ROOT)) * [0.08, 0.08, 0.08, 0.03, 0.03, 0.04]
    )
    joints = near[:, NUM_ROOT:].reshape(len(near), -1, NUM_PER_JOINT)
    turns = joints[..., JOINT_ROTATION]
    turns += size * rng.normal(size=turns.shape) * 0.08
    return near
