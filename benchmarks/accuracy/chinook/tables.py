"""Tables of the Chinook check: what one fish's pictures say of its length."""

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from benchmarks.accuracy.chinook.photographs import Photograph
from benchmarks.accuracy.chinook.product_lengths import ProductLength


def deviations(lengths: Mapping[str, float], photographs: Sequence[Photograph]) -> dict[str, float]:
    """Of each picture from the mean of its fish's, in percent; fish seen once have none."""
    found: dict[str, float] = {}
    for fish in {one.fish for one in photographs}:
        names = [one.name for one in photographs if one.fish == fish and one.name in lengths]
        mean = np.mean([lengths[name] for name in names]) if len(names) > 1 else np.nan
        found |= {name: 100 * (lengths[name] / mean - 1) for name in names if len(names) > 1}
    return found


def fish_table(
    photographs: Sequence[Photograph],
    product: Mapping[str, ProductLength],
    columns: Mapping[str, Mapping[str, float]],
) -> list[str]:
    """One line a picture: the product's length and interval, and every way's deviation."""
    off = {name: deviations(lengths, photographs) for name, lengths in columns.items()}
    lines = [
        f"| picture | cells | 95 % | {' | '.join(columns)} |",
        "|---" * (3 + len(columns)) + "|",
    ]
    for one in photographs:
        result = product[one.name]
        cells = [f"{off[way][one.name]:+.1f} %" if one.name in off[way] else "" for way in columns]
        length = result.status if result.length is None else f"{result.length:.2f}"
        span = "" if result.interval is None else "{:.2f} to {:.2f}".format(*result.interval)
        lines.append(f"| {one.name} | {length} | {span} | {' | '.join(cells)} |")
    return lines


def summary(
    photographs: Sequence[Photograph], columns: Mapping[str, Mapping[str, float]]
) -> list[str]:
    """Median, mean and largest deviation of every way, and the share within 3 %."""
    lines = ["| way | pictures | median | mean | largest | within 3 % |", "|---" * 6 + "|"]
    for way, lengths in columns.items():
        off = np.abs(list(deviations(lengths, photographs).values()))
        lines.append(
            f"| {way} | {len(off)} | {np.median(off):.1f} % | {off.mean():.1f} % | "
            f"{off.max():.1f} % | {100 * (off <= 3).mean():.0f} % |"
        )
    return lines


def beyond_hand(
    photographs: Sequence[Photograph],
    product: Mapping[str, float],
    by_hand: Mapping[str, float],
) -> str:
    """What is left of the product's deviations where two points by hand have theirs.

    A fish that slants, arches out of the grid's plane or swims nearer moves both alike.
    """
    ours, theirs = (deviations(lengths, photographs) for lengths in (product, by_hand))
    left = np.array([ours[name] - theirs[name] for name in ours])
    before, after = (float(np.sqrt(np.mean(np.square(list(off))))) for off in (ours.values(), left))
    return (
        f"root mean square of the deviations: {before:.1f} %; less those by hand {after:.1f} %, "
        f"{np.abs(left).max():.1f} % at most"
    )


def against_marks(product: Mapping[str, ProductLength], by_hand: Mapping[str, float]) -> str:
    """How the lengths differ from those between the marks of snout and fork, on the grid."""
    errors, held = [], []
    for name, marked in by_hand.items():
        one = product[name]
        assert one.length is not None
        assert one.interval is not None
        errors.append(one.length / marked - 1)
        held.append(one.interval[0] <= marked <= one.interval[1])
    off = np.array(errors)
    return (
        f"against the marks: {len(off)} of {len(product)} measured, {off.mean():+.1%} in the mean, "
        f"mean error {np.abs(off).mean():.1%}, worst {off[np.abs(off).argmax()]:+.1%}, "
        f"{np.mean(held):.0%} held"
    )


def honesty(photographs: Sequence[Photograph], product: Mapping[str, ProductLength]) -> str:
    """How often two pictures of one fish differ by less than 1.96 std of their difference."""
    overlaps, agrees, widths = [], [], []
    for a, b in combinations(photographs, 2):
        first, second = product[a.name], product[b.name]
        if a.fish != b.fish or first.interval is None or second.interval is None:
            continue
        assert first.length is not None
        assert second.length is not None
        overlaps.append(
            first.interval[0] <= second.interval[1] and second.interval[0] <= first.interval[1]
        )
        allowed = 1.96 * np.hypot(first.std, second.std)
        agrees.append(abs(first.length - second.length) <= allowed)
    for result in product.values():
        if result.interval is not None and result.length is not None:
            widths.append((result.interval[1] - result.interval[0]) / result.length)
    return (
        f"{len(overlaps)} pairs of pictures of one fish: {np.mean(overlaps):.0%} of the intervals "
        f"overlap, {np.mean(agrees):.0%} of the differences are below 1.96 of their std; intervals "
        f"are {np.median(widths):.1%} wide in the median"
    )
