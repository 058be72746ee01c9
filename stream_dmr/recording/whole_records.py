"""Complete recorded messages for drawing, with those of a second camera in between."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial

from stream_dmr.messages import FishMessage, FittedMesh, Frame, Message
from stream_dmr.recording.frame_images import FrameRestorer
from stream_dmr.recording.header import SecondCamera
from stream_dmr.recording.record import Record
from stream_dmr.recording.view_geometry import MAX_PENDING, MeshRebuilder


class WholeRecords:
    """Makes records of messages that were recorded before, with pictures and vertices.

    Messages of a second camera come in between, drawn with the first camera's frame nearest in
    time. Messages from before the first frame have frame 0, which is not drawn.
    """

    def __init__(
        self,
        meshes: MeshRebuilder | None,
        pictures: FrameRestorer | None = None,
        *,
        second: SecondCamera | None = None,
        of_second: Iterable[tuple[Message, bytes]] = (),
        second_pictures: FrameRestorer | None = None,
    ) -> None:
        """`meshes`: None if nothing is drawn. `of_second`: the second camera's messages."""
        self._meshes, self._pictures = meshes, pictures
        self._offset_ns = 0 if second is None else second.offset_ns
        self._ids = {} if second is None else second.ids
        self._of_second, self._second_pictures = iter(of_second), second_pictures
        self._next = next(self._of_second, None)
        self._last: Frame | None = None
        # Frame index and time of the first camera, by the second's index: crops come after later
        # frames, as many as the queues of its run held.
        self._shown: dict[int, tuple[int, int]] = {}

    def of(self, message: Message, payload: bytes) -> Iterator[Record]:
        """The record of a message, after the second camera's records from before it."""
        whole = message
        if isinstance(message, Frame):
            since_ns = message.timestamp_ns if self._last is None else self._last.timestamp_ns
            yield from self._seconds((since_ns + message.timestamp_ns) // 2 + self._offset_ns)
            self._last = message
            if self._pictures is not None:
                whole = self._pictures.restore(message, payload)
        elif isinstance(message, FittedMesh) and self._meshes is not None:
            whole = self._meshes.with_vertices(message)
        yield Record(message=message, whole=whole, encoding=partial(bytes, payload))

    def rest(self) -> Iterator[Record]:
        """The messages that are left of the second camera."""
        return self._seconds(None)

    def _seconds(self, until_ns: int | None) -> Iterator[Record]:
        while self._next is not None:
            message, payload = self._next
            if until_ns is not None and message.timestamp_ns >= until_ns:
                return
            yield Record(
                message=message,
                whole=self._drawn(message, payload),
                encoding=partial(bytes, payload),
                is_second=True,
            )
            self._next = next(self._of_second, None)

    def _drawn(self, message: Message, payload: bytes) -> Message:
        if isinstance(message, Frame):
            if self._last is not None:
                place = self._last.frame_index, self._last.timestamp_ns
                self._shown[message.frame_index] = place
                self._shown.pop(message.frame_index - MAX_PENDING, None)
            if self._second_pictures is not None:
                message = self._second_pictures.restore(message, payload)
        frame_index, timestamp_ns = self._shown.get(message.frame_index, (0, 0))
        if isinstance(message, FishMessage):
            message = replace(message, track_id=self._ids.get(message.track_id, 0))
        return replace(message, frame_index=frame_index, timestamp_ns=timestamp_ns)
