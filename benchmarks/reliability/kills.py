"""kill -9 at random moments of a running measurement: what is left, and what the restart does."""

import random
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import combinations
from pathlib import Path
from statistics import median
from typing import TypeVar

from mcap.exceptions import McapError
from mcap.reader import make_reader

from benchmarks.reliability.camera_run import QUICK, Measurement
from benchmarks.reliability.small_scene import write_small_scene
from stream_dmr.errors import RecordingError
from stream_dmr.messages import FishCrop, Frame, LengthEstimate, LocalizedFish
from stream_dmr.recording.codec import decode
from stream_dmr.recording.reading import open_recordings
from stream_dmr.recording.repair import repair_recordings

M = TypeVar("M", Frame, FishCrop, LocalizedFish, LengthEstimate)
_STARTING, _RUNNING, _CUTTING = "while it starts", "while it measures", "while a segment ends"
_SHARES = {_STARTING: 1, _RUNNING: 2, _CUTTING: 1}


def kills(
    folder: Path, *, count: int, minutes: float = 1e9, side_by_side: int = 2, seed: int = 0
) -> dict[str, float]:
    """Kill `count` times; figures. Every second measurement draws the view as well."""
    scene = write_small_scene(folder / "scene")
    until_s = time.monotonic() + 60 * minutes
    series = [
        KilledMeasurement(
            folder / str(number),
            scene,
            count=(count + number) // side_by_side,
            config=QUICK.replace("rrd = false", "rrd = true") if number % 2 else QUICK,
            rng=random.Random(f"{seed} {number}"),
        )
        for number in range(side_by_side)
    ]
    with ThreadPoolExecutor(side_by_side) as pool:
        for _ in pool.map(lambda one: one.run(until_s), series):
            pass
    behind = [s for one in series for s in one.behind_kill_s]
    behind_csv = [s for one in series for s in one.behind_csv_s]
    figures: dict[str, float] = {}
    for one in series:
        for name, figure in one.figures.items():
            figures[name] = figures.get(name, 0) + figure
    for name, seconds in (("the kill", behind), ("frames.csv", behind_csv)):
        if seconds:
            figures[f"recording ends before {name}, s, median"] = round(median(seconds), 2)
            figures[f"recording ends before {name}, s, most"] = round(max(seconds), 2)
    return figures


class KilledMeasurement:
    """One measurement, killed and started again."""

    def __init__(
        self, folder: Path, scene: Path, *, count: int, config: str, rng: random.Random
    ) -> None:
        folder.mkdir(parents=True)
        self._run = Measurement(folder, scene, fps=15, config=config)
        self._count, self._rng = count, rng
        self._checked: set[Path] = set()
        self._made_by: dict[int, int] = {}  # number of a segment -> number of the run
        self.figures: Counter[str] = Counter()
        self.behind_kill_s: list[float] = []
        self.behind_csv_s: list[float] = []

    def run(self, until_s: float) -> None:
        """Kill until there were enough, or the time is up; then look at all that is left."""
        self._run.camera.start()
        try:
            for number in range(self._count):
                if time.monotonic() > until_s:
                    break
                self._kill_once(number)
            list(repair_recordings(self._run.out))
        finally:
            self._run.camera.lose()
        self._look()

    def _kill_once(self, number: int) -> None:
        run, known = self._run, len(self._run.events("begin"))
        moment = self._rng.choices([*_SHARES], weights=[*_SHARES.values()])[0]
        run.start()
        if moment == _STARTING:
            time.sleep(self._rng.uniform(0, 5))
        else:
            run.wait_for("begin", more_than=known)
            if moment == _CUTTING:
                self._wait_for_cut()
            time.sleep(self._rng.uniform(0, 0.3 if moment == _CUTTING else 4))
        assert run.process is not None
        run.process.kill()
        killed_ns = time.time_ns()
        run.process.wait()
        self.figures["kills"] += 1
        self.figures[moment] += 1
        for segment in numbers_of(run.out):
            self._made_by.setdefault(segment, number)
        if len(run.events("begin")) > known:
            self._compare(number, killed_ns)

    def _wait_for_cut(self) -> None:
        """Wait until the next segment has begun, and the one before it is about to end."""
        known, until = len(set(numbers_of(self._run.out))), time.monotonic() + 30
        while len(set(numbers_of(self._run.out))) <= known and time.monotonic() < until:
            time.sleep(0.01)

    def _compare(self, number: int, killed_ns: int) -> None:
        """How long before the kill, and before the last row of frames.csv, the recording ends."""
        segments = [n for n, run in self._made_by.items() if run == number]
        seen = last_ns(self._run.out, segments, Frame)
        if seen:
            self.behind_kill_s.append((killed_ns - seen) / 1e9)
        fish = last_ns(self._run.out, segments, LocalizedFish)
        row = last_row_ns(self._run.out)
        if fish and row >= fish:
            self.behind_csv_s.append((row - fish) / 1e9)

    def _look(self) -> None:
        out, said = self._run.out, [line["track_id"] for line in self._run.events("fish")]
        stored = set(self._run.fish())
        self.figures["recordings"] = len([*out.glob("*.mcap")])
        self.figures["recordings that can't be read"] = unreadable_ones(out, self._checked)
        self.figures["recordings set aside as damaged"] = len([*out.glob("*.damaged")])
        self.figures["fish"] = len(stored)
        self.figures["of them in view at a kill, finished by the restart"] = self._run.interrupted()
        recorded = {m.track_id for m in messages(out, LengthEstimate) if m.is_final}
        self.figures["finished fish lost"] = len((set(said) | recorded) - stored)
        self.figures["ids used twice"] = len(said) - len(set(said)) + self._shared_ids()

    def _shared_ids(self) -> int:
        """Ids whose crops were made by two runs."""
        ids: dict[int, set[int]] = {}
        for segment, run in self._made_by.items():
            for path in self._run.out.glob(f"recording-{segment:06d}*.mcap"):
                crops = messages(path, FishCrop)
                ids.setdefault(run, set()).update(crop.track_id for crop in crops)
        return sum(len(one & other) for one, other in combinations(ids.values(), 2))


def numbers_of(out: Path) -> Iterator[int]:
    """Of the segments in a folder, whole or not."""
    for path in out.glob("recording-*.mcap*"):
        yield int(path.name.split("-")[1].split(".")[0])


def messages(path: Path, kind: type[M]) -> Iterator[M]:
    """Those of one kind in a folder or file of recordings."""
    paths = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    for one in paths:
        for _, payload in open_recordings([one]).payloads([kind]):
            yield decode(kind, payload)


def unreadable_ones(out: Path, checked: set[Path]) -> int:
    """How many recordings, of those not yet checked, the mcap library's own reader refuses."""
    refused = 0
    for path in set(out.glob("*.mcap")) - checked:
        try:
            with path.open("rb") as stream:
                for _ in make_reader(stream, validate_crcs=True).iter_messages():
                    pass
        except (McapError, ValueError, OSError):
            refused += 1
        checked.add(path)
    return refused


def last_row_ns(out: Path) -> int:
    """The capture time of the last fish in frames.csv, which a kill leaves as it is: no fsync."""
    whole = (out / "frames.csv").read_text().rpartition("\n")[0]
    cell = whole.rpartition("\n")[2].split(",")[1]
    return int(cell) if cell.isdecimal() else 0


def last_ns(out: Path, segments: list[int], kind: type[M]) -> int:
    """The capture time of the last message in these segments, as the kill left them; 0: none."""
    times = [0]
    for path in [p for n in sorted(segments)[-2:] for p in out.glob(f"recording-{n:06d}.mcap*")]:
        with suppress(RecordingError):  # of which nothing is whole
            times += [message.timestamp_ns for message in messages(path, kind)]
    return max(times)
