"""The shapes that a fish may have before its mask is seen: body forms, or learnt stocks."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from stream_dmr.fitting.shape.space import coefficients_of, form_precision
from stream_dmr.template.template import Template
from stream_dmr.template.template_file import bundled_names, load_template

AUTO = "auto"
# The mesh of rings that is given the other forms' shapes; any bundled one would do.
_BASE_FORM = "cod"
# How much likelier the form is that the user names, than each other one.
_NAMED_ODDS = 20.0


class CandidateShape(NamedTuple):
    """One shape, as coefficients of `space.py` on the run's template."""

    name: str
    coefficients: Float[np.ndarray, "W"]
    covariance: Float[np.ndarray, "W W"]  # of what isn't known of the stock's mean shape
    share: float  # of the fish that are taken to have it


@dataclass(frozen=True, eq=False, kw_only=True)
class CandidateShapes:
    """All of a run, in one order: `FittedShape.candidate` is an index."""

    names: str  # joined by commas
    coefficients: Float[np.ndarray, "N W"]
    covariances: Float[np.ndarray, "N W W"]
    shares: Float[np.ndarray, "N"]  # sum to 1
    are_learnt: bool  # from the fish of a run; False: body forms

    def __iter__(self) -> Iterator[CandidateShape]:
        """Iterate over the candidates."""
        rows = zip(
            self.names.split(","), self.coefficients, self.covariances, self.shares, strict=True
        )
        return (CandidateShape(*row[:3], float(row[3])) for row in rows)

    def __len__(self) -> int:
        """Return their number."""
        return len(self.shares)

    @classmethod
    def of(cls, candidates: list[CandidateShape], *, are_learnt: bool) -> "CandidateShapes":
        """Stack them."""
        return cls(
            names=",".join(candidate.name for candidate in candidates),
            coefficients=np.stack([candidate.coefficients for candidate in candidates]),
            covariances=np.stack([candidate.covariance for candidate in candidates]),
            shares=np.array([candidate.share for candidate in candidates]),
            are_learnt=are_learnt,
        )


def body_forms(template: Template, *, named: str | None = None) -> CandidateShapes:
    """The bundled body forms on one of their meshes; `named` is likelier than the others.

    A fish may still turn out to be of another form: a name is a hint, the masks decide.
    """
    names = bundled_names()
    odds = np.array([_NAMED_ODDS if name == named else 1.0 for name in names])
    covariance = np.linalg.inv(form_precision())
    return CandidateShapes.of(
        [
            CandidateShape(name, coefficients_of(load_template(name), template), covariance, share)
            for name, share in zip(names, odds / odds.sum(), strict=True)
        ],
        are_learnt=False,
    )


def load_shapes(
    name: str, *, on_notice: Callable[[str], None] = lambda notice: None
) -> tuple[Template, CandidateShapes | None]:
    """What `--template` says: the mesh, and the shapes that fish may have.

    `auto`: any body form. The name of a body form: that one, unless the masks say otherwise. A
    mesh: its own shape alone, since it is the user's word; `on_notice` gets what was repaired and
    found of it. Raises TemplateError.
    """
    if name != AUTO and name not in bundled_names():
        return load_template(name, on_notice=on_notice), None
    template = replace(load_template(_BASE_FORM), name=name)
    return template, body_forms(template, named=None if name == AUTO else name)


def mesh_form(template: Template) -> CandidateShapes:
    """A mesh as the one body form from which a stock is learnt."""
    name = template.name.replace(",", " ")
    covariance = np.linalg.inv(form_precision())
    return CandidateShapes.of(
        [CandidateShape(name, np.zeros(len(covariance)), covariance, 1.0)], are_learnt=False
    )
