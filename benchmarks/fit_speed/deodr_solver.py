"""The peer: DEODR (de La Gorce, Paragios and Fleet 2008; pip install deodr) driven by Adam.

DEODR draws the silhouette and takes it back; the deformation and the losses are ours, in torch, as
in the `adam` solver, with its step sizes. In DEODR's favour the loss has only the silhouette's two
terms and the two cheap regularisers, and one start at a time, which suits a renderer without
batches.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from deodr.differentiable_renderer import Scene2D
from jaxtyping import Float
from torch import Tensor

from stream_dmr.fitting.body import NUM_PER_JOINT, NUM_ROOT
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.paper import adam
from stream_dmr.fitting.paper.torch_body import Parameters, Rig, deform, project, spine
from stream_dmr.fitting.target import Target
from stream_dmr.template.template import Template


class DeodrSolver:
    """Adam on DEODR's antialiased silhouette."""

    def __init__(self, template: Template) -> None:
        self._rig = Rig.from_template(template, device="cpu")
        self._neighbors = face_neighbors(self._rig.faces.numpy())
        self._lambdas = torch.as_tensor(FitMeshSettings().lambdas()[:4])

    def descend(
        self,
        target: Target,
        start: Float[np.ndarray, "P"],
        *,
        iterations: int,
        step: float,
        watch: Callable[[float], None],
    ) -> None:
        """Minimise from one start; `watch` gets the hard IoU of every iterate."""
        scene = make_scene(self._rig, len(target.mask))
        mask, distance = torch.as_tensor(target.mask), torch.as_tensor(target.distance)
        K, anchor = torch.as_tensor(target.K), torch.as_tensor(target.anchor)
        origin = torch.as_tensor(start)[None]
        num_joints = (len(start) - NUM_ROOT) // NUM_PER_JOINT
        unit = step * torch.tensor(adam.ROOT_STEPS + adam.JOINT_STEPS * num_joints)
        moved = torch.zeros_like(origin, requires_grad=True)
        optimizer = torch.optim.Adam([moved], lr=1.0, betas=(0.8, 0.95))
        schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, adam.STEP_DECAY)
        for _ in range(iterations):
            vector = origin + moved * unit
            vertices = deform(self._rig, vector, spine).vertices
            depths = (vertices[0, :, 2] + anchor[2]).detach().numpy()
            pixels = project(vertices + anchor, K)[0]
            covered = DeodrSilhouette.apply(pixels, depths, scene, self._neighbors)[None]
            watch(_hard_iou(covered, mask))
            parameters = Parameters.from_vector(vector)
            terms = (
                adam.iou_loss(covered, mask),
                adam.boundary_loss(covered, distance),
                adam.scale_loss(parameters.joint_log_scales),
                adam.translation_loss(parameters.joint_translations),
            )
            optimizer.zero_grad()
            (torch.cat(terms) @ self._lambdas).backward()
            optimizer.step()
            schedule.step()


def _hard_iou(covered: Float[Tensor, "1 S S"], mask: Float[Tensor, "S S"]) -> float:
    hard, there = covered[0].detach() >= 0.5, mask > 0.5
    # By DEODR's own picture, which reaches half a pixel beyond the body: in its favour again.
    return float((hard & there).sum() / (hard | there).sum())


class DeodrSilhouette(torch.autograd.Function):
    """DEODR's white body on black, (S, S), differentiable in the vertices' pixels."""

    @staticmethod
    def forward(
        ctx: Any, pixels: Tensor, depths: np.ndarray, scene: Scene2D, neighbors: np.ndarray
    ) -> Tensor:
        """The picture, (S, S), of vertices at `pixels` and `depths`."""
        scene.ij, scene.depths = pixels.detach().numpy(), depths
        scene.edgeflags = _rim_flags(scene, neighbors)
        image, _ = scene.render(sigma=1)
        ctx.scene = scene
        return torch.as_tensor(image[..., 0])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        """The gradient with respect to `pixels` alone."""
        ctx.scene.clear_gradients()
        ctx.scene.render_backward(np.ascontiguousarray(grads[0].numpy()[..., None]))
        return torch.as_tensor(ctx.scene.ij_b.copy()), None, None, None


def make_scene(rig: Rig, size: int) -> Scene2D:
    """A white mesh on black; where its vertices are comes later."""
    faces = rig.faces.numpy().astype(np.uint32)
    num_faces, num_vertices = len(faces), rig.num_vertices
    return Scene2D(
        faces=faces,
        faces_uv=faces,
        ij=np.zeros((num_vertices, 2)),
        depths=np.zeros(num_vertices),
        textured=np.zeros(num_faces, bool),
        uv=np.zeros((num_vertices, 2)),
        shade=np.zeros(num_vertices),
        colors=np.ones((num_vertices, 1)),
        shaded=np.zeros(num_faces, bool),
        edgeflags=np.zeros((num_faces, 3), bool),
        height=size,
        width=size,
        nb_colors=1,
        texture=np.zeros((0, 0)),
        background_color=np.zeros(1),
        clockwise=False,
        backface_culling=True,
    )


def face_neighbors(faces: np.ndarray) -> np.ndarray:
    """The face across each edge of each face, (F, 3), of a closed mesh."""
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]]
    owner = {(a, b): f for f, edges in enumerate(directed.tolist()) for a, b in edges}
    return np.array([[owner[b, a] for a, b in edges] for edges in directed.tolist()])


def _rim_flags(scene: Scene2D, neighbors: np.ndarray) -> np.ndarray:
    """Which edges of each face lie between a face seen from the front and one from behind."""
    a, b, c = (scene.ij[scene.faces[:, corner]] for corner in range(3))
    ab, ac = b - a, c - a
    is_front = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0] < 0
    return is_front[:, None] != is_front[neighbors]
