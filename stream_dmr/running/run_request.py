"""What a user asks of a run."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class RunRequest:
    """The options of `stream-dmr run`."""

    source: str  # path, address or camera index
    out: Path
    calibration: Path | None = None
    boxes: Path | None = None
    masks: Path | None = None
    template: str = "halibut"  # name of a bundled one, or a path
    config: Path | None = None
    overwrite: bool = False  # replace the results of an earlier run in `out`
    resume: bool = False  # go on after them; a live source always does
    live: bool = False  # serve the view while measuring
    command: str = ""  # as typed, for the recording
    vessel: str = ""  # where the fish come from, for the exports
    trip: str = ""
    haul: str = ""
