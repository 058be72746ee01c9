"""SmoothLength: from the lengths of frames to that of a fish, its species and what became of it.

Last of the chain: LocalizedFish -> LengthEstimate, one running estimate for every frame of a fish
and a final one when its track ends.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from stream_dmr.lengths.fate import FateTracker, ZonesSettings
from stream_dmr.lengths.kalman import SmoothLengthSettings
from stream_dmr.lengths.track_record import TrackLength, late_estimate
from stream_dmr.messages import LengthEstimate, LocalizedFish
from stream_dmr.species import UNSURE, SpeciesEvidence, SpeciesSettings


@dataclass(frozen=True)
class _Track:
    length: TrackLength
    fate: FateTracker
    species: SpeciesEvidence


class SmoothLength:
    """Holds the open tracks. Each id gets one final estimate, ever: ids are not used again.

    A fish that returns under its old id after its track has ended is refused with that reason,
    so that no table gets a second row for it.
    """

    def __init__(
        self,
        settings: SmoothLengthSettings,
        *,
        zones: ZonesSettings | None = None,
        species: SpeciesSettings | None = None,
        frame_size: tuple[int, int] | None = None,
    ) -> None:
        """With `zones` a final estimate has a fate; `frame_size`: width and height, px.

        It has a species where a classifier has looked at the fish.
        """
        self._settings = settings
        self._zones, self._frame_size = zones or ZonesSettings(), frame_size
        self._species = species or SpeciesSettings()
        self._open: dict[int, _Track] = {}
        self._ended: set[int] = set()
        self._watched_ns: tuple[int, int] | None = None  # capture times of the first frame and last

    def step(self, message: LocalizedFish, /) -> Sequence[LengthEstimate]:
        """Return the running estimate of this fish after one more frame."""
        if message.track_id in self._ended:
            return [late_estimate(message)]
        if message.track_id not in self._open:
            self._open[message.track_id] = _Track(
                TrackLength(message, self._settings),
                FateTracker(self._zones, frame_size=self._frame_size),
                SpeciesEvidence(self._species),
            )
        track = self._open[message.track_id]
        track.fate.add(message)
        track.species.add(message.species)
        return [track.length.add(message)]

    def tick(self, timestamp_ns: int, /) -> Sequence[LengthEstimate]:
        """Finish the tracks unseen for `track_timeout_s` at this capture time."""
        first_ns, _ = self._watched_ns or (timestamp_ns, timestamp_ns)
        self._watched_ns = first_ns, timestamp_ns
        earliest_ns = timestamp_ns - round(self._settings.track_timeout_s * 1e9)
        overdue = [i for i, t in self._open.items() if t.length.last_timestamp_ns < earliest_ns]
        return [self._finish(track_id) for track_id in overdue]

    def close(self) -> Sequence[LengthEstimate]:
        """Finish all tracks still open."""
        return [self._finish(track_id) for track_id in list(self._open)]

    def _finish(self, track_id: int) -> LengthEstimate:
        self._ended.add(track_id)
        track = self._open.pop(track_id)
        return self._with_species(self._with_fate(track.length.finish(), track), track)

    def _with_fate(self, estimate: LengthEstimate, track: _Track) -> LengthEstimate:
        if not any(self._zones.polygons()):
            return estimate
        first_ns, last_ns = self._watched_ns or (0, 0)
        fate = track.fate.finish(watched_from_ns=first_ns, watched_to_ns=last_ns)
        return replace(estimate, fate=fate.name, fate_share=fate.share)

    def _with_species(self, estimate: LengthEstimate, track: _Track) -> LengthEstimate:
        found = track.species.best()
        if found is None:
            return estimate
        code = found.code if found.share >= self._species.min_share else UNSURE
        return replace(estimate, species_code=code, species_share=found.share)
