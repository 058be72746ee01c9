import os
import subprocess
import sys
from pathlib import Path
from threading import Event
from typing import Any

import pytest

import stream_dmr.pipeline.prepare_kernels as module
from stream_dmr.pipeline.prepare_kernels import kernels_of_machine, prepare_kernels

RUN = """
import sys, threading
from pathlib import Path
from stream_dmr.pipeline import prepare_kernels as module
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.pipeline.run_options import RunOptions

module.prepare_kernels(print, stop=threading.Event())
cache, scene = Path(sys.argv[1]), Path("stream_dmr/simulation/demo_scene")
before = {path.name for path in cache.rglob("*.nbc")}
request = RunOptions(
    source=str(scene / "video.mp4"), calibration=scene / "calibration.yaml", out=Path(sys.argv[2]),
)
measure_source(request, stop=threading.Event())
print("compiled later:", sorted({path.name for path in cache.rglob("*.nbc")} - before))
"""


@pytest.mark.slow
def test_a_run_compiles_nothing_more(tmp_path: Path):
    cache = tmp_path / "cache"
    cache.mkdir()
    done = subprocess.run(
        [sys.executable, "-c", RUN, str(cache), str(tmp_path / "out")],
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
    )
    assert "once on this machine" in done.stdout, done.stderr
    assert done.stdout.splitlines()[-1] == "compiled later: []", done.stdout[-2000:]


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(module, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(module, "is_compiling", lambda: True)
    return tmp_path


def test_what_is_complete_is_not_compiled_again(cache: Path):
    complete = cache / "complete"
    complete.write_text(kernels_of_machine())
    lines: list[str] = []
    prepare_kernels(lines.append, stop=Event())
    assert lines == []


def test_a_stop_ends_it_and_nothing_counts_as_complete(cache: Path):
    stop = Event()
    lines: list[str] = []

    def stop_soon(line: str) -> None:
        lines.append(line)
        stop.set()

    prepare_kernels(stop_soon, stop=stop)
    assert len(lines) == 1
    assert "compiling" in lines[0]
    assert not (cache / "complete").exists()


def test_another_processor_compiles_anew(cache: Path):
    (cache / "complete").write_text("numba 0.1, another processor")
    stop = Event()
    lines: list[str] = []
    prepare_kernels(lambda line: (lines.append(line), stop.set())[0], stop=stop)
    assert lines


def test_workers_compile_into_the_folder_that_is_for_this_process_alone(
    cache: Path, monkeypatch: pytest.MonkeyPatch
):
    """Each would make a folder of its own, and all that it compiled would go with it."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    look = "import sys, stream_dmr.compiled as c; (c.cache_folder() / sys.argv[1]).touch()"
    real = subprocess.Popen

    def start(command: list[str], **options: Any) -> "subprocess.Popen[bytes]":
        return real([sys.executable, "-c", look, command[-1]], **options)

    monkeypatch.setattr(module.subprocess, "Popen", start)
    prepare_kernels(lambda line: None, stop=Event())
    assert {"largest", "rest", "complete"} <= {path.name for path in cache.iterdir()}
