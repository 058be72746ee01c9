"""What a segment takes over from the one before it: the fish that are in view at the cut."""

from collections import deque
from collections.abc import Collection, Iterator
from functools import partial
from itertools import chain

from stream_dmr.messages import LengthEstimate, LocalizedFish
from stream_dmr.reasons import Reason
from stream_dmr.recording.messages.codec import decode, encode
from stream_dmr.recording.messages.record import Record
from stream_dmr.recording.reading.reader import Recording

_MOST_FRAMES = 4096  # of one fish; of one that is in view for longer, the last ones


class Carried:
    """Keeps the records of open tracks that a length is made of."""

    def __init__(self) -> None:
        self._tracks: dict[int, deque[Record]] = {}

    def take(self, record: Record) -> None:
        """Take any record, in the order of the recording."""
        match record.message:
            case LocalizedFish(track_id=track_id):
                self._tracks.setdefault(track_id, deque(maxlen=_MOST_FRAMES)).append(record)
            case LengthEstimate() as estimate:
                if estimate.is_final or estimate.frame_reason == Reason.TRACK_ENDED:
                    self._tracks.pop(estimate.track_id, None)
            case _:
                pass

    def records(self) -> Iterator[Record]:
        """Those of all open tracks, track by track."""
        for records in self._tracks.values():
            yield from records


def unfinished(recording: Recording, *, finished: Collection[int]) -> Iterator[LocalizedFish]:
    """The frames of all fish in a recording but those `finished`, in its order."""
    recorded = (payload for _, payload in recording.payloads([LocalizedFish]))
    for payload in chain(recording.carried(), recorded):
        fish = decode(LocalizedFish, payload)
        if fish.track_id not in finished:
            yield fish


def carried_record(fish: LocalizedFish) -> Record:
    """A frame of a fish as an earlier recording had it."""
    return Record(message=fish, whole=fish, encoding=partial(encode, fish))
