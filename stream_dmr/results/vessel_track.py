"""Where the vessel was at any moment, interpolated between positions; nothing across gaps."""

from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from stream_dmr.results.kept_positions import KeptPosition


@dataclass(frozen=True, kw_only=True)
class Whereabouts:
    """Place, speed and time of one moment; None where not known."""

    utc_ns: int | None = None
    latitude: float | None = None  # degrees, WGS 84
    longitude: float | None = None
    speed_knots: float | None = None
    gap_s: float | None = None  # between the positions around it, where that is too long


NOWHERE = Whereabouts()


class VesselTrack:
    """The positions of a folder, by their time on the clock of the frames."""

    def __init__(self, positions: Iterable[KeptPosition]) -> None:
        by_time = {kept.timestamp_ns: kept for kept in positions}  # a resumed video has some twice
        self.positions = [by_time[time_ns] for time_ns in sorted(by_time)]
        self._times_ns = [kept.timestamp_ns for kept in self.positions]

    def at(self, timestamp_ns: int) -> Whereabouts:
        """Where the vessel was; linear between two positions, the short way round the earth."""
        index = bisect_left(self._times_ns, timestamp_ns)
        if index < len(self.positions) and self._times_ns[index] == timestamp_ns:
            return _exactly(self.positions[index])
        if not 0 < index < len(self.positions):
            return NOWHERE
        before, after = self.positions[index - 1], self.positions[index]
        span_ns = after.timestamp_ns - before.timestamp_ns
        if not after.is_joined:
            return Whereabouts(gap_s=span_ns / 1e9)
        share = (timestamp_ns - before.timestamp_ns) / span_ns
        turn = (after.longitude - before.longitude + 180) % 360 - 180
        longitude = (before.longitude + share * turn + 180) % 360 - 180
        return Whereabouts(
            utc_ns=_utc_between(before, after, timestamp_ns),
            latitude=before.latitude + share * (after.latitude - before.latitude),
            longitude=longitude,
            speed_knots=_between(before.speed_knots, after.speed_knots, share),
        )

    def pieces(self) -> list[Sequence[KeptPosition]]:
        """The track, cut at its gaps."""
        pieces: list[list[KeptPosition]] = []
        for kept in self.positions:
            if kept.is_joined and pieces:
                pieces[-1].append(kept)
            else:
                pieces.append([kept])
        return [*pieces]


def _exactly(kept: KeptPosition) -> Whereabouts:
    return Whereabouts(
        utc_ns=kept.utc_ns,
        latitude=kept.latitude,
        longitude=kept.longitude,
        speed_knots=kept.speed_knots,
    )


def _between(before: float | None, after: float | None, share: float) -> float | None:
    return None if before is None or after is None else before + share * (after - before)


def _utc_between(before: KeptPosition, after: KeptPosition, timestamp_ns: int) -> int | None:
    """In integers: a double has no nanoseconds of the year."""
    if before.utc_ns is None or after.utc_ns is None:
        return None
    span_ns = after.timestamp_ns - before.timestamp_ns
    passed_ns = timestamp_ns - before.timestamp_ns
    return before.utc_ns + (after.utc_ns - before.utc_ns) * passed_ns // span_ns
