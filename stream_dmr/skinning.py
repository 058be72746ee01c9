"""The deformation of the template (paper, Sec. 2.1): eq. (1)-(2), and the spine that keeps length.

Both variants share their parameters: a root rotation, translation and scale, and for each joint a
rotation, a translation, a scale and the precision Q of its Gaussian skinning weight.

The root's translation has no depth: under a perspective camera depth and scale of one silhouette
can't be told apart, so the root stays at depth 1 and the localization finds the millimetres.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stream_dmr.template import Template

# Radius of a joint's Gaussian before it is learnt, in body lengths.
REST_WEIGHT_RADIUS = 0.25


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
    def from_flat(cls, flat: Float[Tensor, "B P"]) -> "Parameters":
        """Split P = 6 + 13 J columns."""
        batch, num_joints = flat.shape[0], (flat.shape[1] - 6) // 13
        root, joints = flat[:, :6], flat[:, 6:].reshape(batch, num_joints, 13)
        return cls(
            root_rotation=root[:, :3],
            root_translation=root[:, 3:5],
            root_log_scale=root[:, 5],
            joint_rotations=joints[..., :3],
            joint_translations=joints[..., 3:6],
            joint_log_scales=joints[..., 6],
            joint_precisions=joints[..., 7:],
        )

    def flat(self) -> Float[Tensor, "B P"]:
        """The inverse of `from_flat`."""
        root = torch.cat(
            [self.root_rotation, self.root_translation, self.root_log_scale[:, None]], dim=1
        )
        joints = torch.cat(
            [
                self.joint_rotations,
                self.joint_translations,
                self.joint_log_scales[..., None],
                self.joint_precisions,
            ],
            dim=2,
        )
        return torch.cat([root, joints.flatten(1)], dim=1)


def rest_parameters(num_joints: int, *, batch: int = 1) -> Float[Tensor, "B P"]:
    """Parameters of the template at rest, one body length at depth 1."""
    joint = torch.zeros(13, dtype=torch.float64)
    joint[7:10] = -np.log(REST_WEIGHT_RADIUS)
    root = torch.zeros(6, dtype=torch.float64)
    return torch.cat([root, joint.repeat(num_joints)]).repeat(batch, 1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Rig:
    """A template as tensors, its points bound to the midline: what a deformation works on.

    Points are the V vertices, the 3 keypoints and the M midline points, in this order.
    """

    points: Float[Tensor, "N 3"]
    faces: Int[Tensor, "F 3"]
    edges: Int[Tensor, "E 2"]  # each once, in the direction in which its first face runs
    edge_faces: Int[Tensor, "E 2"]  # the faces that run along and against the edge
    num_neighbors: Float[Tensor, "V"]  # of each vertex along the edges
    joints: Float[Tensor, "J 3"]
    midline: Float[Tensor, "M 3"]
    feet: Float[Tensor, "N 3"]  # of the points on the midline
    foot_segments: Int[Tensor, "N"]  # midline segment of each foot
    foot_fractions: Float[Tensor, "N"]  # place of the foot in its segment, 0 to 1
    num_vertices: int

    @classmethod
    def from_template(cls, template: Template, *, device: str = "cpu") -> "Rig":
        """Bind the template's points to its midline; float64 throughout."""
        points = np.concatenate([template.rest_vertices, template.keypoints, template.midline])
        segments, fractions, feet = bind_to_midline(points, template.midline)
        edges, edge_faces = _edges(template.faces)

        def tensor(array: np.ndarray) -> Tensor:
            return torch.as_tensor(array, device=device)

        return cls(
            points=tensor(points),
            faces=tensor(template.faces),
            edges=tensor(edges),
            edge_faces=tensor(edge_faces),
            num_neighbors=tensor(np.bincount(edges.ravel()).astype(np.float64)),
            joints=tensor(template.joints),
            midline=tensor(template.midline),
            feet=tensor(feet),
            foot_segments=tensor(segments),
            foot_fractions=tensor(fractions),
            num_vertices=len(template.rest_vertices),
        )


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
    and one scale S(s). The bent midline is the integral of S(s) R(s) m'(s), so bending alone
    can't change its length; each cross-section moves rigidly with the frame at its foot.
    """
    nodes = rig.midline
    middles = (nodes[1:] + nodes[:-1]) / 2
    rotation, scale, _ = _frames(rig, parameters, middles)
    steps = scale[..., None] * torch.einsum("bmkl,ml->bmk", rotation, nodes[1:] - nodes[:-1])
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


def deform(rig: Rig, flat: Float[Tensor, "B P"], deformation: Deformation) -> Deformed:
    """Deform vertices, keypoints and midline of the template together."""
    points = deformation(rig, Parameters.from_flat(flat))
    v = rig.num_vertices
    return Deformed(points[:, :v], points[:, v : v + 3], points[:, v + 3 :])


def skinning_weights(
    points: Float[Tensor, "N 3"], joints: Float[Tensor, "J 3"], precisions: Float[Tensor, "B J 6"]
) -> Float[Tensor, "B N J"]:
    """W_ji = C exp(-1/2 (V_i - V_j)^T Q_j (V_i - V_j)), eq. (2); rows sum to 1.

    Q = L L^T with a positive diagonal of L, so Q stays positive definite whatever is learnt.
    """
    L = _cholesky_factors(precisions)
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


def bind_to_midline(
    points: Float[np.ndarray, "N 3"], midline: Float[np.ndarray, "M 3"]
) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
    """Nearest place of each point on a polyline: its segment, the fraction in it, and the foot.

    Points past an end get that end as their foot.
    """
    start, step = midline[:-1], np.diff(midline, axis=0)
    along = np.einsum("nmk,mk->nm", points[:, None] - start, step) / (step**2).sum(axis=1)
    along = along.clip(0.0, 1.0)
    feet = start + along[..., None] * step
    segment = np.argmin(((points[:, None] - feet) ** 2).sum(axis=-1), axis=1)
    row = np.arange(len(points))
    return segment, along[row, segment], feet[row, segment]


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


def _cholesky_factors(precisions: Float[Tensor, "B J 6"]) -> Float[Tensor, "B J 3 3"]:
    """Lower triangular L from its logged diagonal and its entries (1,0), (2,0), (2,1)."""
    a, b, c = precisions[..., :3].exp().unbind(-1)
    d, e, f = precisions[..., 3:].unbind(-1)
    zero = torch.zeros_like(a)
    return torch.stack([a, zero, zero, d, b, zero, e, f, c], dim=-1).unflatten(-1, (3, 3))


def _edges(faces: Int[np.ndarray, "F 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Each edge of a closed mesh once, with the faces that run along and against it."""
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    face_of = {(a, b): i // 3 for i, (a, b) in enumerate(directed.tolist())}
    edges = [(a, b) for a, b in face_of if a < b]
    edge_faces = [(face_of[a, b], face_of[b, a]) for a, b in edges]
    return np.array(edges, np.int64), np.array(edge_faces, np.int64)
