"""Everything that a report shows of one run, or of one video of a batch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from stream_dmr.recording.reading.open_recording import Recording
from stream_dmr.report.album import Album
from stream_dmr.report.gather import Track
from stream_dmr.results.finished_fish import FishResult
from stream_dmr.results.fisheries import FisheriesSettings
from stream_dmr.running.config import Config


@dataclass(frozen=True, eq=False, kw_only=True)
class Report:
    """Gathered once."""

    path: Path
    recording: Recording
    fish: Sequence[FishResult]
    tracks: Mapping[int, Track]
    album: Album
    config: Config  # of the run
    settings: FisheriesSettings

    @property
    def title(self) -> str:
        """The results' name."""
        return self.path.resolve().name

    @property
    def span_s(self) -> tuple[float, float]:
        """Capture times of the first and of the last fish; 0 and 0 without any."""
        estimates = [one.estimate for one in self.fish]
        first = min((one.first_timestamp_ns for one in estimates), default=0)
        return first / 1e9, max((one.last_timestamp_ns for one in estimates), default=0) / 1e9
