"""Progress of a batch: shares by bytes, the time left, and how often it is logged."""

from pathlib import Path

import pytest

from stream_dmr.batch.manifest import Job
from stream_dmr.batch.measure_video import BatchProgress, ProgressObserver, duration


@pytest.fixture
def jobs(tmp_path: Path) -> list[Job]:
    """Two videos, the second of which is three times as large."""
    for name, size in (("a", 100), ("b", 300)):
        (tmp_path / name).write_bytes(bytes(size))
    return [Job(name=name, given={"source": str(tmp_path / name)}) for name in ("a", "b")]


def test_time_left_follows_the_share_of_bytes(jobs: list[Job]):
    progress = BatchProgress(jobs, print)
    assert progress.line(10.0).startswith("0 of 2 videos, below 1 %: at first it loads")
    progress.of(jobs[1])(0.5)
    assert progress.line(30.0) == "0 of 2 videos, 38 %, time left: 50 s"
    progress.finish("a")
    assert progress.line(30.0) == "1 of 2 videos, 62 %, time left: 18 s"


def test_a_finished_video_is_logged_at_once(jobs: list[Job]):
    lines = list[str]()
    progress = BatchProgress(jobs, lines.append)
    progress.update()
    assert not lines
    progress.finish("b")
    progress.update()
    progress.update()
    assert len(lines) == 1


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (89.0, "89 s"), (200.0, "3 min"), (7200.0, "2.0 h")]
)
def test_durations_have_one_unit(seconds: float, text: str):
    assert duration(seconds) == text


def test_a_video_reports_each_percent_once():
    shares = list[float]()
    observer = ProgressObserver(shares.append)
    observer.begin(250)
    for _ in range(250):
        observer.frame_done()
    assert [int(100 * share) for share in shares] == [*range(1, 101)]
