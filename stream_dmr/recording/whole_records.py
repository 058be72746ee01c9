"""Recorded messages with what drawing needs beside them, those of a second camera in between."""

from collections.abc import Iterator
from dataclasses import replace

from stream_dmr.messages import FishMessage, FittedMesh, Frame, Message
from stream_dmr.recording.frame_images import FrameRestorer
from stream_dmr.recording.header import SecondCamera
from stream_dmr.recording.record import Record
from stream_dmr.recording.view_geometry import MAX_PENDING, MeshRebuilder


class SecondRecords:
    """The second camera's messages, each drawn with the first camera's frame next to it in time.

    Those from before its first frame have frame 0, which is not drawn.
    """

    def __init__(
        self,
        messages: Iterator[tuple[Message, bytes]],
        camera: SecondCamera,
        pictures: FrameRestorer | None,
    ) -> None:
        self._messages, self._camera, self._pictures = messages, camera, pictures
        self._next = next(messages, None)
        self._frame: Frame | None = None  # the first camera's last one
        # Frame index and time of the first camera, by the second's index: crops come after later
        # frames, as many as the queues of its run held.
        self._shown: dict[int, tuple[int, int]] = {}

    def before(self, frame: Frame | None) -> Iterator[Record]:
        """Those that are nearer to the frame before this one; None: all that are left."""
        last, self._frame = self._frame, frame
        until_ns = None
        if frame is not None:
            until_ns = frame.timestamp_ns if last is None else last.timestamp_ns
            until_ns = (until_ns + frame.timestamp_ns) // 2 + self._camera.offset_ns
        while self._next is not None:
            message, payload = self._next
            if until_ns is not None and message.timestamp_ns >= until_ns:
                return
            if isinstance(message, Frame) and last is not None:
                self._shown[message.frame_index] = last.frame_index, last.timestamp_ns
                self._shown.pop(message.frame_index - MAX_PENDING, None)
            whole = self._drawn(message, payload)
            yield Record.of_payload(message, payload, whole=whole, is_second=True)
            self._next = next(self._messages, None)

    def _drawn(self, message: Message, payload: bytes) -> Message:
        frame_index, timestamp_ns = self._shown.get(message.frame_index, (0, 0))
        if isinstance(message, Frame) and self._pictures is not None:
            message = self._pictures.restore(message, payload)
        elif isinstance(message, FishMessage):
            message = replace(message, track_id=self._camera.ids.get(message.track_id, 0))
        return replace(message, frame_index=frame_index, timestamp_ns=timestamp_ns)


class WholeRecords:
    """Makes records of messages that were recorded before, with pictures and vertices."""

    def __init__(
        self,
        meshes: MeshRebuilder,
        pictures: FrameRestorer | None,
        second: SecondRecords | None,
    ) -> None:
        self._meshes, self._pictures, self._second = meshes, pictures, second

    def of(self, message: Message, payload: bytes) -> Iterator[Record]:
        """The record of a message, after those of the second camera that come before it."""
        whole = message
        if isinstance(message, Frame):
            if self._second is not None:
                yield from self._second.before(message)
            if self._pictures is not None:
                whole = self._pictures.restore(message, payload)
        elif isinstance(message, FittedMesh):
            whole = self._meshes.with_vertices(message)
        yield Record.of_payload(message, payload, whole=whole)

    def rest(self) -> Iterator[Record]:
        """What is left of the second camera."""
        if self._second is not None:
            yield from self._second.before(None)
