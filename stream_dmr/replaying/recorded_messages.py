"""The recorded messages, and the nodes that give them instead of computing them."""

from collections.abc import Iterator, Sequence

from stream_dmr.errors import RecordingError
from stream_dmr.messages import FishCrop, FittedMesh, Frame, LocalizedFish, Message
from stream_dmr.recording.messages.codec import decode
from stream_dmr.recording.messages.selection import WHOLE, Part
from stream_dmr.recording.reading.frame_images import RecordedPictures, Restorer, is_as_seen
from stream_dmr.recording.reading.reader import Recording, messages


class Tape:
    """The recorded messages of each kind, in their order."""

    def __init__(self, recording: Recording, part: Part = WHOLE) -> None:
        self._recording = recording
        self._part = part
        self.notes: list[str] = []  # what the user should know of this replay
        self._payloads: dict[int, bytes] = {}  # of messages on their way to a new recording

    @property
    def ends_early(self) -> bool:
        """Whether more followed than was recorded."""
        return self._recording.ends_early

    def carried(self) -> list[LocalizedFish]:
        """The frames, before this recording, of fish that were in view when it began.

        A part in time begins without them.
        """
        if self._part.time_ns is not None:
            return []
        fish = [decode(LocalizedFish, payload) for payload in self._recording.carried()]
        return [message for message in fish if self._part.has(message)]

    def messages(self, kind: type[Message], *, keep: bool = True) -> Iterator[Message]:
        """Those of the wanted tracks and times."""
        for message, payload in messages(self._recording, [kind], self._part):
            if keep:
                self._payloads[id(message)] = payload
            yield message

    def frames(self) -> Iterator[Frame]:
        """The frames, without pictures where they were recorded by reference."""
        for message in self.messages(Frame):
            assert isinstance(message, Frame)
            yield message

    def pictures(
        self, found: Restorer | None, *, exact: bool, missing_source: str
    ) -> Iterator[Frame]:
        """The frames with their pictures, `found` or as the recording holds them.

        Raises RecordingError where it holds none, and, with `exact`, where they are not to the
        last bit those that the run went on from; without it, `notes` says so. `missing_source` says
        why the source was not found.
        """
        found = found or RecordedPictures(self._recording, self._part)
        for frame in self.frames():
            payload = self._payloads.pop(id(frame))
            whole = found.restore(frame, payload)
            if whole.image.size == 0:
                raise RecordingError(
                    f"--from crop: the recording refers to its source's pictures: {missing_source}"
                )
            if not is_as_seen(whole, payload):
                self._note_for_the_eye(exact=exact)
            self._payloads[id(whole)] = payload
            yield whole

    def _note_for_the_eye(self, *, exact: bool) -> None:
        line = "the recording's pictures are for the eye, the run saw better ones"
        if exact:
            raise RecordingError(f"--from crop --check: {line}; give --source")
        note = f"{line}: crops come out a little otherwise; --source would mend that"
        if note not in self.notes:
            self.notes.append(note)

    def payload(self, message: Message) -> bytes:
        """The encoding of a message that came from here; once."""
        return self._payloads.pop(id(message))


class Playback:
    """In place of a node: gives the messages that it gave when it was recorded."""

    def __init__(self, tape: Tape, kind: type[Message]) -> None:
        self._messages = tape.messages(kind)
        self._next = next(self._messages, None)

    def step(self, message: Frame | FishCrop | FittedMesh, /) -> Sequence[Message]:
        """Give all of a frame, or that of one fish of it."""
        given: list[Message] = []
        while self._next is not None and self._next.frame_index <= message.frame_index:
            if self._next.frame_index == message.frame_index:
                if not isinstance(message, Frame) and self._track_id() != message.track_id:
                    break
                given.append(self._next)
            self._next = next(self._messages, None)
        return given

    def _track_id(self) -> int:
        return getattr(self._next, "track_id", 0)

    def tick(self, timestamp_ns: int, /) -> Sequence[Message]:
        """Nothing but what was recorded."""
        return ()

    def close(self) -> Sequence[Message]:
        """Nothing but what was recorded."""
        return ()
