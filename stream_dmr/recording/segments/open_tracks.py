"""Tracks that are open when a segment ends or a run is interrupted, and their frames so far."""

from collections import deque
from collections.abc import Collection, Iterator
from functools import partial
from itertools import chain

from stream_dmr.messages import LengthEstimate, LocalizedFish
from stream_dmr.reasons import Reason
from stream_dmr.recording.messages.codec import decode, encode
from stream_dmr.recording.messages.record import Record
from stream_dmr.recording.reading.open_recording import Recording

_MAX_FRAMES = 4096  # per track, over two minutes at 30 frames/s; of longer tracks the last ones


class OpenTracks:
    """Keeps, of each open track, the records of LocalizedFish that its length is made of."""

    def __init__(self) -> None:
        self._tracks: dict[int, deque[Record]] = {}

    def add(self, record: Record) -> None:
        """Take any record, in the order of the recording; a final length ends its track."""
        match record.message:
            case LocalizedFish(track_id=track_id):
                self._tracks.setdefault(track_id, deque(maxlen=_MAX_FRAMES)).append(record)
            case LengthEstimate() as estimate:
                if estimate.is_final or estimate.frame_reason == str(Reason.TRACK_ENDED):
                    self._tracks.pop(estimate.track_id, None)
            case _:
                pass

    def add_earlier(self, fish: LocalizedFish) -> None:
        """Take a frame that an earlier recording has."""
        self.add(Record(message=fish, whole=fish, encoding=partial(encode, fish)))

    def records(self) -> Iterator[Record]:
        """The records of all open tracks, track by track."""
        for records in self._tracks.values():
            yield from records


def unfinished_frames(
    recording: Recording, *, finished: Collection[int]
) -> Iterator[LocalizedFish]:
    """The frames of all tracks in a recording but the `finished` ones, in its order."""
    recorded = (payload for _, payload in recording.payloads([LocalizedFish]))
    for payload in chain(recording.carried_over(), recorded):
        fish = decode(LocalizedFish, payload)
        if fish.track_id not in finished:
            yield fish
