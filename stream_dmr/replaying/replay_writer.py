"""Takes every message of a replay: records it, has it compared, and counts."""

from collections.abc import Sequence

from stream_dmr.messages import Frame, LengthEstimate, Message, Position
from stream_dmr.recording.messages.record import Record, as_recorded
from stream_dmr.recording.messages.recording_settings import RecordingSettings
from stream_dmr.replaying.comparator import MessageComparator
from stream_dmr.replaying.recorded_messages import RecordedMessages
from stream_dmr.replaying.replay_outputs import ReplayOutputs


class ReplayWriter:
    """Passes every message of the chain on as a recording gives it back."""

    def __init__(
        self,
        recorded: RecordedMessages,
        *,
        recomputed: Sequence[type[Message]],
        settings: RecordingSettings,
        outputs: ReplayOutputs | None,
        comparator: MessageComparator | None,
    ) -> None:
        self._recorded, self._recomputed, self._settings = recorded, recomputed, settings
        self._outputs, self._comparator = outputs, comparator
        self._first_ns: int | None = None
        self._last_ns = 0
        self._positions = recorded.of_type(Position, keep_payloads=False)
        self._next_position = None if outputs is None else next(self._positions, None)
        self.final: list[LengthEstimate] = []
        self.num_frames = 0

    @property
    def recorded_s(self) -> float:
        """Capture time from the first frame to the last, in seconds."""
        return (self._last_ns - (self._first_ns or 0)) / 1e9 if self.num_frames else 0.0

    def write(self, message: Message) -> Message:
        """Record, compare and count a message; returns it as the next node is to get it."""
        if type(message) in self._recomputed:
            return self._write_recomputed(message)
        payload = self._recorded.payload(message)
        if isinstance(message, Frame):
            self.num_frames += 1
            self._first_ns = message.timestamp_ns if self._first_ns is None else self._first_ns
            self._last_ns = message.timestamp_ns
        if self._outputs is not None:
            self._outputs.results.store(message)
            self._outputs.recorder.put(Record.of_payload(message, payload))
            if isinstance(message, Frame):
                self._put_positions(self._outputs, message.frame_index)
        return message

    def finish(self) -> None:
        """Record the positions after the last frame."""
        if self._outputs is not None:
            self._put_positions(self._outputs, None)

    def _put_positions(self, outputs: ReplayOutputs, until_frame: int | None) -> None:
        """Record the positions up to a frame, as they were recorded; None: all that are left."""
        while (position := self._next_position) is not None:
            if until_frame is not None and position.frame_index > until_frame:
                return
            outputs.results.write(position)
            self._next_position = next(self._positions, None)

    def frame_done(self) -> None:
        """Take note that a frame has left the last stage."""
        if self._outputs is not None:
            self._outputs.results.frame_done()

    def _write_recomputed(self, message: Message) -> Message:
        if self._outputs is not None:
            message = self._outputs.results.write(message)
        else:
            message = as_recorded(message, self._settings)
        if self._comparator is not None:
            self._comparator.compare(message)
        if isinstance(message, LengthEstimate) and message.is_final:
            self.final.append(message)
        return message
