"""The deformation of the template (paper, Sec. 2.1): eq. (1)-(2), and the spine that keeps length.

Both variants share their parameters: a root rotation, translation and scale, and for each joint a
rotation, a translation, a scale and the precision Q of its Gaussian skinning weight.

The root's translation has no depth: under a perspective camera depth and scale of one silhouette
can't be distinguished, so the root stays at depth 1 and the localization finds the millimetres.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stream_dmr.fitting.body import Body
from stream_dmr.fitting.parameters import (
    JOINT_LOG_SCALE,
    JOINT_ROTATION,
    JOINT_TRANSLATION,
    JOINT_WEIGHT,
    LOG_SIZE,
    NUM_PER_JOINT,
    NUM_ROOT,
    ROOT_ROTATION,
    ROOT_TRANSLATION,
)
from stream_dmr.template.template import Template


class Parameters(NamedTuple):
    """The parameters of a batch of B deformations with J joints, as views of one (B, P) tensor."""

    root_rotation: Float[Tensor, "B 3"]  # rotation vector, rad
    root_translation: Float[Tensor, "B 2"]  # x, y of the camera frame, body lengths
    root_log_scale: Float[Tensor, "B"]  # log of the body length over the depth
    joint_rotations: Float[Tensor, "B J 3"]  # rotation vectors, rad
    joint_translations: Float[Tensor, "B J 3"]  # body lengths
    joint_log_scales: Float[Tensor, "B J"]
    joint_precisions: Float[Tensor, "B J 6"]  # Cholesky factor of Q, its diagonal as logs

    @classmethod
    def from_vector(cls, vector: Float[Tensor, "B P"]) -> "Parameters":
        """Split vectors as `stream_dmr.fitting.parameters` lays them out."""
        joints = vector[:, NUM_ROOT:].unflatten(1, (-1, NUM_PER_JOINT))
        return cls(
            root_rotation=vector[:, ROOT_ROTATION],
            root_translation=vector[:, ROOT_TRANSLATION],
            root_log_scale=vector[:, LOG_SIZE],
            joint_rotations=joints[..., JOINT_ROTATION],
            joint_translations=joints[..., JOINT_TRANSLATION],
            joint_log_scales=joints[..., JOINT_LOG_SCALE],
            joint_precisions=joints[..., JOINT_WEIGHT],
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Rig:
    """A `Body` as tensors, float64 throughout."""

    points: Float[Tensor, "N 3"]
    faces: Int[Tensor, "F 3"]
    edges: Int[Tensor, "E 2"]
    edge_faces: Int[Tensor, "E 2"]
    num_neighbors: Float[Tensor, "V"]  # of each vertex along the edges
    joints: Float[Tensor, "J 3"]
    midline: Float[Tensor, "M 3"]
    feet: Float[Tensor, "N 3"]  # of the points on the midline
    foot_segments: Int[Tensor, "N"]  # midline segment of each foot
    foot_fractions: Float[Tensor, "N"]  # place of the foot in its segment, 0 to 1
    num_vertices: int

    @classmethod
    def from_template(cls, template: Template, *, device: str = "cpu") -> "Rig":
        """Bind a template's points to its midline and move it to a device."""
        body = Body.from_template(template)
        arrays = {
            "points": body.points,
            "faces": body.faces,
            "edges": body.edges,
            "edge_faces": body.edge_faces,
            "num_neighbors": np.diff(body.edge_starts).astype(float),
            "joints": body.joints,
            "midline": body.midline,
            "feet": body.places[body.place_of],
            "foot_segments": body.segments[body.place_of],
            "foot_fractions": body.fractions[body.place_of],
        }
        tensors = {name: torch.as_tensor(array, device=device) for name, array in arrays.items()}
        return cls(**tensors, num_vertices=body.num_vertices)


class Deformed(NamedTuple):
    """A batch of deformed templates, centered on the root, in units of the root's depth."""

    vertices: Float[Tensor, "B V 3"]
    keypoints: Float[Tensor, "B 3 3"]
    midline: Float[Tensor, "B M 3"]


Deformation = Callable[[Rig, Parameters], Float[Tensor, "B N 3"]]


def linear_blend(rig: Rig, parameters: Parameters) -> Float[Tensor, "B N 3"]:
    """Eq. (1) and (2) to the letter: the joints' rotation matrices are blended as matrices.

    A blend of rotations is no rotation: it shrinks the middle of a bent body.
    """
    weights = skinning_weights(rig.points, rig.joints, parameters.joint_precisions)
    rotations = rotation_matrices(parameters.joint_rotations)
    root = rotation_matrices(parameters.root_rotation)
    # Rotation: V <- R_0 (sum_j W_j R_j) V
    blended = torch.einsum("bnj,bjkl->bnkl", weights, rotations)
    points = torch.einsum("bkl,bnlm,nm->bnk", root, blended, rig.points)
    # Translation: V <- T_0 + (sum_j W_j T_j) + V
    points = points + weights @ parameters.joint_translations
    points = points + _with_depth(parameters.root_translation)[:, None]
    # Scaling: V <- S_0 (sum_j W_j S_j) V
    scale = torch.einsum("bnj,bj->bn", weights, parameters.joint_log_scales.exp())
    return points * scale[..., None] * parameters.root_log_scale.exp()[:, None, None]


def spine(rig: Rig, parameters: Parameters) -> Float[Tensor, "B N 3"]:
    """The length-keeping variant: rotations are blended as rotations, and the body is swept.

    At each place s of the midline the joints give one rotation R(s) = exp(sum_j W_j(s) log R_j)
    and one scale S(s). The bent midline is the integral of R(s) m'(s), so its length is the root's
    scale alone; each cross-section moves with the frame at its foot, S(s) times as broad and thick.
    """
    nodes = rig.midline
    middles = (nodes[1:] + nodes[:-1]) / 2
    rotation, _, _ = _frames(rig, parameters, middles)
    steps = torch.einsum("bmkl,ml->bmk", rotation, nodes[1:] - nodes[:-1])
    bent = torch.cat([torch.zeros_like(steps[:, :1]), steps.cumsum(dim=1)], dim=1)
    place = bent[:, rig.foot_segments] + rig.foot_fractions[:, None] * steps[:, rig.foot_segments]
    center = place[:, rig.num_vertices + 1][:, None]  # the foot of the center keypoint is the root

    rotation, scale, shift = _frames(rig, parameters, rig.feet)
    offset = scale[..., None] * (rig.points - rig.feet) + shift
    points = place - center + torch.einsum("bnkl,bnl->bnk", rotation, offset)
    root = rotation_matrices(parameters.root_rotation)
    points = points @ root.transpose(1, 2) + _with_depth(parameters.root_translation)[:, None]
    return points * parameters.root_log_scale.exp()[:, None, None]


DEFORMATIONS: dict[str, Deformation] = {"spine": spine, "linear-blend": linear_blend}


def deform(rig: Rig, vector: Float[Tensor, "B P"], deformation: Deformation) -> Deformed:
    """Deform vertices, keypoints and midline of the template together."""
    points = deformation(rig, Parameters.from_vector(vector))
    v = rig.num_vertices
    return Deformed(points[:, :v], points[:, v : v + 3], points[:, v + 3 :])


def skinning_weights(
    points: Float[Tensor, "N 3"], joints: Float[Tensor, "J 3"], precisions: Float[Tensor, "B J 6"]
) -> Float[Tensor, "B N J"]:
    """W_ji = C exp(-1/2 (V_i - V_j)^T Q_j (V_i - V_j)), eq. (2); rows sum to 1.

    Q = L L^T with a positive diagonal of L, so Q stays positive definite whatever is learnt.
    """
    L = cholesky_factors(precisions)
    difference = points[:, None] - joints
    scaled = torch.einsum("bjkl,njk->bnjl", L, difference)
    return torch.softmax(-0.5 * scaled.square().sum(dim=-1), dim=-1)


def rotation_matrices(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rodrigues' formula, smooth at the identity."""
    x, y, z = rotvec.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    # The root of the sum is kept away from 0, where its derivative has no limit.
    angle = (rotvec.square().sum(dim=-1) + 1e-30).sqrt()[..., None, None]
    half = torch.sinc(angle / (2 * torch.pi))
    identity = torch.eye(3, dtype=rotvec.dtype, device=rotvec.device)
    return identity + torch.sinc(angle / torch.pi) * cross + 0.5 * half.square() * (cross @ cross)


def _frames(
    rig: Rig, parameters: Parameters, places: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, "B N 3 3"], Float[Tensor, "B N"], Float[Tensor, "B N 3"]]:
    """Blended rotation, scale and translation at places of the midline."""
    weights = skinning_weights(places, rig.joints, parameters.joint_precisions)
    rotation = rotation_matrices(weights @ parameters.joint_rotations)
    scale = torch.einsum("bnj,bj->bn", weights, parameters.joint_log_scales.exp())
    return rotation, scale, weights @ parameters.joint_translations


def _with_depth(translation: Float[Tensor, "B 2"]) -> Float[Tensor, "B 3"]:
    return torch.nn.functional.pad(translation, (0, 1))


def cholesky_factors(precisions: Float[Tensor, "B J 6"]) -> Float[Tensor, "B J 3 3"]:
    """Lower triangular L from its logged diagonal and its entries (1,0), (2,0), (2,1)."""
    a, b, c = precisions[..., :3].exp().unbind(-1)
    d, e, f = precisions[..., 3:].unbind(-1)
    zero = torch.zeros_like(a)
    return torch.stack([a, zero, zero, d, b, zero, e, f, c], dim=-1).unflatten(-1, (3, 3))
