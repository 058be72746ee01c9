"""Candidate shapes of a run: body forms and learnt stocks, and whether a mesh agrees with them.

Masks that contain more than the fish distort its shape: if the line at the snout is in every mask,
a long thin snout is learnt, and fish are measured from the end of the line.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import chdtri

from stream_dmr.fitting.shape.space import (
    NUM_COEFFICIENTS,
    THICKNESS,
    TRUNK,
    coefficients_of,
    distance_from_form,
    form_precision,
    std_of,
)
from stream_dmr.messages import LearntShapes
from stream_dmr.template.template import Template
from stream_dmr.template.template_file import bundled_names, load_template

AUTO = "auto"
# The mesh of rings that takes the other forms' shapes; any bundled mesh would do.
_BASE_FORM = "cod"
_ALWAYS = np.iinfo(np.int64).min  # the time from which on the body forms are known
# Odds of the form that the user names, against each other form.
_NAMED_ODDS = 20.0
# A form so deep that it looks like a slimmer one if it turns: 72 hanging halibut were learnt as it
# and became 1 % shorter. Fish that lie don't turn.
_DEEPEST_FORM = "spadefish"


class Choice(NamedTuple):
    """The candidates among which a fish's own is sought."""

    indices: Sequence[int]
    shares: Float[np.ndarray, "K"]  # of the fish that are taken to have each; sum to 1


class CandidateShape(NamedTuple):
    """One shape, as coefficients of `space.py` on the run's template."""

    name: str
    coefficients: Float[np.ndarray, "W"]
    covariance: Float[np.ndarray, "W W"]  # of the stock's mean shape
    share: float  # of the fish that are assumed to have it


@dataclass(frozen=True, eq=False, kw_only=True)
class CandidateShapes:
    """All candidates of a run, in one order: `FittedShape.candidate` is an index."""

    names: str  # joined by commas
    coefficients: Float[np.ndarray, "N W"]
    covariances: Float[np.ndarray, "N W W"]
    shares: Float[np.ndarray, "N"]  # those of candidates known before the first fish sum to 1
    are_learnt: bool  # from the fish of a run before it measured them; False: body forms
    # Capture times from which on fish may have each shape, if a camera learns; None: always.
    since_ns: Int[np.ndarray, "N"] | None = None

    def __iter__(self) -> Iterator[CandidateShape]:
        names, shares = self.names.split(","), self.shares.tolist()
        return map(CandidateShape, names, self.coefficients, self.covariances, shares)

    def __len__(self) -> int:
        return len(self.shares)

    @property
    def is_given_mesh(self) -> bool:
        """True for a mesh alone that is believed as it is, see `given_mesh`."""
        return len(self) == 1 and not self.covariances.any()

    def choice(self, first_seen_ns: int) -> Choice:
        """The candidates of a fish first seen then: all body forms, and the stocks known last.

        The body forms get the shares that the stocks leave: a catch may contain new species.
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
        """With the shapes that a camera has learnt; the others keep their indices."""
        return self._joined(learnt, since_ns=learnt.timestamp_ns)

    def with_stocks(self, stocks: "CandidateShapes") -> "CandidateShapes":
        """With stocks that leave some of the shares to these, from the first fish on."""
        return self._joined(stocks, since_ns=int(_ALWAYS) + 1)

    def _joined(
        self, learnt: "LearntShapes | CandidateShapes", *, since_ns: int
    ) -> "CandidateShapes":
        old_since_ns = np.full(len(self), _ALWAYS) if self.since_ns is None else self.since_ns
        new_since_ns = np.full(len(learnt.shares), since_ns)
        return CandidateShapes(
            names=f"{self.names},{learnt.names}",
            coefficients=np.concatenate([self.coefficients, learnt.coefficients]),
            covariances=np.concatenate([self.covariances, learnt.covariances]),
            shares=np.concatenate([self.shares, learnt.shares]),
            are_learnt=self.are_learnt,
            since_ns=np.concatenate([old_since_ns, new_since_ns]),
        )

    def stocks(self) -> "CandidateShapes | None":
        """The stocks learnt last, with their shares of the fish learnt from; None without any."""
        if self.are_learnt:
            return self
        if self.since_ns is None:
            return None
        last = [*compress(self, self.since_ns == self.since_ns.max())]
        total = sum(shape.share for shape in last)
        stocks = [shape._replace(share=shape.share / total) for shape in last]
        return CandidateShapes.of(stocks, are_learnt=True)

    @classmethod
    def of(cls, candidates: list[CandidateShape], *, are_learnt: bool) -> "CandidateShapes":
        return cls(
            names=",".join(candidate.name for candidate in candidates),
            coefficients=np.stack([candidate.coefficients for candidate in candidates]),
            covariances=np.stack([candidate.covariance for candidate in candidates]),
            shares=np.array([candidate.share for candidate in candidates]),
            are_learnt=are_learnt,
        )


def body_forms(template: Template, *, named: str | None, are_lying: bool) -> CandidateShapes:
    """The bundled body forms on one of their meshes; `named` is likelier than the others.

    A fish may still turn out to be of another form: a name is a hint, the masks decide. The deepest
    form is one of them only if the fish lie, or if it is named.
    """
    names = bundled_names()
    if not are_lying and named != _DEEPEST_FORM:
        names.remove(_DEEPEST_FORM)
    odds = np.array([_NAMED_ODDS if name == named else 1.0 for name in names])
    covariance = np.linalg.inv(form_precision())
    forms = [
        CandidateShape(name, coefficients_of(load_template(name), template), covariance, share)
        for name, share in zip(names, odds / odds.sum(), strict=True)
    ]
    return CandidateShapes.of(forms, are_learnt=False)


def load_shapes(
    name: str, *, are_lying: bool = False, on_notice: Callable[[str], None] = lambda notice: None
) -> tuple[Template, CandidateShapes | None]:
    """The mesh and the candidate shapes of `--template`.

    `auto`: any body form. The name of a body form: that form, unless the masks contradict it. A
    mesh: None, its own shape alone; `on_notice` gets lines about repairs and points found. Raises
    TemplateError.
    """
    if name != AUTO and name not in bundled_names():
        return load_template(name, on_notice=on_notice), None
    template = replace(load_template(_BASE_FORM), name=name)
    return template, body_forms(template, named=None if name == AUTO else name, are_lying=are_lying)


def mesh_form(template: Template) -> CandidateShapes:
    """A mesh as the one body form from which a stock is learnt."""
    return _of_mesh(template, np.linalg.inv(form_precision()))


def given_mesh(template: Template) -> CandidateShapes:
    """A mesh as it is, as the user states; its fits are those without candidates."""
    return _of_mesh(template, np.zeros((NUM_COEFFICIENTS, NUM_COEFFICIENTS)))


def _of_mesh(template: Template, covariance: Float[np.ndarray, "W W"]) -> CandidateShapes:
    name = template.name.replace(",", " ")
    return CandidateShapes.of(
        [CandidateShape(name, np.zeros(len(covariance)), covariance, 1.0)], are_learnt=False
    )


_WORTH_SAYING = 0.02  # of a log factor: smaller differences are called none


def describe(forms: CandidateShapes, stocks: CandidateShapes) -> Iterator[str]:
    """A line for each stock, such as: 62% of the fish: like salmon, 18% broader (+-3%)."""
    by_name = {form.name: form for form in forms}
    for stock in stocks:
        yield _line(by_name[stock.name], stock)


def _line(form: CandidateShape, stock: CandidateShape) -> str:
    return f"{stock.share:.0%} of the fish: like {form.name}, {changes(form, stock)}"


def changes(form: CandidateShape, stock: CandidateShape) -> str:
    change = stock.coefficients - form.coefficients
    std = std_of(TRUNK, stock.covariance)
    return (
        f"{_factor(float(TRUNK @ change), 'broader', 'slimmer')} (+-{std:.0%}), "
        f"{_factor(float(change[THICKNESS].mean()), 'thicker', 'thinner')}"
    )


def _factor(log: float, more: str, less: str) -> str:
    if abs(log) < _WORTH_SAYING:
        return f"neither {more} nor {less}"
    return f"{abs(np.expm1(log)):.0%} {more if log > 0 else less}"


# Squared distance to the nearest form, in its own std: of stocks that are as far from a form as
# `form_precision` allows, one in a thousand is further (chi-square).
_MAX_DISTANCE = float(chdtri(NUM_COEFFICIENTS, 1e-3))
# Share of the fish; a smaller group is mostly of misleading masks, and poor evidence of a shape.
_MIN_SHARE = 0.1
_NEVER = 1.5  # times that distance: no fish at all; between the two it is doubted more and more


class Believed(NamedTuple):
    """The shapes that fish of a run may have, after learning."""

    shapes: CandidateShapes
    doubts: list[str]  # about the learnt shapes, a line each


def believable(forms: CandidateShapes, stocks: CandidateShapes) -> Believed:
    """The stocks that can be of fish, doubtful ones with a larger covariance.

    Each has the name of the form that it is nearest to. In the place of stocks that can't be of
    fish, or of too few, a fish may have any of the forms.
    """
    believed, doubts = list[CandidateShape](), list[str]()
    for stock in stocks:
        if stock.share < _MIN_SHARE:
            continue
        coefficients = stock.coefficients
        form = min(forms, key=lambda form: distance_from_form(coefficients - form.coefficients))
        off = coefficients - form.coefficients
        doubt = max(0.0, (distance_from_form(off) / _MAX_DISTANCE - 1) / (_NEVER - 1))
        covariance = stock.covariance + min(doubt, 1.0) * np.outer(off, off)
        stock = stock._replace(name=form.name, covariance=covariance)
        if doubt <= 1:
            believed.append(stock)
        if doubt > 0:
            words = _HARDLY if doubt <= 1 else _NO_FISH
            line = _line(form, stock)
            doubts.append(f"the masks show a shape that fish {words} ({line}){_REMEDY}")
    if not believed:
        return Believed(forms, doubts)
    kept = CandidateShapes.of(believed, are_learnt=True)
    return Believed(kept if len(kept) == len(stocks) else forms.with_stocks(kept), doubts)


_REMEDY = (
    ": look whether the masks hold more than the fish, such as its line; for fish that do look so "
    "give a mesh of them (--template)"
)
_HARDLY = "hardly have, so that their lengths are less certain"
_NO_FISH = "don't have, so that these are measured as the form that each is most like"


# Log factors between head and peduncle: on the mean breadth, beside one std, and on single places
# (root mean square). Chosen between simulated stocks measured by their own mesh and by those of
# other species: with a mesh that is off by more, intervals hold fewer than nine in ten lengths.
_MAX_BREADTH, _MAX_OUTLINE = 0.08, 0.15
_MAX_STD = 0.1  # that of one fish alone; a larger std: fish differ by more than in one stock

# How far the mean length may move from the mesh to the shape learnt from the fish, as a log ratio.
# It may move as far as the std of that mean by the mesh, too. Chosen likewise.
_MAX_SHIFT = 0.04
_SHARED = 0.5  # share of the variance of lengths that all fish of a mesh have in common; chosen


class LengthShift(NamedTuple):
    """How much longer fish are by a shape learnt from them than by the mesh given for them."""

    log_ratio: float = 0.0  # mean over the fish
    std: float = 0.0  # of one fish's log length by the mesh
    num_fish: int = 1

    @property
    def off(self) -> float:
        """Its size over the largest allowed."""
        std_of_mean = self.std * float(np.sqrt(_SHARED + (1 - _SHARED) / self.num_fish))
        return abs(self.log_ratio) / max(_MAX_SHIFT, std_of_mean)


def are_like_mesh(stocks: CandidateShapes) -> bool:
    """True if the shapes learnt from fish, starting at a mesh, are still near the mesh's."""
    return all(map(is_like_mesh, stocks))


def is_like_mesh(stock: CandidateShape) -> bool:
    breadth = abs(float(TRUNK @ stock.coefficients))
    is_as_broad = breadth <= _MAX_BREADTH + min(std_of(TRUNK, stock.covariance), _MAX_STD)
    return is_as_broad and _outline_off(stock) <= _MAX_OUTLINE


def not_like_mesh(
    mesh: CandidateShapes, stocks: CandidateShapes | None, shift: LengthShift | None = None
) -> str:
    """How fish differ that were taken for fish of a mesh; None: it fits none of their masks."""
    if stocks is None:
        return f"the fish are not like {mesh.names}, which fits none of their masks"
    words = [
        f"{changes(form, stock)}, breadths off by {_outline_off(stock):.0%} from place to place"
        for form, stock in zip(mesh, stocks, strict=True)
    ]
    if shift is not None:
        by_mesh = np.expm1(-shift.log_ratio)
        words.append(f"by it they are {abs(by_mesh):.0%} {'longer' if by_mesh > 0 else 'shorter'}")
    return f"the fish are not like {mesh.names}: {'; '.join(words)}"


def _outline_off(stock: CandidateShape) -> float:
    return float(np.sqrt(TRUNK @ stock.coefficients**2))
