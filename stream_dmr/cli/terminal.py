"""Show a run on the terminal: progress, warnings, and the table of fish at the end."""

import sys
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from math import inf
from pathlib import Path
from types import MappingProxyType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from stream_dmr.cli.shared_options import printable
from stream_dmr.evaluation.compare import Distributions, Evaluation, distribution_rows, summary_rows
from stream_dmr.messages import LengthEstimate, Message
from stream_dmr.pipeline.measure_source import RunSummary
from stream_dmr.pipeline.replay_recording import LENGTH_TOLERANCE, ReplaySummary
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.store.schema import flags_in_status

_LINE_EVERY_S = 10.0  # without a terminal, which would show a bar
_PLAIN_WIDTH = 120
# Text is shown as it is: names of files, vessels and species may be [red] or :fish:, too.
_console = partial(Console, highlight=False, markup=False, emoji=False)
_MAX_SHOWN = 20  # differences of a replay


class RunDisplay(RunObserver):
    """Progress on stderr: a bar on a terminal, elsewhere a plain line every few seconds."""

    needs_pictures = False

    def __init__(self) -> None:
        self._console = _console(file=sys.stderr, soft_wrap=True)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[speed]}"),
            TimeRemainingColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._progress.add_task("measuring", total=None, speed="")
        self._num_frames: int | None = None
        self._num_done, self._is_measuring = 0, False
        self._fish = set[int]()  # track ids
        self._warned: set[str] = set()
        self._began = self._last_line = time.monotonic()

    def __enter__(self) -> "RunDisplay":
        return self

    def __exit__(self, *error: object) -> None:
        self._progress.stop()

    def warn(self, line: str) -> None:
        if line not in self._warned:
            self._warned.add(line)
            self._console.print(printable(f"warning: {line}"))

    def notice(self, line: str) -> None:
        self._console.print(printable(line))

    def stage(self, line: str) -> None:
        self._num_done, self._began, self._is_measuring = 0, time.monotonic(), False
        self._progress.reset(self._task, description=line, speed="")
        self._progress.start()
        if self._progress.disable and time.monotonic() - self._last_line >= _LINE_EVERY_S:
            self._last_line = time.monotonic()
            self._console.print(printable(line))

    def serving(self, address: str) -> None:
        self._console.print(f"watch it with: {address}")

    def begin(self, num_frames: int | None) -> None:
        self._num_frames = num_frames
        self._began = self._last_line = time.monotonic()
        self._num_done, self._is_measuring = 0, True
        self._progress.reset(self._task, description="measuring", total=num_frames)
        self._progress.start()

    def frame_done(self) -> None:
        self._num_done += 1
        now = time.monotonic()
        speed = f"{self._num_done / max(now - self._began, 1e-9):.1f} frames/s"
        if self._is_measuring:  # a first pass has no fish yet
            speed += f", {len(self._fish)} fish"
        self._progress.update(self._task, advance=1, speed=speed)
        if self._progress.disable and now - self._last_line >= _LINE_EVERY_S:
            self._last_line = now
            of = "" if self._num_frames is None else f" of {self._num_frames}"
            self._console.print(f"frame {self._num_done}{of}, {speed}")

    def take(self, message: Message) -> None:
        if isinstance(message, LengthEstimate):
            self._fish.add(message.track_id)


def print_fish(
    fish: Sequence[LengthEstimate], flags: Mapping[int, Sequence[str]] = MappingProxyType({})
) -> None:
    """Print the table of fish to stdout; `flags` by track id, of the fish that have any."""
    titles = {"species": "species_code", "fate": "fate"}  # if any fish has them
    known = {t: name for t, name in titles.items() if any(getattr(f, name) for f in fish)}
    table = _table("fish", "length mm", "95 % interval mm", "frames used/seen", *known, "status")
    for estimate in fish:
        table.add_row(
            str(estimate.track_id),
            length_text(estimate),
            interval_text(estimate),
            f"{estimate.frames_used}/{estimate.frames_seen}",
            *(getattr(estimate, name) or "-" for name in known.values()),
            status_text(estimate) + flags_in_status(flags.get(estimate.track_id, ())),
        )
    _stdout().print(table if fish else "no fish")
    for title, name in known.items():
        print(f"{title}: {counts_text(getattr(estimate, name) for estimate in fish)}")


def counts_text(names: Iterable[str | None]) -> str:
    """The count of each name, the most frequent first, such as: 3 landed, 1 unknown."""
    return ", ".join(f"{count} {name or '-'}" for name, count in Counter(names).most_common())


def print_replay(summary: ReplaySummary, out: Path | None, *, timings: bool) -> None:
    print_fish(summary.fish)
    if timings:
        print_timings(summary)
    speed = _times_real_time(summary.recorded_s, summary.elapsed_s)
    print(f"{summary.num_frames} frames in {summary.elapsed_s:.1f} s, {speed}")
    if out is not None:
        print(f"results in {out}")


def print_check(summary: ReplaySummary) -> None:
    """Print to stdout how the results of a replay differ from the recording."""
    found = summary.mismatches
    for item in found[:_MAX_SHOWN]:
        print(
            f"frame {item.frame_index}, fish {item.track_id}, {item.kind}, "
            f"{item.difference.field}: recorded {item.difference.recorded}, "
            f"now {item.difference.computed}"
        )
    if len(found) > _MAX_SHOWN:
        print(f"... and {len(found) - _MAX_SHOWN} more")
    if summary.num_left_out:
        print(
            f"{summary.num_left_out} messages not compared, of fish that were in view before this "
            "recording began: their fits start from fits in the ones before it; give these, too"
        )
    if summary.num_beyond:
        print(f"{summary.num_beyond} messages more than were recorded: it was cut off before them")
    if not found:
        print(f"check: {summary.num_compared} messages are the recorded ones to the last bit")
        return
    kinds = ", ".join(sorted({item.kind for item in found}))
    lengths = f"lengths differ by {summary.length_change:.2g} at most, as a fraction"
    if summary.length_change == inf:
        lengths = "not all fish have the recorded status"
    print(f"check: {len(found)} fields differ, in {kinds}; {lengths}")
    if summary.other_versions:
        print(
            f"recorded with other versions of {', '.join(summary.other_versions)}, so bits may "
            f"differ: lengths are {'' if summary.is_as_recorded else 'not '}within the tolerance "
            f"of {LENGTH_TOLERANCE:g}"
        )


def print_timings(summary: RunSummary | ReplaySummary) -> None:
    """Print the time of each stage of the chain, its part of the recording included, to stdout."""
    table = _table("stage", "messages in", "out", "busy ms/frame", "CPU ms/frame", "busy %")
    for counter in summary.counters:
        table.add_row(
            counter.stage,
            str(counter.messages_in),
            str(counter.messages_out),
            f"{1e3 * counter.busy_s / max(summary.num_frames, 1):.2f}",
            f"{1e3 * counter.cpu_s / max(summary.num_frames, 1):.2f}",
            f"{100 * counter.busy_s / summary.elapsed_s:.0f}",
        )
    _stdout().print(table)
    if isinstance(summary, RunSummary):
        parts = [(name, seconds) for name, seconds in summary.parts_s.items() if seconds >= 0.05]
        print(", ".join(f"{name} {seconds:.1f} s" for name, seconds in parts))


def print_speed(summary: RunSummary) -> None:
    """Print the number of frames, the time of all passes and the speed, to stdout."""
    start_s = summary.parts_s["starting"]
    elapsed_s = sum(summary.parts_s.values()) - start_s
    promised, num_frames = summary.frames_promised, summary.num_frames
    of = "" if promised is None or num_frames >= promised - 1 else f" of {promised}"
    print(
        f"{num_frames}{of} frames in {elapsed_s:.1f} s, {num_frames / elapsed_s:.1f} frames/s, "
        f"{_times_real_time(summary.recorded_s, elapsed_s)}; {start_s:.1f} s to start"
    )


def _times_real_time(recorded_s: float, elapsed_s: float) -> str:
    speed = recorded_s / elapsed_s
    return f"{speed:.0f} times real time" if speed > 10 else f"{speed:.2g} times real time"


def print_evaluation(evaluation: Evaluation) -> None:
    """Print measured lengths beside true lengths, then the summary, to stdout."""
    _stdout().print(_beside_truth(evaluation), "", _figures(summary_rows(evaluation)), sep="\n")


def print_true_lengths(evaluation: Evaluation) -> None:
    """Print measured lengths beside true lengths, and their mean error in words, to stdout."""
    measured = [fish for fish in evaluation.fish if fish.error_mm is not None]
    off = [abs(fish.error_mm or 0.0) / fish.truth_mm for fish in measured]
    _stdout().print(_beside_truth(evaluation))
    if measured and evaluation.coverage is not None:
        mean = sum(off) / len(off)
        print(
            f"\n{len(measured)} of {len(evaluation.fish)} fish were measured, {mean:.1%} off on "
            f"average; {evaluation.coverage:.0%} of the true lengths lie in their 95 % intervals"
        )


def _beside_truth(evaluation: Evaluation) -> Table:
    fish = _table("fish", "truth mm", "measured mm", "error mm", "error %")
    for row in evaluation.fish:
        measured = "-" if row.length_mm is None else f"{row.length_mm:.1f}"
        error_mm = "-" if row.error_mm is None else f"{row.error_mm:+.1f}"
        percent = "-" if row.error_mm is None else f"{100 * row.error_mm / row.truth_mm:+.2f}"
        fish.add_row(str(row.track_id), f"{row.truth_mm:.1f}", measured, error_mm, percent)
    return fish


def print_distributions(distributions: Distributions) -> None:
    _stdout().print(_figures(distribution_rows(distributions)))


def _figures(rows: list[tuple[str, str]]) -> Table:
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    for name, value in rows:
        table.add_row(name, value)
    return table


def _stdout() -> Console:
    """A console as wide as the terminal, or without a terminal wide enough for any row."""
    width = None if sys.stdout.isatty() else _PLAIN_WIDTH
    return _console(width=width)


def _table(*titles: str) -> Table:
    return Table(*titles, box=None, padding=(0, 2, 0, 0))


def length_text(estimate: LengthEstimate) -> str:
    """Length in mm, or a dash."""
    return "-" if estimate.length_mm is None else f"{estimate.length_mm:.1f}"


def interval_text(estimate: LengthEstimate) -> str:
    """The 95 % interval in mm, or a dash."""
    if estimate.ci95_mm is None:
        return "-"
    low, high = estimate.ci95_mm
    return f"{low:.1f} to {high:.1f}"


def status_text(estimate: LengthEstimate) -> str:
    """The status; if there is no length, with the reasons why frames were refused."""
    reasons = sorted(estimate.refused.items(), key=lambda item: -item[1])
    shown = [f"{count} {reason}" for reason, count in reasons if reason != estimate.status]
    if estimate.length_mm is not None or not shown:
        return estimate.status
    return f"{estimate.status}: {', '.join(shown)}"
