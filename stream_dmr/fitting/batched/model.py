"""A template and its weights on a device: what every fit of a batch shares."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stream_dmr.body import JOINT, ROOT, Body, rest_vector
from stream_dmr.fitting.settings import FitMeshSettings


class Model(NamedTuple):
    """`Body` and settings as tensors of one kind of float.

    Stations are the places of the midline at which the joints are blended: the U feet of the
    points, then the middles of the midline's M - 1 segments.
    """

    deformation: str
    points: Float[Tensor, "N 3"]
    place_of: Int[Tensor, "N"]  # of each point, among the first U stations
    arms: Float[Tensor, "N 4"]  # of each point: 1, and its offset from its foot
    stations: Float[Tensor, "X 3"]
    segments: Int[Tensor, "U"]
    fractions: Float[Tensor, "U"]
    joints: Float[Tensor, "J 3"]
    steps: Float[Tensor, "L 3"]  # of the midline, segment by segment
    faces: Int[Tensor, "F 3"]
    edges: Int[Tensor, "E 2"]
    edge_faces: Int[Tensor, "E 2"]
    neighbor_share: Float[Tensor, "V 1"]  # one over the number of each vertex' neighbours
    rest: Float[Tensor, "P"]
    lambdas: Float[Tensor, "6"]
    priors: Float[Tensor, "14"]

    @property
    def num_vertices(self) -> int:
        """V, the number of vertices, which come first among the points."""
        return len(self.neighbor_share)

    @classmethod
    def from_body(
        cls, body: Body, settings: FitMeshSettings, *, device: str, dtype: torch.dtype
    ) -> "Model":
        """Move a body and the settings' weights to a device."""

        def real(array: object) -> Tensor:
            return torch.as_tensor(array, dtype=dtype, device=device)

        def whole(array: object) -> Tensor:
            return torch.as_tensor(array, dtype=torch.int64, device=device)

        points, places = real(body.points), real(body.places)
        place_of, midline = whole(body.place_of), real(body.midline)
        offsets = points - places[place_of]
        return cls(
            deformation=settings.deformation,
            points=points,
            place_of=place_of,
            arms=torch.cat([torch.ones_like(offsets[:, :1]), offsets], dim=1),
            stations=torch.cat([places, (midline[1:] + midline[:-1]) / 2]),
            segments=whole(body.segments),
            fractions=real(body.fractions),
            joints=real(body.joints),
            steps=midline[1:] - midline[:-1],
            faces=whole(body.faces),
            edges=whole(body.edges),
            edge_faces=whole(body.edge_faces),
            neighbor_share=1.0 / real(body.num_neighbors)[:, None],
            rest=real(rest_vector(len(body.joints))),
            lambdas=real(settings.lambdas()),
            priors=real(settings.priors()),
        )

    def joint_values(self, flat: Float[Tensor, "B P"]) -> Float[Tensor, "B J 13"]:
        """The parameters of the joints, of each joint a row."""
        return flat[:, ROOT:].unflatten(1, (-1, JOINT))
