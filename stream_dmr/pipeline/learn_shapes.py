"""Learn the shapes of fish: before a run, during it, and against a given mesh.

With `--template auto` a first pass over a source that has an end learns the shapes of all its fish
before any of them is measured. The shapes of a camera's fish are learnt while they are measured,
for later fish: a length once reported stays as it is, with the interval that was honest then;
`replay --template auto` ashore measures all fish again by the shapes learnt from all of them.

A mesh that was given is compared with the fish after they are measured. Their shape is learnt
beginning at the mesh. If it stays near the mesh, some of the fish are measured by both shapes: a
mesh of the right breadth may still be so broad or slim at head and tail that lengths change.
"""

import itertools
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from threading import Event
from typing import TypeVar

import numpy as np

from stream_dmr.errors import OutputError
from stream_dmr.evidence.seal import add_files
from stream_dmr.fitting.shape.candidates import (
    AUTO,
    CandidateShapes,
    LengthShift,
    are_like_mesh,
    believable,
    describe,
    load_shapes,
    mesh_form,
    not_like_mesh,
)
from stream_dmr.fitting.shape.space import reshaped
from stream_dmr.fitting.shape.stocks import FRAMES_PER_FISH, MAX_FISH, GoodCrops, evenly, good_crops
from stream_dmr.messages import FishCrop, Frame, LearntShapes, LengthEstimate, Message, TrackEnded
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.nodes.fit_mesh import FitMesh
from stream_dmr.nodes.read_frames import ReadFrames
from stream_dmr.pipeline.chain import Chain
from stream_dmr.pipeline.run_folder import require_folder
from stream_dmr.pipeline.run_inputs import Inputs
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.pipeline.session import KeptCrops, KeptFrames, Session, Setup
from stream_dmr.recording.record import as_recorded
from stream_dmr.store.open_results import (
    LEARNT,
    MADE_BY_RUN,
    is_mesh_by,
    mesh_comment,
    require_free_names,
)
from stream_dmr.template.template import Template
from stream_dmr.template.template_file import save_template

_MAX_FISH = 12  # measured by both shapes; their lengths differ much alike
# Share of the largest allowed shift of lengths; beyond it the shape is learnt once more, with new
# poses, before it is judged.
_SURELY_ALLOWED = 0.5

Lengths = dict[int, tuple[float, float]]
"""By track id: the log length, and its std."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MeshComparison:
    """The comparison of fish with the mesh that was given for them."""

    mesh: CandidateShapes
    stocks: CandidateShapes | None  # learnt beginning at the mesh; None: it fits none of the masks
    shift: LengthShift | None  # None if the shapes differ already

    @property
    def is_like_mesh(self) -> bool:
        return self.stocks is not None and self.shift is not None and self.shift.off <= 1

    @property
    def not_like_mesh(self) -> str:
        return not_like_mesh(self.mesh, self.stocks, self.shift)


def compare_with_mesh(
    crops: Sequence[FishCrop], setup: Setup, *, progress: Callable[[str], None] = lambda step: None
) -> MeshComparison:
    """Compare the template with the fish of these crops, in the order of their capture.

    `progress` is called at each step of the work, and may raise.
    """
    mesh = mesh_form(setup.template)
    measured = evenly(good_crops(crops), _MAX_FISH)
    frames = [frame for fish in measured for frame in evenly(fish, FRAMES_PER_FISH)]

    @cache
    def by_mesh() -> Lengths:
        return _lengths(frames, setup, None)

    @cache  # called twice for stocks that suffice
    def shift_of(stocks: CandidateShapes) -> LengthShift | None:
        if not are_like_mesh(stocks):
            return None
        progress("measuring some of them by both shapes")
        return _shift(by_mesh(), _lengths(frames, setup, stocks))

    def is_enough(stocks: CandidateShapes) -> bool:
        shift = shift_of(stocks)
        return shift is not None and shift.off <= _SURELY_ALLOWED

    # Only shapes that would be disbelieved are learnt for longer.
    stocks = setup.learn(crops, mesh, is_enough=is_enough, progress=progress)
    return MeshComparison(
        mesh=mesh, stocks=stocks, shift=None if stocks is None else shift_of(stocks)
    )


def _lengths(
    crops: Sequence[FishCrop], setup: Setup, candidates: CandidateShapes | None
) -> Lengths:
    """The fish's lengths by these frames; empty without a calibration."""
    session = Session(replace(setup, candidates=candidates), first="fit")
    return {
        estimate.track_id: (
            float(np.log(estimate.length_mm)),
            estimate.length_std_mm / estimate.length_mm,
        )
        for estimate in session.messages(crops, setup.config.recording)
        if isinstance(estimate, LengthEstimate)
        and estimate.is_final
        and estimate.length_mm is not None
        and estimate.length_std_mm is not None
    }


def _shift(by_mesh: Lengths, by_stocks: Lengths) -> LengthShift:
    """The mean shift of lengths; no shift if no fish has both lengths."""
    both = [track_id for track_id in by_mesh if track_id in by_stocks]
    if not both:
        return LengthShift()
    return LengthShift(
        float(np.mean([by_stocks[n][0] - by_mesh[n][0] for n in both])),
        float(np.mean([by_mesh[n][1] for n in both])),
        len(both),
    )


S = TypeVar("S", bound=Setup)


def with_learnt_shapes(
    inputs: Inputs,
    crop_fish: CropFish,
    *,
    stop: Event,
    observer: RunObserver,
    on_part: Callable[[str], None],
) -> Inputs:
    """The inputs with the shapes of the source's own fish, and its crops and frames.

    Unchanged if nothing is to be learnt: a mesh was given, the settings switch it off, or the
    source has no end.
    """
    config, request, forms = inputs.config, inputs.request, inputs.candidates
    if forms is None or inputs.is_endless or not config.fit_mesh.are_shapes_learnt:
        return inputs
    require_folder(request.out, overwrite=request.overwrite)  # before the work
    require_free_names(request.out, overwrite=request.overwrite)
    on_part("finding the fish")
    observer.stage("finding the fish, for their shapes")
    inputs, crops = _first_pass(inputs, crop_fish, stop=stop, observer=observer)
    if stop.is_set() or next(iter(crops), None) is None:
        return inputs  # without fish the end of the run reports why
    on_part("learning their shapes")
    return replace(inputs, candidates=_learn_and_report(crops, inputs, forms, observer, stop))


def _first_pass(
    inputs: Inputs, crop_fish: CropFish, *, stop: Event, observer: RunObserver
) -> tuple[Inputs, KeptCrops]:
    """Keep the crops of the source, and its frames unless their pictures are needed again."""
    config, reader = inputs.config, inputs.reader
    crops, frames = KeptCrops(), None
    if not (config.recording.keeps_pictures or config.watch.port or observer.needs_pictures):
        frames = KeptFrames(config.recording, inputs.request.out)

    def take(message: Message) -> Message:
        message = as_recorded(message, config.recording)  # from decoded pixels, as in the run
        if isinstance(message, FishCrop | TrackEnded):
            crops.keep(message)
        elif isinstance(message, Frame) and frames is not None:
            frames.keep(message)
        return message

    Chain(reader, [crop_fish], on_message=take, on_frame=observer.frame_done, stop=stop).run()
    reader.close()
    if frames is None:
        size = inputs.source.width, inputs.source.height
        reader = ReadFrames(inputs.request.source, config.read_frames, size=size)
    else:
        reader.replace_frames(frames)
    return replace(inputs, reader=reader, crops=crops, kept_frames=frames), crops


def learnt_from(crops: Iterable[FishCrop], setup: S, observer: RunObserver, stop: Event) -> S:
    """The setup with the shapes of all these fish together, which the observer reports.

    Without candidates the template's own shape stays, unless the fish have another: then their
    shapes are learnt as by `--template auto`.
    """
    seen_whole = [*itertools.chain.from_iterable(good_crops(crops))]
    forms = setup.candidates
    if forms is None:
        if mesh_fits_fish(seen_whole, setup, observer, stop):
            return setup
        template, forms = load_shapes(AUTO, are_lying=setup.config.localize.rests_on_plane)
        assert forms is not None
        setup = replace(setup, template=template)
    return replace(setup, candidates=_learn_and_report(seen_whole, setup, forms, observer, stop))


def mesh_fits_fish(
    crops: Sequence[FishCrop], setup: Setup, observer: RunObserver, stop: Event
) -> bool:
    """True if the mesh fits the fish of these good crops, there are none, or `stop` comes before.

    Reports the result.
    """
    name = setup.template.name
    if not crops:
        observer.warn(f"no fish was seen whole: whether they are like {name} is not known")
        return True
    observer.stage(f"comparing the fish with {name}")
    try:
        found = compare_with_mesh(crops, setup, progress=lambda step: _raise_if_set(stop))
    except InterruptedError:
        observer.warn(f"stopped before the fish were compared with {name}")
        return True
    if found.is_like_mesh and found.stocks is not None:
        for line in describe(found.mesh, found.stocks):
            observer.notice(line)
        return True
    observer.warn(
        f"{found.not_like_mesh}; they are measured by the shapes learnt from them, as with "
        "--template auto"
    )
    return False


def _learn_and_report(
    crops: Iterable[FishCrop],
    setup: Setup,
    forms: CandidateShapes,
    observer: RunObserver,
    stop: Event,
) -> CandidateShapes:
    """The stocks of all fish.

    `forms` if no fish is seen whole, no stock can be of fish, or `stop` comes before.
    """

    def progress(step: str) -> None:
        _raise_if_set(stop)
        observer.stage(f"learning their shapes: {step}")

    try:
        stocks = setup.learn(crops, forms, progress=progress)
    except InterruptedError:
        return forms
    if stocks is None:
        observer.warn("no fish was seen whole: each is measured as the form it is most like")
        return forms
    shapes = _believed(forms, stocks, observer)
    if (learnt := shapes.stocks()) is not None:
        for line in describe(forms, learnt):
            observer.notice(line)
    return shapes


def _raise_if_set(stop: Event) -> None:
    if stop.is_set():
        raise InterruptedError("the run has ended")


def _believed(
    forms: CandidateShapes, stocks: CandidateShapes, observer: RunObserver
) -> CandidateShapes:
    """The believable part of learnt stocks; warns of the rest."""
    believed = believable(forms, stocks)
    for doubt in believed.doubts:
        observer.warn(doubt)
    return believed.shapes


def save_learnt(setup: Setup, out: Path, *, source: str) -> list[Path]:
    """Write the meshes of learnt stocks, if any, into a run's folder. Raises OutputError."""
    stocks = None if setup.candidates is None else setup.candidates.stocks()
    if stocks is None:
        return []
    return save_stocks(setup.template, stocks, out / LEARNT, made_by=MADE_BY_RUN, source=source)


def save_stocks(
    template: Template, stocks: CandidateShapes, path: Path, *, made_by: str, source: str
) -> list[Path]:
    """Write the mesh of each stock, the largest to `path`, others beside it. Raises OutputError.

    Meshes that the command `made_by` wrote there before are replaced or removed.
    """
    for number in itertools.count(len(stocks) + 1):
        mesh = path.with_stem(f"{path.stem}-{number}")
        if not mesh.exists():
            break
        if is_mesh_by(made_by, mesh):
            for leftover in (mesh, mesh.with_suffix(".toml")):
                leftover.unlink(missing_ok=True)
    paths = stock_paths(path, len(stocks))
    for stock, mesh_path in zip(stocks, paths, strict=True):
        save_template(
            replace(reshaped(template, stock.coefficients), name=stock.name),
            mesh_path,
            comment=mesh_comment(
                made_by, f"the mean shape of {stock.share:.0%} of the fish of {source}"
            ),
        )
    return paths


def stock_paths(path: Path, num_stocks: int) -> list[Path]:
    """The names of the meshes of so many stocks: `path`, then PATH-2, PATH-3, ..."""
    return [path, *(path.with_stem(f"{path.stem}-{n}") for n in range(2, num_stocks + 1))]


class SeenFish:
    """Good crops of the last finished fish. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._tracks: dict[int, GoodCrops] = {}
        self._fish: deque[list[FishCrop]] = deque(maxlen=MAX_FISH)
        self._num = 0

    def take(self, message: Message) -> None:
        with self._lock:
            if isinstance(message, FishCrop):
                self._tracks.setdefault(message.track_id, GoodCrops()).add(message)
            elif isinstance(message, LengthEstimate) and message.is_final:
                crops = self._tracks.pop(message.track_id, GoodCrops()).chosen()
                if crops:
                    self._fish.append(crops)
                    self._num += 1

    @property
    def num(self) -> int:
        """Number of finished fish that were seen whole, also of those that are no longer kept."""
        with self._lock:
            return self._num

    def crops(self) -> list[FishCrop]:
        with self._lock:
            return [*itertools.chain.from_iterable(self._fish)]


_FIRST = 3  # finished fish after which shapes are learnt, then after twice as many, and so on
_NICENESS = 10  # frames come first


class ShapeLearner:
    """Learns from the fish that a camera saw, in a thread of its own, for later fish.

    Used if the source has no end, so that no first pass was possible.
    """

    def __init__(
        self,
        inputs: Inputs,
        session: Session,
        seen: SeenFish,
        *,
        learnt: Sequence[LearntShapes],
        write: Callable[[LearntShapes], object],
        observer: RunObserver,
    ) -> None:
        """`learnt` by earlier runs: FitMesh uses it at once. `write` records what this run learns.

        `seen` has the kept fish of those runs, so that learning continues as in a single run.
        `inputs` have candidates.
        """
        assert inputs.candidates is not None
        self._inputs, self._seen, self._write, self._observer = inputs, seen, write, observer
        self._given = self._known = inputs.candidates
        [self._fit_mesh] = [node for node in session.nodes if isinstance(node, FitMesh)]
        for shapes in learnt:
            self._known = self._known.extended(shapes)
        self._fit_mesh.learn(self._known)
        self._compared: MeshComparison | None = None  # the last comparison with a given mesh
        self._stop = threading.Event()
        self._next_at = 2 * _num_fish(learnt[-1]) if learnt else _FIRST
        self._worker = ThreadPoolExecutor(1, "shapes", initializer=_be_nice)
        self._work: Future[CandidateShapes | None] | None = None
        self._num_fish = 0  # from which the current work learns

    def take(self, frame: Frame) -> None:
        """Begin to learn if there are enough fish; pass on shapes learnt by this frame."""
        if self._work is None:
            num_fish = self._seen.num
            if num_fish >= self._next_at:
                self._next_at = 2 * num_fish
                self._num_fish = min(num_fish, MAX_FISH)
                self._work = self._worker.submit(self.learn, self._seen.crops())
        elif self._work.done():
            work, self._work = self._work, None
            stocks = work.result()
            if stocks is not None:
                self.pass_on(_message(stocks, self._num_fish, frame))

    def close(self) -> None:
        """End the work, whose result is lost. Idempotent."""
        self._stop.set()
        self._worker.shutdown()

    def learn(self, crops: Sequence[FishCrop]) -> CandidateShapes | None:
        """The stocks of these fish; None if there are none, or a given mesh fits the fish."""
        if self._given.is_given_mesh:
            found = compare_with_mesh(crops, self._inputs, progress=self.raise_if_stopped)
            self._compared = found
            if found.stocks is None:
                self._observer.warn(found.not_like_mesh)
            return None if found.is_like_mesh else found.stocks
        stocks = self._inputs.learn(crops, self._given, progress=self.raise_if_stopped)
        if stocks is None:
            return None
        return _believed(self._given, stocks, self._observer).stocks()

    def raise_if_stopped(self, step: str) -> None:
        """End the work at this step if the run has ended. Raises InterruptedError."""
        _raise_if_set(self._stop)

    def pass_on(self, learnt: LearntShapes) -> None:
        """Measure the fish of this frame and of later frames by the learnt shapes."""
        more = self._known.extended(learnt)
        stocks = more.stocks()
        assert stocks is not None
        self._known = more
        self._write(learnt)
        self._fit_mesh.learn(more)
        if self._compared is not None:
            self._observer.warn(
                f"{self._compared.not_like_mesh}; fish to come may have the shape learnt from "
                "these; measure those so far anew: stream-dmr replay --from fit --template auto"
            )
        else:
            for line in describe(self._given, stocks):
                self._observer.notice(f"learnt from the fish so far: {line}")
        try:
            out = self._inputs.request.out
            require_free_names(out, overwrite=self._inputs.request.overwrite)
            setup = replace(self._inputs, candidates=more)
            meshes = save_learnt(setup, out, source=self._inputs.source.name)
            add_files(out, [*meshes, *(mesh.with_suffix(".toml") for mesh in meshes)])
        except OutputError as error:
            self._observer.warn(str(error))


def _message(stocks: CandidateShapes, num_fish: int, frame: Frame) -> LearntShapes:
    """The shapes as a message; 1 / (num_fish + 1) is left for a fish of no stock (Laplace)."""
    return LearntShapes(
        frame_index=frame.frame_index,
        timestamp_ns=frame.timestamp_ns,
        names=stocks.names,
        coefficients=stocks.coefficients,
        covariances=stocks.covariances,
        shares=stocks.shares * num_fish / (num_fish + 1),
    )


def _num_fish(learnt: LearntShapes) -> int:
    """Number of fish from which the stocks of a `_message` were learnt."""
    share = learnt.shares.sum()
    return round(share / (1 - share))


def _be_nice() -> None:
    """Lower the priority of this thread, if the system allows it."""
    with suppress(AttributeError, OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
