"""The one place where a fish gets its `track_id`.

Three numbers name a fish on its way. A detection's `source_id` is that of its annotation file or of
its track in the tracker, and stays inside of segmentation. `TrackNumbering` turns it into the
`track_id` of the FishCrop, once; every later message, table, database and recording has that one.
"""


class TrackNumbering:
    """Assigns track ids, each to one fish of the output folder, from 1.

    An annotated fish keeps the id of its file; tracked ones are numbered as they come. Both are
    counted on after the ids of earlier runs in the same folder.
    """

    def __init__(self, *, keeps_source_ids: bool) -> None:
        """`keeps_source_ids`: the ids of annotation files, instead of new numbers."""
        self._keeps_source_ids = keeps_source_ids
        self._last_id = 0  # of earlier runs
        self._ids: dict[int, int] = {}  # by source id

    def resume_after(self, track_id: int) -> None:
        """Number all fish after this id of an earlier run; call it before the first fish."""
        self._last_id = track_id

    def track_id(self, source_id: int) -> int:
        """The id of a fish, always the same for the same `source_id`."""
        if self._keeps_source_ids:
            return self._last_id + source_id
        return self._ids.setdefault(source_id, self._last_id + len(self._ids) + 1)
