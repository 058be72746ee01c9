"""The crops of a first pass over a source, kept so that its fish are found only once."""

from collections.abc import Callable, Iterator, Sequence
from tempfile import SpooledTemporaryFile
from threading import Event
from typing import IO

from stream_dmr.messages import FishCrop, Frame, Message
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.nodes.read_frames import ReadFrames
from stream_dmr.recording.messages.codec import decode, encode
from stream_dmr.recording.messages.record import make_record
from stream_dmr.recording.messages.recording_settings import RecordingSettings
from stream_dmr.running.pipeline import run_chain

_IN_MEMORY = 1 << 26  # bytes of crops: some 100,000 masks; more are kept on the disk


class KeptCrops:
    """The crops of a first pass: in place of CropFish, a node that gives them again."""

    def __init__(self, *, in_memory: int = _IN_MEMORY) -> None:
        """Beyond so many bytes they go to the disk."""
        self._file: IO[bytes] = SpooledTemporaryFile(in_memory)  # noqa: SIM115, see `close`
        self._places: dict[int, list[tuple[int, int]]] = {}  # of each frame: offsets and sizes

    def keep(self, crop: FishCrop) -> None:
        """Take one more crop."""
        data = encode(crop)
        self._places.setdefault(crop.frame_index, []).append((self._file.tell(), len(data)))
        self._file.write(data)

    def __iter__(self) -> Iterator[FishCrop]:
        """All crops, in the order in which they came."""
        return (crop for frame_index in self._places for crop in self._of(frame_index))

    def step(self, frame: Frame, /) -> Sequence[FishCrop]:
        """The crops of a frame."""
        return self._of(frame.frame_index)

    def tick(self, timestamp_ns: int, /) -> Sequence[FishCrop]:
        """Nothing waits for time to pass."""
        return ()

    def close(self) -> Sequence[FishCrop]:
        """Close the file; no output at the end."""
        self._file.close()
        return ()

    def _of(self, frame_index: int) -> list[FishCrop]:
        crops: list[FishCrop] = []
        for offset, size in self._places.get(frame_index, []):
            self._file.seek(offset)
            crops.append(decode(FishCrop, self._file.read(size)))
        return crops


def keep_crops(
    frames: ReadFrames,
    crop_fish: CropFish,
    settings: RecordingSettings,
    *,
    stop: Event,
    on_frame: Callable[[], None],
) -> KeptCrops:
    """The crops of a source, as a recording with these settings would hold them."""
    kept = KeptCrops()

    def take(message: Message) -> Message:
        message = make_record(message, settings).message  # from decoded pixels, as in the run
        if isinstance(message, FishCrop):
            kept.keep(message)
        return message

    run_chain(frames, [crop_fish], on_message=take, on_frame=on_frame, stop=stop)
    return kept
