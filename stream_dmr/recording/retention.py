"""Frees disk space by deleting the oldest recordings, step by step; lengths are never deleted."""

import os
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from functools import partial
from pathlib import Path
from threading import Event, Thread

from stream_dmr.errors import OutputError, RecordingError
from stream_dmr.files import free_bytes, natural_order, rename_durably
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.recording.codec import decode, without_picture
from stream_dmr.recording.mcap.mcap_recording import McapRecording
from stream_dmr.recording.mcap.mcap_sink import PART
from stream_dmr.recording.record import PhotographChooser
from stream_dmr.recording.recorder import STEM
from stream_dmr.recording.repair import rewrite
from stream_dmr.recording.rerun.rrd_file import is_closed
from stream_dmr.recording.topics import FOXGLOVE_TOPICS, THINNED, TOPICS, VIDEO
from stream_dmr.tables import rotated_files

_THINNED_TOPICS = {VIDEO, *FOXGLOVE_TOPICS}
_PERIOD_S = 5.0  # chosen: a run writes some 10 MB in that time


@dataclass(eq=False)
class Retention:
    """Frees space in the folder of a run whenever the disk has less than `free_bytes` left.

    Old tables of frames, whose rows the segments have, are deleted first, then the views and the
    pictures and masks of the oldest segments but for some photographs, then whole segments;
    segments with a track of `flagged()` after all others. Files that are being written are kept.
    """

    folder: Path
    _: KW_ONLY
    free_bytes: int
    flagged: Callable[[], Collection[int]]
    on_notice: Callable[[str], None]
    on_changed: Callable[[Path], None] = lambda path: None

    def __post_init__(self) -> None:
        self._known: dict[str, tuple[Collection[int], bool]] = {}  # by stem, see `_facts`
        self._stop = Event()
        self._thread = Thread(target=self._watch, name="retention", daemon=True)

    def start(self) -> None:
        """Check the free space from now on, in a thread of its own."""
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def free_space(self) -> None:
        """Delete until enough is free or nothing is left to delete.

        Raises OSError or OutputError if the disk fails.
        """
        if not self.free_bytes or not self.folder.is_dir():
            return
        done: Counter[str] = Counter()
        steps = self._steps()
        while free_bytes(self.folder) < self.free_bytes and not self._stop.is_set():
            if (step := next(steps, None)) is None:
                break
            done[step] += 1
        if done:
            what = ", ".join(f"{step} of {count}" for step, count in done.items())
            wanted = f"{self.free_bytes / 1e9:g} GB"
            self.on_notice(f"less than {wanted} were free, so the oldest recordings went: {what}")

    def _watch(self) -> None:
        while not self._stop.wait(_PERIOD_S):
            with suppress(OSError, OutputError):  # measuring continues
                self.free_space()

    def _steps(self) -> Iterator[str]:
        """Delete step by step, and yield the name of each deleted part for the notice."""
        for table in rotated_files(self.folder / "frames.csv"):
            yield from self._remove(table, "the table of frames")
        # Of weeks there are tens of thousands: each is looked at when it is its turn.
        there = set(os.listdir(self.folder))
        names = [name for name in there if name.startswith(f"{STEM}-")]
        names = {name.rpartition(".")[0] for name in names if name.endswith((".mcap", ".rrd"))}
        stems = sorted(map(self.folder.joinpath, names), key=natural_order)
        flagged = frozenset(self.flagged())
        for flag in (False, True):
            group = list[Path]()
            for stem in stems:
                if _is_open(stem, there) or flagged.isdisjoint(self._facts(stem)[0]) is flag:
                    continue
                group.append(stem)
                if f"{stem.name}.rrd" in there:
                    yield from self._remove(stem.with_suffix(".rrd"), "the view")
                if not self._facts(stem)[1]:
                    yield from self._thin(stem.with_suffix(".mcap"))
            for stem in group:
                yield from self._remove(stem.with_suffix(".mcap"), "all")

    def _facts(self, stem: Path) -> tuple[Collection[int], bool]:
        """The track ids of a segment, and True if its pictures and masks are gone."""
        if stem.name not in self._known:
            try:
                file = McapRecording(stem.with_suffix(".mcap"))
                self._known[stem.name] = file.tracks(), file.is_thinned
            except RecordingError:
                self._known[stem.name] = (), True
        return self._known[stem.name]

    def _remove(self, path: Path, what: str) -> Iterator[str]:
        if path.exists():
            path.unlink()
            self.on_changed(path)
            yield what

    def _thin(self, path: Path) -> Iterator[str]:
        """Remove pictures and masks; without room for the copy, do nothing."""
        tracks, _ = self._facts(path.with_suffix(""))
        with suppress(OSError, RecordingError):
            copy, _ = rewrite(path, note=THINNED, edit=partial(_thinned, PhotographChooser()))
            rename_durably(copy, path)
            self.on_changed(path)
            self._known[path.stem] = tracks, True
            yield "pictures and masks"


def _is_open(stem: Path, there: Collection[str]) -> bool:
    """True for a segment that is written to; `there`: the names that its folder had just now."""
    rrd = stem.with_suffix(".rrd")
    has_view = rrd.name in there and rrd.exists()
    return f"{stem.name}.mcap{PART}" in there or (has_view and not is_closed(rrd))


def _thinned(chooser: PhotographChooser, topic: str, data: bytes) -> bytes | None:
    """A message without pictures and masks, but for some photographs; None if it is dropped."""
    if topic == TOPICS[FishCrop].topic:
        crop = decode(FishCrop, data)
        return data if crop.image is not None and chooser.takes(crop) else None
    if topic in _THINNED_TOPICS:
        return None
    return without_picture(data) if topic == TOPICS[Frame].topic else data
