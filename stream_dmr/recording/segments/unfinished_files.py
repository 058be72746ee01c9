"""Repairs what a full disk left unfinished, while the run goes on."""

import os
from collections.abc import Callable
from pathlib import Path
from threading import Thread

from stream_dmr.recording.mcap.mcap_sink import PART
from stream_dmr.recording.segments.repair import is_unfinished, repair_file


class UnfinishedFiles:
    """The files of segments that have no end yet, repaired in a thread of their own.

    Only files that nobody writes belong here: a repair renames them.
    """

    def __init__(
        self, *, on_notice: Callable[[str], None], on_closed: Callable[[Path], None]
    ) -> None:
        """`on_notice` gets a line about each repair, `on_closed` each file that is whole then."""
        self._on_notice, self._on_closed = on_notice, on_closed
        self._paths: list[Path] = []
        self._thread = Thread(target=self._repair)

    def add(self, path: Path) -> None:
        """Keep in mind what a sink left of the file `path`, if anything.

        A name without a file may be that of the next segment, which must not be repaired while it
        is written.
        """
        left = (path, path.with_name(path.name + PART))
        self._paths += [one for one in left if os.path.exists(one)]  # False where the disk fails

    def repair_soon(self) -> None:
        """Begin to repair them; this may take a while."""
        if self._paths and not self._thread.is_alive():
            self._thread = Thread(target=self._repair, name="repairs")
            self._thread.start()

    def finish(self) -> None:
        """Repair what is left, and wait for it."""
        if self._thread.is_alive():
            self._thread.join()
        self._repair()

    def _repair(self) -> None:
        paths, self._paths = self._paths, []
        for path in filter(is_unfinished, paths):
            repaired = repair_file(path, left_by="a disk that refused its end")
            self._on_notice(repaired.line)
            self._on_closed(repaired.path)
            if repaired.path == path:  # the disk may have refused the repair as well
                self._paths.append(path)
