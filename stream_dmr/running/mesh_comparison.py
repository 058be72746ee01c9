"""Compares a mesh that was given for fish with the fish themselves.

Their shape is learnt beginning at the mesh. Where that stays near it, some of the fish are measured
by both: a mesh of the right breadth may still be broader or slimmer enough at head and tail to make
them longer or shorter.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain

import numpy as np

from stream_dmr.fitting.shape.candidates import CandidateShapes, mesh_form
from stream_dmr.fitting.shape.mesh_agreement import LengthShift, are_like_mesh, not_like_mesh
from stream_dmr.fitting.shape.samples import FRAMES_PER_FISH, evenly, good_crops
from stream_dmr.messages import FishCrop, LengthEstimate, Message
from stream_dmr.running.chain_nodes import later_nodes
from stream_dmr.running.measuring_setup import MeasuringSetup

_MAX_FISH = 12  # that are measured by both shapes: how their lengths differ is much alike
# Of the largest shift of lengths that is allowed: beyond it the shape is learnt once more, with new
# poses, before it is judged.
_SURELY_ALLOWED = 0.5

Lengths = dict[int, tuple[float, float]]
"""By track id: the log length, and its std."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MeshComparison:
    """What fish say of the mesh that was given for them."""

    mesh: CandidateShapes
    stocks: CandidateShapes | None  # learnt beginning at the mesh; None: it fits none of the masks
    shift: LengthShift | None  # None where the shapes differ already

    @property
    def is_like_mesh(self) -> bool:
        """Whether the mesh can be believed."""
        return self.stocks is not None and self.shift is not None and self.shift.off <= 1

    @property
    def not_like_mesh(self) -> str:
        """How the fish differ from it."""
        return not_like_mesh(self.mesh, self.stocks, self.shift)


def compare_with_mesh(
    crops: Sequence[FishCrop],
    setup: MeasuringSetup,
    *,
    progress: Callable[[str], None] = lambda step: None,
) -> MeshComparison:
    """Compare the template with the fish of these crops, in the order of their capture.

    `progress` is called at each step of the work, and may raise.
    """
    mesh = mesh_form(setup.template)
    measured = evenly(good_crops(crops), _MAX_FISH)
    frames = [frame for fish in measured for frame in evenly(fish, FRAMES_PER_FISH)]

    @cache
    def by_mesh() -> Lengths:
        return _lengths(frames, setup, None)

    @cache  # stocks that suffice are asked for twice
    def shift_of(stocks: CandidateShapes) -> LengthShift | None:
        if not are_like_mesh(stocks):
            return None
        progress("measuring some of them by both shapes")
        return _shift(by_mesh(), _lengths(frames, setup, stocks))

    def suffices(stocks: CandidateShapes) -> bool:
        shift = shift_of(stocks)
        return shift is not None and shift.off <= _SURELY_ALLOWED

    # Only what would be disbelieved is looked at longer.
    stocks = setup.learn(crops, mesh, suffices=suffices, progress=progress)
    return MeshComparison(
        mesh=mesh, stocks=stocks, shift=None if stocks is None else shift_of(stocks)
    )


def _lengths(
    crops: Sequence[FishCrop], setup: MeasuringSetup, candidates: CandidateShapes | None
) -> Lengths:
    """The fish's lengths by these frames; empty without a calibration."""
    messages: Sequence[Message] = crops
    nodes = later_nodes(
        setup.config,
        template=setup.template,
        candidates=candidates,
        calibration=setup.calibration,
    )
    for node in nodes:
        messages = [*chain.from_iterable(map(node.step, messages)), *node.close()]
    return {
        one.track_id: (float(np.log(one.length_mm)), one.length_std_mm / one.length_mm)
        for one in messages
        if isinstance(one, LengthEstimate)
        and one.is_final
        and one.length_mm is not None
        and one.length_std_mm is not None
    }


def _shift(by_mesh: Lengths, by_stocks: Lengths) -> LengthShift:
    """None at all where no fish has both lengths."""
    both = [track_id for track_id in by_mesh if track_id in by_stocks]
    if not both:
        return LengthShift()
    return LengthShift(
        float(np.mean([by_stocks[n][0] - by_mesh[n][0] for n in both])),
        float(np.mean([by_mesh[n][1] for n in both])),
        len(both),
    )
