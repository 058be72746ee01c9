"""The recorded messages, and nodes that return them instead of computing them."""

from collections.abc import Iterator, Sequence
from typing import TypeVar

from stream_dmr.errors import RecordingError
from stream_dmr.messages import FishCrop, FittedMesh, Frame, LocalizedFish, Message
from stream_dmr.recording.messages.codec import decode
from stream_dmr.recording.messages.selection import EVERYTHING, Selection
from stream_dmr.recording.reading.frame_images import (
    FrameRestorer,
    RecordedPictures,
    has_original_pixels,
)
from stream_dmr.recording.reading.open_recording import Recording

M = TypeVar("M", bound=Message)


class RecordedMessages:
    """The selected messages of a recording, type by type, each in their order."""

    def __init__(self, recording: Recording, selection: Selection = EVERYTHING) -> None:
        self._recording = recording
        self._selection = selection
        self.notes: list[str] = []  # what the user should know of this replay
        self._payloads: dict[int, bytes] = {}  # by id() of messages on their way through the chain

    @property
    def ends_early(self) -> bool:
        """True where the run went on after the end of the recording."""
        return self._recording.ends_early

    def carried_over(self) -> list[LocalizedFish]:
        """The frames from before the recording of the tracks that were open when it began.

        None of a selection in time, which begins without them.
        """
        if self._selection.time_ns is not None:
            return []
        fish = [decode(LocalizedFish, payload) for payload in self._recording.carried_over()]
        return [message for message in fish if self._selection.includes(message)]

    def of_type(self, kind: type[M], *, keep_payloads: bool = True) -> Iterator[M]:
        """The messages of one type; `payload` gives the encoding of each that was kept.

        Frames have no images where they were recorded by reference.
        """
        for _, payload in self._recording.payloads([kind], self._selection):
            message = decode(kind, payload)
            if self._selection.includes(message):
                if keep_payloads:
                    self._payloads[id(message)] = payload
                yield message

    def frames_with_images(
        self, restorer: FrameRestorer | None, *, exact: bool, missing_source: str
    ) -> Iterator[Frame]:
        """The frames with the images of `restorer`, or with those that the recording holds.

        Raises RecordingError where it holds none (`missing_source` says why the source was not
        found) and, with `exact`, where they are not the very pixels that the run continued with;
        without `exact`, `notes` says so.
        """
        restorer = restorer or RecordedPictures(self._recording, self._selection)
        for frame in self.of_type(Frame):
            payload = self._payloads.pop(id(frame))
            restored = restorer.restore(frame, payload)
            if restored.image.size == 0:
                raise RecordingError(
                    f"--from crop: the recording refers to its source's pictures: {missing_source}"
                )
            if not has_original_pixels(restored, payload):
                self._note_lossy_pictures(exact=exact)
            self._payloads[id(restored)] = payload
            yield restored

    def _note_lossy_pictures(self, *, exact: bool) -> None:
        line = "the recording's pictures are for viewing, the run used better ones"
        if exact:
            raise RecordingError(f"--from crop --check: {line}; give --source")
        note = f"{line}: crops differ a little; give --source to avoid that"
        if note not in self.notes:
            self.notes.append(note)

    def payload(self, message: Message) -> bytes:
        """The encoding of a message that came from here; only once."""
        return self._payloads.pop(id(message))


class PlaybackNode:
    """Takes the place of a node and returns the messages that the node returned in the run."""

    def __init__(self, recorded: RecordedMessages, kind: type[Message]) -> None:
        self._messages = recorded.of_type(kind)
        self._next = next(self._messages, None)

    def step(self, message: Frame | FishCrop | FittedMesh, /) -> Sequence[Message]:
        """The recorded messages of a frame, or that of one fish in a frame."""
        recorded: list[Message] = []
        while self._next is not None and self._next.frame_index <= message.frame_index:
            if self._next.frame_index == message.frame_index:
                if not isinstance(message, Frame) and self._track_id() != message.track_id:
                    break
                recorded.append(self._next)
            self._next = next(self._messages, None)
        return recorded

    def _track_id(self) -> int:
        return getattr(self._next, "track_id", 0)

    def tick(self, timestamp_ns: int, /) -> Sequence[Message]:
        """Nothing: `step` returns everything that was recorded."""
        return ()

    def close(self) -> Sequence[Message]:
        """Nothing: `step` returns everything that was recorded."""
        return ()
