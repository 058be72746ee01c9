"""The shapes that a fish may have before its mask is seen: body forms, or learnt stocks."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from stream_dmr.fitting.shape.space import NUM_COEFFICIENTS, coefficients_of, form_precision
from stream_dmr.messages import LearntShapes
from stream_dmr.template.template import Template
from stream_dmr.template.template_file import bundled_names, load_template

AUTO = "auto"
# The mesh of rings that is given the other forms' shapes; any bundled one would do.
_BASE_FORM = "cod"
_ALWAYS = np.iinfo(np.int64).min  # since when the body forms are known
# How much likelier the form is that the user names, than each other one.
_NAMED_ODDS = 20.0


class Choice(NamedTuple):
    """The candidates among which a fish's own is sought."""

    indices: Sequence[int]
    shares: Float[np.ndarray, "K"]  # of the fish that are taken to have each; sum to 1


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
    shares: Float[np.ndarray, "N"]  # those known before the first fish sum to 1
    are_learnt: bool  # from the fish of a run before it measured them; False: body forms
    # Capture times from which on fish may have each, for what a camera learns; None: always.
    since_ns: Int[np.ndarray, "N"] | None = None

    def __iter__(self) -> Iterator[CandidateShape]:
        """Iterate over the candidates."""
        rows = zip(
            self.names.split(","), self.coefficients, self.covariances, self.shares, strict=True
        )
        return (CandidateShape(*row[:3], float(row[3])) for row in rows)

    def __len__(self) -> int:
        """Return their number."""
        return len(self.shares)

    @property
    def is_given_mesh(self) -> bool:
        """True for a mesh alone that is believed as it is, see `given_mesh`."""
        return len(self) == 1 and not self.covariances.any()

    def choice(self, first_seen_ns: int) -> Choice:
        """What a fish may be that is first seen then: all body forms, and the stocks known last.

        What the stocks leave of the shares is the body forms': a catch may bring what was not yet
        in it.
        """
        if self.since_ns is None:
            return Choice(range(len(self)), self.shares)
        last = self.since_ns[self.since_ns <= first_seen_ns].max()
        is_form = self.since_ns == _ALWAYS
        indices = np.flatnonzero(is_form | (self.since_ns == last))
        shares = np.where(is_form, self.shares, 0.0)
        if last != _ALWAYS:
            stocks = np.where(self.since_ns == last, self.shares, 0.0)
            shares = shares * (1 - stocks.sum()) + stocks
        return Choice(indices.tolist(), shares[indices])

    def extended(self, learnt: LearntShapes) -> "CandidateShapes":
        """With what a camera has learnt; the others keep their indices."""
        since_ns = np.full(len(self), _ALWAYS) if self.since_ns is None else self.since_ns
        new_since_ns = np.full(len(learnt.shares), learnt.timestamp_ns)
        return CandidateShapes(
            names=f"{self.names},{learnt.names}",
            coefficients=np.concatenate([self.coefficients, learnt.coefficients]),
            covariances=np.concatenate([self.covariances, learnt.covariances]),
            shares=np.concatenate([self.shares, learnt.shares]),
            are_learnt=self.are_learnt,
            since_ns=np.concatenate([since_ns, new_since_ns]),
        )

    def stocks(self) -> "CandidateShapes | None":
        """Those learnt last, their shares of the fish that they were learnt from; None: none."""
        if self.are_learnt:
            return self
        if self.since_ns is None:
            return None
        last = [
            shape
            for shape, since_ns in zip(self, self.since_ns, strict=True)
            if since_ns == self.since_ns.max()
        ]
        total = sum(shape.share for shape in last)
        return CandidateShapes.of(
            [shape._replace(share=shape.share / total) for shape in last], are_learnt=True
        )

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
    mesh: None, its own shape alone; `on_notice` gets what was repaired and found of it. Raises
    TemplateError.
    """
    if name != AUTO and name not in bundled_names():
        return load_template(name, on_notice=on_notice), None
    template = replace(load_template(_BASE_FORM), name=name)
    return template, body_forms(template, named=None if name == AUTO else name)


def mesh_form(template: Template) -> CandidateShapes:
    """A mesh as the one body form from which a stock is learnt."""
    return _of_mesh(template, np.linalg.inv(form_precision()))


def given_mesh(template: Template) -> CandidateShapes:
    """A mesh as it is, the user's word: fits by it are those without candidates."""
    return _of_mesh(template, np.zeros((NUM_COEFFICIENTS, NUM_COEFFICIENTS)))


def _of_mesh(template: Template, covariance: Float[np.ndarray, "W W"]) -> CandidateShapes:
    name = template.name.replace(",", " ")
    return CandidateShapes.of(
        [CandidateShape(name, np.zeros(len(covariance)), covariance, 1.0)], are_learnt=False
    )
