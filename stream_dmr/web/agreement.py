"""Compare readings of the same fish: decisions, species and lengths."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from statistics import fmean, stdev

from stream_dmr.errors import UserError
from stream_dmr.store.fish import database_of, read_measured_fish, species_named
from stream_dmr.store.verdicts import Review, blind_readings, read_verdicts, reviews_of

REVIEW, MEASUREMENT = "review", "measurement"
_Fish = tuple[str, int]  # folder and track id


@dataclass(frozen=True, kw_only=True)
class LabelAgreement:
    """The agreement of two readers' labels for the same fish."""

    count: int
    same: int
    kappa: float | None  # Cohen's; None without labels, or if all are equal

    @property
    def text(self) -> str:
        if self.count == 0:
            return "none in common"
        kappa = "not defined" if self.kappa is None else f"{self.kappa:.2f}"
        return f"{self.same} of {self.count} the same, Cohen's kappa {kappa}"


@dataclass(frozen=True, kw_only=True)
class LengthAgreement:
    """Lengths of the same fish by two readers, the second minus the first, mm."""

    count: int
    mean_mm: float | None
    limits_mm: tuple[float, float] | None  # of agreement, 95 %; None for fewer than two fish

    @property
    def text(self) -> str:
        if self.mean_mm is None:
            return "none in common"
        limits = ""
        if self.limits_mm is not None:
            low, high = self.limits_mm
            limits = f", 95 % limits of agreement {low:+.1f} to {high:+.1f} mm"
        return f"{self.count} fish, mean difference {self.mean_mm:+.1f} mm{limits}"


@dataclass(frozen=True, kw_only=True)
class Reading:
    """The labels of one reader for the measured fish."""

    name: str
    decisions: Mapping[_Fish, str] = field(default_factory=dict[_Fish, str])
    species: Mapping[_Fish, str] = field(default_factory=dict[_Fish, str])
    lengths_mm: Mapping[_Fish, float] = field(default_factory=dict[_Fish, float])


@dataclass(frozen=True, kw_only=True)
class ReadingPair:
    """The agreement of two readings."""

    first: str
    second: str
    decisions: LabelAgreement
    species: LabelAgreement
    lengths: LengthAgreement


def cohens_kappa(first: Sequence[str], second: Sequence[str]) -> float | None:
    """Agreement beyond chance: (p_o - p_e) / (1 - p_e).

    p_o is the share of equal labels; p_e is that share by chance, if each reader uses every label
    as often as observed. None without labels or if p_e is 1. Cohen, "A Coefficient of Agreement
    for Nominal Scales", Educational and Psychological Measurement 20 (1960).
    """
    count = len(first)
    if count == 0:
        return None
    observed = sum(a == b for a, b in zip(first, second, strict=True)) / count
    counts, other = Counter(first), Counter(second)
    expected = sum(counts[label] * other[label] for label in counts) / count**2
    return None if expected == 1 else (observed - expected) / (1 - expected)


def length_agreement(differences_mm: Sequence[float]) -> LengthAgreement:
    """Mean difference, and the limits between which 95 % of differences lie: mean +- 1.96 sd.

    Bland and Altman, "Statistical methods for assessing agreement", The Lancet 327 (1986).
    """
    count = len(differences_mm)
    if count < 2:
        return LengthAgreement(
            count=count, mean_mm=next(iter(differences_mm), None), limits_mm=None
        )
    mean, reach = fmean(differences_mm), 1.96 * stdev(differences_mm)
    return LengthAgreement(count=count, mean_mm=mean, limits_mm=(mean - reach, mean + reach))


def agreements(folders: Sequence[Path]) -> list[ReadingPair]:
    """The agreement of each pair of readings of the fish of some runs.

    Readings are the review, each blind reading, and the measurement with its lengths. Raises
    UserError if there are fewer than two.
    """
    readings = [
        reading
        for reading in _readings(folders)
        if reading.decisions or reading.species or reading.lengths_mm
    ]
    if len(readings) < 2:
        raise UserError(
            f"{folders[0]}: expected verdicts to compare, found none; take them with stream-dmr "
            "review, and a second reading with --blind"
        )
    return [_compared(first, other) for first, other in combinations(readings, 2)]


def _readings(folders: Sequence[Path]) -> Iterator[Reading]:
    measured: dict[_Fish, float] = {}
    reviews: dict[str, dict[_Fish, Review]] = {REVIEW: {}}
    for folder in folders:
        database = database_of(folder)
        if database is None:
            raise UserError(f"{folder}: expected the --out of a run, found no lengths.db")
        fish = read_measured_fish(database)
        there = {caught.estimate.track_id for caught in fish}
        for caught in fish:
            if caught.estimate.length_mm is not None:
                measured[str(folder), caught.estimate.track_id] = caught.estimate.length_mm
        verdicts = read_verdicts(database)
        blind = blind_readings(verdicts)
        for taken in (REVIEW, MEASUREMENT):  # a blind reader may have this name
            if taken in blind:
                blind[f"{taken} (blind)"] = blind.pop(taken)
        by_reader = {REVIEW: verdicts} | blind
        for name, own_verdicts in by_reader.items():
            found = reviews_of(own_verdicts)
            known = {(str(folder), track): r for track, r in found.items() if track in there}
            reviews.setdefault(name, {}).update(known)
    yield Reading(name=MEASUREMENT, lengths_mm=measured)
    for name, by_fish in reviews.items():
        lengths = {fish: r.length_mm for fish, r in by_fish.items() if r.length_mm is not None}
        yield Reading(
            name=name,
            decisions={fish: r.decision for fish, r in by_fish.items() if r.decision},
            species={fish: species_named(r.species) for fish, r in by_fish.items() if r.species},
            lengths_mm=lengths,
        )


def _compared(first: Reading, second: Reading) -> ReadingPair:
    both = [fish for fish in first.lengths_mm if fish in second.lengths_mm]
    return ReadingPair(
        first=first.name,
        second=second.name,
        decisions=_labels(first.decisions, second.decisions),
        species=_labels(first.species, second.species),
        lengths=length_agreement([second.lengths_mm[f] - first.lengths_mm[f] for f in both]),
    )


def _labels(first: Mapping[_Fish, str], second: Mapping[_Fish, str]) -> LabelAgreement:
    both = [fish for fish in first if fish in second]
    labels, other = [first[fish] for fish in both], [second[fish] for fish in both]
    same = sum(a == b for a, b in zip(labels, other, strict=True))
    return LabelAgreement(count=len(both), same=same, kappa=cohens_kappa(labels, other))
