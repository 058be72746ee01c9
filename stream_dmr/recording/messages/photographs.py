"""Which crops of a fish keep their pictures, where its frames are not kept."""

from stream_dmr.messages import FishCrop

_MAX_TRACKS = 1000  # that are counted at a time: those that came last; chosen


class PhotographChooser:
    """Chooses the 1st, 2nd, 4th, 8th, ... crop in which a fish does not touch the border.

    So a fish has a few photographs from all of the time that it is in view: 1 + log2(n) of n crops.
    Of one that always touches the border, the first is chosen.
    """

    def __init__(self) -> None:
        self._inside: dict[int, int] = {}  # crops of each track inside the picture

    def takes(self, crop: FishCrop) -> bool:
        """True for a crop whose picture is to be kept; each crop is asked about once, in order."""
        is_new = crop.track_id not in self._inside
        count = self._inside.setdefault(crop.track_id, 0)
        if len(self._inside) > _MAX_TRACKS:
            del self._inside[next(iter(self._inside))]
        if crop.quality.touches_border:
            return is_new
        self._inside[crop.track_id] = count = count + 1
        return count & (count - 1) == 0
