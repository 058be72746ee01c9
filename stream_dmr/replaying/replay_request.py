"""What a user asks of a replay."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stream_dmr.messages import FishCrop, FittedMesh, LengthEstimate, LocalizedFish, Message
from stream_dmr.recording.messages.selection import EVERYTHING, Selection

STAGES: dict[str, type[Message]] = {
    "crop": FishCrop,
    "fit": FittedMesh,
    "localize": LocalizedFish,
    "smooth": LengthEstimate,
}


@dataclass(frozen=True, kw_only=True)
class ReplayRequest:
    """What to replay; None: as it was recorded."""

    recordings: Sequence[Path]  # files or folders, in order
    first: str = "fit"  # the first of STAGES that is recomputed
    config: Path | None = None
    calibration: Path | None = None
    template: str | None = None
    source: str | None = None  # for `crop`
    boxes: Path | None = None  # for `crop`; boxes or masks stand for both of the run
    masks: Path | None = None  # for `crop`
    selection: Selection = EVERYTHING
    out: Path | None = None  # None: nothing is written
    overwrite: bool = False
    key: Path | None = None  # of the device, to sign what is written
    check: bool = False  # compare with what was recorded
    command: str = ""  # as typed, for the new recording

    @property
    def first_index(self) -> int:
        """Index of the first recomputed stage in STAGES."""
        return [*STAGES].index(self.first)

    @property
    def recomputed(self) -> Sequence[type[Message]]:
        """The types of the messages that are recomputed."""
        return [*STAGES.values()][self.first_index :]
