"""Numbers the tracks of a run on after those of earlier runs in the same folder."""

from dataclasses import replace

from stream_dmr.messages import FishCrop, Message


class TrackNumbering:
    """Gives each fish its `track_id`, which no other fish of the output folder has."""

    def __init__(self, *, after: int) -> None:
        """`after`: the last id of earlier runs."""
        self._after = after

    def number(self, message: Message) -> Message:
        """A FishCrop with its `track_id`; messages of later stages take it over."""
        if not isinstance(message, FishCrop):
            return message
        return replace(message, track_id=message.track_id + self._after)
