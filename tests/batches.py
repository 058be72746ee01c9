"""Devices and small batches of fits: what the tests of the batched solver share."""

import numpy as np
import pytest
import torch
from shapes import POINTS, crop_of, fish_template, pose, random_flat

from stream_dmr.body import JOINT, ROOT, Body
from stream_dmr.fitting.batched.model import Model
from stream_dmr.fitting.batched.targets import Targets
from stream_dmr.fitting.settings import FitMeshSettings
from stream_dmr.fitting.target import Target
from stream_dmr.skinning import Rig
from stream_dmr.template import load_template

THREE_JOINTS = {
    **POINTS,
    "joints": np.array([[-0.2, 0.03, 0.006], [0.0, -0.01, 0.002], [0.2, -0.02, 0.0]]),
}
TEMPLATES = {
    "2 joints": fish_template(),
    "3 joints": fish_template(points=THREE_JOINTS),
    "halibut": load_template("halibut"),
}
BODIES = {name: Body.from_template(template) for name, template in TEMPLATES.items()}
RIGS = {name: Rig.from_template(template) for name, template in TEMPLATES.items()}
# A plane that looks past the camera, so that no component of its normal is 0.
PLANE_NORMAL = np.array([0.2, -0.3, 0.93]) / np.linalg.norm([0.2, -0.3, 0.93])

every_device = pytest.mark.parametrize(
    "device",
    [
        "cpu",
        pytest.param(
            "cuda",
            marks=pytest.mark.skipif(
                not torch.cuda.is_available(), reason="needs a GPU and a CUDA build of torch"
            ),
        ),
    ],
)


def exactly(device):
    """Where tensors are made, in float64."""
    return {"device": device, "dtype": torch.float64}


def model_of(name, device, **settings):
    return Model.from_body(BODIES[name], FitMeshSettings(**settings), **exactly(device))


def motions(name, seed, *, batch=3, size=0.5):
    """Parameters with everything in motion, about a third of the picture large."""
    num_joints = len(TEMPLATES[name].joints)
    flats = random_flat(np.random.default_rng(seed), batch=batch, num_joints=num_joints, size=size)
    flats[:, 5] += np.log(0.25)
    return flats


def crops_of_poses(name, seed, *, batch=3, size=96):
    """Crops of hooked fish and the parameters that they were drawn with."""
    rng = np.random.default_rng(seed)
    flats = [pose(rng, in_plane_rad=rng.uniform(-np.pi, np.pi)) for _ in range(batch)]
    crops = [crop_of(flat, RIGS[name], size=size) for flat in flats]
    return crops, torch.cat(flats).numpy()


def targets_of(crops, device):
    """As the CPU has them, and stacked on a device."""
    ours = [Target.from_crop(crop, plane_normal=PLANE_NORMAL) for crop in crops]
    return ours, Targets.stack(ours, **exactly(device))


def moved(flats, seed, *, size=1.0):
    """Parameters some pixels off, as fish may have moved since the frame before."""
    rng, near = np.random.default_rng(seed), flats.copy()
    near[:, :ROOT] += (
        size * rng.normal(size=(len(near), ROOT)) * [0.08, 0.08, 0.08, 0.03, 0.03, 0.04]
    )
    joints = near[:, ROOT:].reshape(len(near), -1, JOINT)
    joints[..., :3] += size * rng.normal(size=joints[..., :3].shape) * 0.08
    return near


def numpy(tensor):
    return tensor.detach().cpu().numpy()
