"""Lengths against the truth, as the tables of this folder show them."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from stream_dmr.messages import LengthEstimate, Message


class JudgedLength(NamedTuple):
    """A fish's final length, relative to the truth."""

    track_id: int
    error: float
    std: float
    is_held: bool  # by its 95 % interval


def judge(messages: Iterable[Message], truth_mm: Mapping[int, float]) -> list[JudgedLength]:
    """The final lengths among messages, of those fish that have one."""
    judged = []
    for one in messages:
        if isinstance(one, LengthEstimate) and one.is_final and one.length_mm is not None:
            assert one.length_std_mm is not None
            assert one.ci95_mm is not None
            truth = truth_mm[one.track_id]
            low, high = one.ci95_mm
            error, std = one.length_mm / truth - 1, one.length_std_mm / truth
            judged.append(JudgedLength(one.track_id, error, std, bool(low <= truth <= high)))
    return judged


HEADER = "fish | mean error | bias | held | width | NEES"


def figures(group: Sequence[JudgedLength]) -> str:
    """Cells of a table with the columns of `HEADER`."""
    errors, stds = np.array([(one.error, one.std) for one in group]).T
    held = np.mean([one.is_held for one in group])
    return (
        f"{len(group)} | {abs(errors).mean():.1%} | {errors.mean():+.1%} | {held:.0%} "
        f"| {3.92 * stds.mean():.1%} | {np.mean((errors / stds) ** 2):.2f}"
    )
