"""What a descent minimises and how long it may take: the tuples that the kernels pass on."""

from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from stream_dmr.fitting.body import Body
from stream_dmr.fitting.contour.deformation import KINDS, Kind
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.parameters import Priors, rest_vector
from stream_dmr.fitting.target import Target

# The terms of eq. (3), and their lambdas, in this order.
IOU, BOUNDARY, SCALE, TRANSLATION, NORMAL, LAPLACIAN = range(6)


class Problem(NamedTuple):
    """L_rec of eq. (3) of one body on one target, with priors on its parameters.

    Kernels take it as it is: `stream_dmr.compiled`.
    """

    body: Body
    kind: Kind  # of the deformation: SPINE or LINEAR_BLEND
    target: Target
    lambdas: Float[np.ndarray, "6"]
    priors: Priors
    rest: Float[np.ndarray, "P"]  # where the priors have their minimum

    @classmethod
    def from_settings(
        cls, settings: FitMeshSettings, body: Body, target: Target, *, with_smoothness: bool
    ) -> "Problem":
        """Without smoothness: no L_normal and L_lap, expensive terms that separate no poses."""
        # Frozen settings have a hash, which pydantic does not declare.
        lambdas, priors = _weights(settings, with_smoothness)  # pyright: ignore[reportArgumentType]
        kind, rest = KINDS[settings.deformation], _rest(len(body.joints))
        return cls(body, kind, target, lambdas, priors, rest)


@lru_cache(maxsize=64)
def _weights(
    settings: FitMeshSettings, with_smoothness: bool
) -> tuple[Float[np.ndarray, "6"], Priors]:
    """The lambdas and priors of these settings: six problems of each crop have the same ones."""
    lambdas = settings.lambdas()
    if not with_smoothness:
        lambdas[[NORMAL, LAPLACIAN]] = 0.0
    return lambdas, settings.priors()


@cache
def _rest(num_joints: int) -> Float[np.ndarray, "P"]:
    return rest_vector(num_joints)


class Options(NamedTuple):
    """The options of one descent."""

    iterations: int  # at most
    tolerance: float  # of L_rec: it has settled when it falls by less
    damping: float  # of the first step, as a share of the curvature's diagonal
