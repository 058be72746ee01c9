"""SmoothLength: from the lengths of frames to the length, species and fate of a fish.

Last of the chain: LocalizedFish -> LengthEstimate, a running estimate for every frame of a fish
and a final estimate when its track ends.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from stream_dmr.lengths.fate import FateTracker, ZonesSettings
from stream_dmr.lengths.kalman import SmoothLengthSettings
from stream_dmr.lengths.track_record import TrackLength, late_estimate
from stream_dmr.messages import LengthEstimate, LocalizedFish, TrackEnded
from stream_dmr.reasons import Reason
from stream_dmr.species import UNSURE, SpeciesEvidence, SpeciesSettings, is_longer_than_known


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
        tail_gives: str | None = None,
    ) -> None:
        """With `zones` a final estimate has a fate; `frame_size`: width and height, px.

        It has a species if a classifier has seen the fish; `tail_gives`: see Template.
        """
        self._settings = settings
        self._zones, self._frame_size = zones or ZonesSettings(), frame_size
        self._species, self._tail_gives = species or SpeciesSettings(), tail_gives
        self._open: dict[int, _Track] = {}
        self._ended: set[int] = set()
        self._last: LocalizedFish | None = None

    def step(self, message: LocalizedFish, /) -> Sequence[LengthEstimate]:
        """Return the running estimate of this fish after a further frame."""
        self._last = message
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

    def end(self, ended: TrackEnded, /) -> Sequence[LengthEstimate]:
        """Finish the track of a fish, if it has any frames."""
        return [self._finish(ended)] if ended.track_id in self._open else []

    def close(self) -> Sequence[LengthEstimate]:
        """Finish the tracks whose end was lost, since the chain was stopped."""
        last = self._last
        if last is None:
            return []
        return [self._finish(TrackEnded.after(last, track_id, "end")) for track_id in [*self._open]]

    def _finish(self, ended: TrackEnded) -> LengthEstimate:
        self._ended.add(ended.track_id)
        track = self._open.pop(ended.track_id)
        return self._with_species(self._with_fate(track.length.finish(), track, ended), track)

    def _with_fate(
        self, estimate: LengthEstimate, track: _Track, ended: TrackEnded
    ) -> LengthEstimate:
        if not any(self._zones.polygons()):
            return estimate
        fate = track.fate.finish(ended)
        return replace(estimate, fate=fate.name, fate_share=fate.share)

    def _with_species(self, estimate: LengthEstimate, track: _Track) -> LengthEstimate:
        found = track.species.best()
        if found is None:
            return estimate
        code = found.code if found.share >= self._species.min_share else UNSURE
        estimate = replace(estimate, species_code=code, species_share=found.share)
        low_mm = None if estimate.ci95_mm is None else float(estimate.ci95_mm[0])
        if low_mm is None or not is_longer_than_known(code, low_mm, given=self._tail_gives):
            return estimate
        status = Reason.LONGER_THAN_SPECIES
        return replace(estimate, length_mm=None, length_std_mm=None, ci95_mm=None, status=status)
