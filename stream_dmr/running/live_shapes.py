"""Learns the shapes of a camera's fish while they are measured, for those that come after.

A length once given stays as it is, with the interval that was honest then; `replay --template auto`
ashore measures all fish anew by what all of them show.
"""

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress

from stream_dmr.errors import OutputError
from stream_dmr.fitting.shape.candidates import CandidateShapes
from stream_dmr.fitting.shape.describe import describe
from stream_dmr.fitting.shape.plausible import why_implausible
from stream_dmr.fitting.shape.samples import MAX_FISH
from stream_dmr.messages import FishCrop, Frame, LearntShapes
from stream_dmr.nodes.fit_mesh import FitMesh
from stream_dmr.results.learnt_meshes import LEARNT, MADE_BY_RUN, require_free_names
from stream_dmr.results.provenance import add_files
from stream_dmr.running.inputs import Inputs
from stream_dmr.running.mesh_comparison import compare_with_mesh
from stream_dmr.running.outputs import Outputs
from stream_dmr.running.pipeline import Node
from stream_dmr.running.run_observer import RunObserver
from stream_dmr.running.seen_fish import SeenFish
from stream_dmr.running.shape_pass import save_stocks

# Finished fish after which shapes are learnt, then after twice as many, and so on. What an earlier
# run has learnt is known from more fish than the first ones after a restart.
_FIRST, _AFTER_RESTART = 3, 48
_NICENESS = 10  # frames come first

Learn = Callable[[Sequence[FishCrop], Callable[[str], None]], CandidateShapes | None]
"""Crops, and what is called at each step of the work, which may raise -> the stocks, if any."""


class LiveShapes:
    """Learns from the fish that were seen, in a thread of its own."""

    def __init__(
        self,
        seen: SeenFish,
        learn: Learn,
        on_learnt: Callable[[LearntShapes], object],
        *,
        knows_shapes: bool,
    ) -> None:
        """`on_learnt` gets what fish may be that are first seen in the frame at hand, or later.

        `knows_shapes`: an earlier run has learnt some.
        """
        self._seen, self._learn, self._on_learnt = seen, learn, on_learnt
        self._stop = threading.Event()
        self._next_at = _AFTER_RESTART if knows_shapes else _FIRST
        self._worker = ThreadPoolExecutor(1, "shapes", initializer=_be_nice)
        self._work: Future[tuple[CandidateShapes | None, int]] | None = None

    def take(self, frame: Frame) -> None:
        """Learn if there are fish enough, and pass on what was learnt by this frame."""
        if self._work is None:
            num_fish = self._seen.num
            if num_fish >= self._next_at:
                self._next_at = 2 * num_fish
                self._work = self._worker.submit(self._learn_from, self._seen.crops(), num_fish)
        elif self._work.done():
            work, self._work = self._work, None
            stocks, num_fish = work.result()
            if stocks is not None:
                self._on_learnt(_message(stocks, num_fish, frame))

    def close(self) -> None:
        """End the work, whose result is lost. Idempotent."""
        self._stop.set()
        self._worker.shutdown()

    def _learn_from(
        self, crops: Sequence[FishCrop], num_fish: int
    ) -> tuple[CandidateShapes | None, int]:
        return self._learn(crops, self._go_on), min(num_fish, MAX_FISH)

    def _go_on(self, step: str) -> None:
        if self._stop.is_set():
            raise InterruptedError("the run has ended")


def follow_shapes(
    inputs: Inputs,
    outputs: Outputs,
    fit_mesh: Node,
    seen: SeenFish,
    *,
    write: Callable[[LearntShapes], object],
    observer: RunObserver,
) -> LiveShapes | None:
    """Let `fit_mesh` know what earlier runs have learnt, and what this one learns.

    None where there is nothing to learn: the settings say so, or the source has an end, whose fish
    were looked at before (`shape_pass.py`).
    """
    given = inputs.candidates
    if given is None or not inputs.is_endless or not inputs.config.fit_mesh.are_shapes_learnt:
        return None
    assert isinstance(fit_mesh, FitMesh)
    known, compared = given, None
    for learnt in outputs.learnt:
        known = known.extended(learnt)
    fit_mesh.learn(known)

    def learn(crops: Sequence[FishCrop], progress: Callable[[str], None]) -> CandidateShapes | None:
        nonlocal compared
        if not given.is_given_mesh:
            stocks = inputs.learn(crops, given, progress=progress)
            reason = None if stocks is None else why_implausible(given, stocks)
            if reason is None:
                return stocks
            observer.warn(reason)
            return None
        compared = compare_with_mesh(crops, inputs, progress=progress)
        if compared.stocks is None:
            observer.warn(compared.not_like_mesh)
        return None if compared.is_like_mesh else compared.stocks

    def on_learnt(learnt: LearntShapes) -> None:
        nonlocal known
        more = known.extended(learnt)
        stocks = more.stocks()
        assert stocks is not None
        known = more
        write(learnt)
        fit_mesh.learn(known)
        if compared is not None:
            observer.warn(
                f"{compared.not_like_mesh}; fish to come may have the shape learnt from "
                "these; measure those so far anew: stream-dmr replay --from fit --template auto"
            )
        else:
            for line in describe(given, stocks):
                observer.notice(f"learnt from the fish so far: {line}")
        try:
            _save_meshes(inputs, stocks)
        except OutputError as error:
            observer.warn(str(error))

    return LiveShapes(seen, learn, on_learnt, knows_shapes=bool(outputs.learnt))


def _save_meshes(inputs: Inputs, stocks: CandidateShapes) -> None:
    """Write the mesh of each stock into the run's folder. Raises OutputError."""
    path = inputs.request.out / LEARNT
    require_free_names(path.parent, overwrite=inputs.request.overwrite)
    meshes = save_stocks(
        inputs.template, stocks, path, made_by=MADE_BY_RUN, source=inputs.source.name
    )
    add_files(path.parent, [*meshes, *(mesh.with_suffix(".toml") for mesh in meshes)])


def _message(stocks: CandidateShapes, num_fish: int, frame: Frame) -> LearntShapes:
    """The next fish is none of these stocks as likely as each of the others was (Laplace)."""
    return LearntShapes(
        frame_index=frame.frame_index,
        timestamp_ns=frame.timestamp_ns,
        names=stocks.names,
        coefficients=stocks.coefficients,
        covariances=stocks.covariances,
        shares=stocks.shares * num_fish / (num_fish + 1),
    )


def _be_nice() -> None:
    """Lower the priority of this thread, where the system lets one do that."""
    with suppress(AttributeError, OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
