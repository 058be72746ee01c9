"""Everything that a report shows of one run, or of one video of a batch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from stream_dmr.recording.reading.open_recording import Recording
from stream_dmr.report.drawn_views import DrawnViews
from stream_dmr.report.recorded_tracks import RecordedTrack
from stream_dmr.results.effort import HaulEffort
from stream_dmr.results.finished_fish import FishResult
from stream_dmr.results.fisheries import FisheriesSettings
from stream_dmr.results.track_edits import NO_EDITS, TrackEdits
from stream_dmr.results.vessel_track import VesselTrack
from stream_dmr.running.config import Config


@dataclass(frozen=True, eq=False, kw_only=True)
class RunReport:
    """The results of one run with what was recorded of each fish."""

    path: Path
    recording: Recording
    fish: Sequence[FishResult]
    tracks: Mapping[int, RecordedTrack]  # by track id
    views: DrawnViews
    config: Config  # of the run
    settings: FisheriesSettings
    edits: TrackEdits = NO_EDITS  # of reviewers, which `fish`, `tracks` and `views` follow
    source: str | None = None  # where the user says that the source is
    efforts: Sequence[HaulEffort] = ()  # of its hauls; none of a recording without its database
    track: VesselTrack | None = None  # None: likewise
    notes: Sequence[str] = ()  # what a reader must know of the run

    @property
    def title(self) -> str:
        """The name of the results' folder or file."""
        return self.path.resolve().name

    @property
    def span_s(self) -> tuple[float, float]:
        """Capture times of the first and of the last fish; 0 and 0 without any."""
        estimates = [one.estimate for one in self.fish]
        first = min((one.first_timestamp_ns for one in estimates), default=0)
        return first / 1e9, max((one.last_timestamp_ns for one in estimates), default=0) / 1e9
