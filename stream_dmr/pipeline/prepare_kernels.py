"""Compile all kernels of a run, once on a machine, before its first frame.

Numba compiles a kernel when it is first called. All of them take a minute on a new installation, in
which a camera's frames would be lost.

Two processes share the work. Each takes from the cache what the other has put there: the first
compiles the largest kernel of a descent, the second all kernels before and after it.
"""

import fcntl
import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import IO, Any

import cv2
import llvmlite.binding
import numba
import numpy as np

from stream_dmr.camera import Camera
from stream_dmr.compiled import cache_folder, is_compiling
from stream_dmr.detection.motion_detector import MotionDetector, MotionSettings
from stream_dmr.fitting.body import MeshLevels, rest_vector
from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.fitter import Fitter
from stream_dmr.fitting.shape.space import directions
from stream_dmr.fitting.shape.stock import shape_equations
from stream_dmr.fitting.size import mean_and_std
from stream_dmr.fitting.solver.descent import evaluate, normal_equations
from stream_dmr.fitting.solver.outline import Rendering
from stream_dmr.fitting.solver.problem import Problem
from stream_dmr.fitting.starts import recentered
from stream_dmr.fitting.target import Target
from stream_dmr.fitting.uncertainty import covariance, length_std_ratio
from stream_dmr.messages import CropQuality, FishCrop, Frame
from stream_dmr.template.template_file import load_template

_SIZE_PX = 128


def compile_kernels(fitter: Fitter) -> None:
    """Fit a drawn fish once with a cold and once with a warm start, which calls every kernel."""
    crop = drawn_fish()
    fitter.fit(crop, fitter.fit(crop, None).best)


def drawn_fish() -> FishCrop:
    mask = np.zeros((_SIZE_PX, _SIZE_PX), np.uint8)
    middle = _SIZE_PX // 2
    cv2.ellipse(mask, (middle, middle), (_SIZE_PX // 3, _SIZE_PX // 8), 30, 0, 360, 1, cv2.FILLED)
    camera = Camera.nominal(width=_SIZE_PX, height=_SIZE_PX)
    return FishCrop(
        frame_index=0,
        timestamp_ns=0,
        track_id=0,
        bbox_xyxy_px=np.array([0.0, 0.0, _SIZE_PX, _SIZE_PX]),
        image=None,
        mask=mask > 0,
        crop_camera=camera,
        frame_camera=camera,
        quality=CropQuality(
            touches_border=False,
            visible_fraction=1.0,
            sharpness=0.0,
            mask_area_px=float(mask.sum()),
        ),
    )


_TEMPLATE = "halibut"
_PAUSE_S = 0.3  # between two looks at the progress
_ABOUT = 85  # kernels in a full cache; only to show the progress


def prepare_kernels(on_progress: Callable[[str], None], *, stop: Event) -> None:
    """Compile what the cache lacks; `on_progress` gets a line about it now and then.

    If that fails or `stop` is set, functions are compiled when they are first called.
    """
    folder = cache_folder()
    if not is_compiling() or _is_complete(folder):
        return
    with suppress(OSError), (folder / "lock").open("w") as lock:
        began = time.monotonic()
        while not stop.is_set() and not _is_complete(folder):
            if _takes(lock):
                _compile_all(folder, on_progress, stop=stop)
                return
            on_progress(_progress(folder, began))
            stop.wait(_PAUSE_S)


def _compile_all(folder: Path, on_progress: Callable[[str], None], *, stop: Event) -> None:
    began = time.monotonic()
    command = [sys.executable, "-P", "-m", __name__]
    # A folder for this process alone is unknown to them: each would fill one of its own, in vain.
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder)}
    silent = subprocess.DEVNULL
    workers = [
        subprocess.Popen([*command, part], env=environment, stdout=silent, stderr=silent)
        for part in _PARTS
    ]
    try:
        while not stop.is_set() and any(worker.poll() is None for worker in workers):
            on_progress(_progress(folder, began))
            stop.wait(_PAUSE_S)
    finally:
        for worker in workers:
            worker.terminate()
            worker.wait()
    if all(worker.returncode == 0 for worker in workers):
        (folder / "complete").write_text(kernels_of_machine())


def _is_complete(folder: Path) -> bool:
    try:
        return (folder / "complete").read_text() == kernels_of_machine()
    except OSError:
        return False


def kernels_of_machine() -> str:
    """Compiler and processor, on which compiled functions depend beside their sources."""
    return f"numba {numba.__version__}, {llvmlite.binding.get_host_cpu_name()}"


def _takes(lock: IO[str]) -> bool:
    """Take the lock; False while another process compiles."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _progress(folder: Path, began: float) -> str:
    done = sum(1 for _ in folder.rglob("*.nbc")) / _ABOUT
    return (
        f"compiling the numeric loops, once on this machine (half a minute to two): "
        f"{min(done, 0.99):.0%} after {time.monotonic() - began:.0f} s"
    )


def _compile_largest() -> None:
    """Compile the normal equations by the types of empty arguments, before a fit has real ones."""
    template, settings = load_template(_TEMPLATE), FitMeshSettings()
    body = MeshLevels.from_template(template, max_faces=settings.max_faces).fine
    points, flat, lengths = np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0)
    picture = np.zeros((0, 0))
    target = Target(
        np.eye(3),
        np.zeros(3),
        np.zeros(3),
        np.zeros(2),
        picture,
        np.zeros((0, 0), bool),
        picture,
        0.0,
        flat,
        flat,
        lengths,
        1.0,
    )
    problem = Problem.from_settings(settings, body, target, with_smoothness=True)
    rendering = Rendering(points, flat, np.zeros((0, 2), np.int64), picture, points, points)
    arguments = (problem, rest_vector(len(body.joints)), rendering)
    kernel: Any = normal_equations
    kernel.compile(tuple(numba.typeof(argument) for argument in arguments))


def _compile_rest() -> None:
    """Compile all other kernels; last those that need the largest, which is done by then."""
    template, settings = load_template(_TEMPLATE), FitMeshSettings()
    levels = MeshLevels.from_template(template, max_faces=settings.max_faces)
    fitter = Fitter(template, settings)
    target = fitter.target(drawn_fish())
    problem = Problem.from_settings(settings, levels.fine, target, with_smoothness=True)
    parameters = recentered(problem, rest_vector(len(levels.fine.joints)))
    rendering = evaluate(problem, parameters, True).rendering
    _detect()
    shape_equations(problem, parameters, directions(levels.fine))
    spread = covariance(problem, settings, parameters, rendering)
    length_std_ratio(problem, parameters, rendering.points, spread)
    mean_and_std(np.arange(2.0), np.arange(2.0))
    compile_kernels(fitter)


def _detect() -> None:
    """Find a square that moves before a textured background."""
    detector = MotionDetector(MotionSettings())
    texture = np.random.default_rng(0).integers(0, 200, (240, 320, 3), np.uint8)
    for index in range(3):
        image = texture.copy()
        image[80:140, 60 + 30 * index : 160 + 30 * index] = 255
        detector.find(Frame(frame_index=index + 1, timestamp_ns=index, image=image, source=""))


_PARTS: dict[str, Callable[[], None]] = {"largest": _compile_largest, "rest": _compile_rest}


if __name__ == "__main__":
    _PARTS[sys.argv[1]]()
