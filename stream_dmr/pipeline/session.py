"""The nodes of a chain over one setup, fed live, from a recording, or from both."""

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from tempfile import SpooledTemporaryFile, TemporaryFile
from typing import IO, TypeVar

from stream_dmr.camera import Calibration, Camera
from stream_dmr.errors import RecordingError
from stream_dmr.files import writing_to
from stream_dmr.fitting.shape.candidates import CandidateShapes
from stream_dmr.fitting.shape.stocks import learn_shapes
from stream_dmr.messages import (
    FishCrop,
    FishMessage,
    FittedMesh,
    Frame,
    LengthEstimate,
    LocalizedFish,
    Message,
    TrackEnded,
    track_of,
)
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.nodes.fit_mesh import FitMesh
from stream_dmr.nodes.localize import Localize
from stream_dmr.nodes.smooth_length import SmoothLength
from stream_dmr.pipeline.chain import Node
from stream_dmr.pipeline.config import Config
from stream_dmr.pipeline.run_options import Stage
from stream_dmr.recording.codec import compress, decode, encode
from stream_dmr.recording.frame_images import FrameRestorer, RecordedPictures, has_original_pixels
from stream_dmr.recording.header import RunStart
from stream_dmr.recording.reading import Recording
from stream_dmr.recording.record import as_recorded, make_record
from stream_dmr.recording.selection import EVERYTHING, Selection
from stream_dmr.recording.topics import RecordingSettings
from stream_dmr.recording.view_geometry import VIEW_QUALITY, FrameThrottle, shrink_by_halves
from stream_dmr.template.template import Template
from stream_dmr.tracking.finder import FishFinder
from stream_dmr.tracking.timeout import TrackTimeout


@dataclass(frozen=True, kw_only=True)
class Setup:
    """Config, template, shapes and calibration: all that determines a length."""

    config: Config
    template: Template
    candidates: CandidateShapes | None = None  # shapes that the fish may have; None: the template's
    calibration: Calibration | None

    @property
    def camera(self) -> Camera | None:
        return None if self.calibration is None else self.calibration.camera

    @property
    def has_covariance(self) -> bool:
        """True if fits carry the covariance of their parameters, recorded with vertices."""
        return self.config.recording.meshes == "vertices"

    def learn(
        self,
        crops: Iterable[FishCrop],
        forms: CandidateShapes,
        *,
        is_enough: Callable[[CandidateShapes], bool] = lambda stocks: False,
        progress: Callable[[str], None] = lambda step: None,
    ) -> CandidateShapes | None:
        """The stocks of these fish, learnt from `forms` on: see `learn_shapes`."""
        return learn_shapes(
            crops,
            self.template,
            forms,
            self.config.fit_mesh,
            calibration=self.calibration,
            species=self.config.species,
            is_enough=is_enough,
            progress=progress,
        )

    def crop_fish(self, finder: FishFinder) -> CropFish:
        """A new CropFish. Raises ModelError if a model of the settings cannot be used."""
        return CropFish(
            self.config.crop_fish,
            camera=self.camera,
            finder=finder,
            species_model=self.config.species.model,
            track_timeout_s=self.config.smooth_length.track_timeout_s,
        )


@dataclass(frozen=True)
class StageNode:
    """The message that the node of a stage returns, and how the node is made."""

    message: type[Message]
    make: Callable[[Setup], Node] | None


STAGES: Mapping[Stage, StageNode] = {
    "crop": StageNode(FishCrop, None),  # it needs a finder of fish too, see `Setup.crop_fish`
    "fit": StageNode(
        FittedMesh,
        lambda setup: FitMesh(
            setup.config.fit_mesh,
            template=setup.template,
            candidates=setup.candidates,
            calibration=setup.calibration,
            with_covariance=setup.has_covariance,
            species=setup.config.species,
        ),
    ),
    "localize": StageNode(
        LocalizedFish, lambda setup: Localize(setup.config.localize, calibration=setup.calibration)
    ),
    "smooth": StageNode(
        LengthEstimate,
        lambda setup: SmoothLength(
            setup.config.smooth_length,
            zones=setup.config.zones,
            species=setup.config.species,
            frame_size=setup.camera and (setup.camera.width, setup.camera.height),
            tail_gives=setup.template.tail_gives,
        ),
    ),
}


def messages_before(stage: Stage) -> list[type[Message]]:
    return [node.message for node in STAGES.values()][: stage_number(stage)]


def messages_from(stage: Stage) -> list[type[Message]]:
    return [node.message for node in STAGES.values()][stage_number(stage) :]


def stage_number(stage: Stage) -> int:
    return [*STAGES].index(stage)


class Session:
    """The nodes of a chain over one setup: given nodes, then those of the stages to compute."""

    def __init__(
        self,
        setup: Setup,
        *,
        given: Sequence[Node] = (),
        first: Stage = "crop",
        last: Stage | None = None,
    ) -> None:
        """`given`: a CropFish, the crops of a first pass, or the playback of a recording.

        `last`: the last stage; None: that of the chain.
        """
        end = None if last is None else stage_number(last) + 1
        stages = [*STAGES.values()][stage_number(first) : end]
        self.nodes = [*given, *(stage.make(setup) for stage in stages if stage.make is not None)]

    def continue_tracks(self, interrupted: Iterable[LocalizedFish]) -> None:
        """Give SmoothLength the frames of fish that an earlier recording has."""
        for node in self.nodes:
            if isinstance(node, SmoothLength):
                for fish in interrupted:
                    node.step(fish)

    def messages(self, inputs: Iterable[Message], settings: RecordingSettings) -> Iterator[Message]:
        """Messages of all nodes, each as a recording with these settings hands it to the next node.

        Computed in this thread; only the end of `inputs` ends tracks.
        """
        for message in inputs:
            yield from _through(self.nodes, [message], settings)
        for stage, node in enumerate(self.nodes, start=1):
            left = _without_ends(node.close(), settings)
            yield from left
            yield from _through(self.nodes[stage:], left, settings)


def _through(
    nodes: Sequence[Node], messages: Sequence[Message], settings: RecordingSettings
) -> Iterator[Message]:
    for node in nodes:
        messages = _without_ends(chain.from_iterable(map(node.step, messages)), settings)
        yield from messages


def _without_ends(messages: Iterable[Message], settings: RecordingSettings) -> list[Message]:
    return [as_recorded(sent, settings) for sent in messages if not isinstance(sent, TrackEnded)]


_IN_MEMORY = 1 << 26  # bytes of crops: some 100,000 masks; more are kept on the disk


class KeptCrops:
    """Keeps the crops of a first pass; a node in place of CropFish that returns them again."""

    def __init__(self, *, in_memory: int = _IN_MEMORY) -> None:
        """`in_memory`: bytes, beyond which crops go to the disk."""
        self._file: IO[bytes] = SpooledTemporaryFile(in_memory)  # noqa: SIM115, see `close`
        self._places: dict[int, list[tuple[int, int]]] = {}  # by frame: offsets and sizes
        self._ended: dict[int, list[TrackEnded]] = {}

    def keep(self, message: FishCrop | TrackEnded) -> None:
        if isinstance(message, TrackEnded):
            self._ended.setdefault(message.frame_index, []).append(message)
            return
        data = encode(message)
        self._places.setdefault(message.frame_index, []).append((self._file.tell(), len(data)))
        self._file.write(data)

    def __iter__(self) -> Iterator[FishCrop]:
        return (crop for frame_index in self._places for crop in self._of(frame_index))

    def step(self, frame: Frame, /) -> Sequence[FishCrop | TrackEnded]:
        """The crops of a frame, and the tracks that ended after it."""
        return [*self._of(frame.frame_index), *self._ended.get(frame.frame_index, [])]

    def close(self) -> Sequence[FishCrop]:
        self._file.close()
        return ()

    def _of(self, frame_index: int) -> list[FishCrop]:
        crops: list[FishCrop] = []
        for offset, size in self._places.get(frame_index, []):
            self._file.seek(offset)
            crops.append(decode(FishCrop, self._file.read(size)))
        return crops


_LENGTH_BYTES = 4  # before each part of the file


class KeptFrames:
    """Keeps the frames of a first pass as a recording by reference has them, to iterate once.

    Frames that the view shows have a picture of its size, the others none.
    """

    def __init__(self, settings: RecordingSettings, folder: Path) -> None:
        """Keep them on the disk of `folder`, in a file without a name: a crash leaves nothing."""
        self._settings, self._folder = settings, folder
        self._throttle = FrameThrottle(settings.view_rate_hz)
        self._file: IO[bytes] = TemporaryFile(dir=folder)  # noqa: SIM115, see `__iter__`
        self.payload = b""  # of the last frame returned, as it was encoded with its pixels

    def keep(self, frame: Frame) -> None:
        """Take the next frame. Raises OutputError if the disk is full."""
        shown = b""
        if self._throttle.shows(frame):
            small = shrink_by_halves(frame.image, most_px=self._settings.view_px)
            # Compressed once more at the same quality, as for the view, it stays as it is.
            shown = encode(frame, picture=compress(small, format="jpeg", jpeg_quality=VIEW_QUALITY))
        with writing_to(self._folder):
            for part in (make_record(frame, self._settings).payload, shown):
                self._file.write(len(part).to_bytes(_LENGTH_BYTES) + part)

    def __iter__(self) -> Iterator[Frame]:
        with self._file:
            self._file.seek(0)
            while payload := self._next():
                self.payload = payload
                yield decode(Frame, self._next() or payload)

    def _next(self) -> bytes:
        return self._file.read(int.from_bytes(self._file.read(_LENGTH_BYTES)))


class CropFishOfRuns:
    """A CropFish for each run: its tracks end with the run, the next run continues the numbers."""

    def __init__(
        self,
        open_crop_fish: Callable[[], CropFish],
        runs: Sequence[RunStart],
        *,
        pauses: Collection[int] = (),
    ) -> None:
        """`runs` in the order of frames; empty: a single run, whose fish count from 1.

        `pauses`: the frames after which all tracks ended, since the source paused.
        """
        self._pauses = pauses
        self._open, self._runs = open_crop_fish, deque(runs)
        self._crop_fish, self._is_new = open_crop_fish(), True
        self._frames_before = -1  # of the current run

    def step(self, frame: Frame, /) -> list[FishCrop | TrackEnded]:
        """The fish of a frame, as in the run that recorded it.

        If several runs report the same first frame, as with given boxes, the first continues.
        """
        ended = list[FishCrop | TrackEnded]()
        while self._runs and self._runs[0].frames_before < frame.frame_index:
            run = self._runs.popleft()
            if run.frames_before > self._frames_before:
                ended += self._crop_fish.close()
                if not self._is_new:
                    self._crop_fish, self._is_new = self._open(), True
                self._crop_fish.number_after(run.tracks_before)
                self._frames_before = run.frames_before
        self._is_new = False
        ended += self._crop_fish.step(frame)
        return [*ended, *self._crop_fish.pause()] if frame.frame_index in self._pauses else ended

    def close(self) -> Sequence[FishCrop | TrackEnded]:
        return self._crop_fish.close()


M = TypeVar("M", bound=Message)


class RecordedMessages:
    """The selected messages of a recording, type by type, each in their order."""

    def __init__(self, recording: Recording, selection: Selection = EVERYTHING) -> None:
        self._recording = recording
        self._selection = selection
        self.notes: list[str] = []  # lines for the user on this replay
        self._payloads: dict[int, bytes] = {}  # by id() of messages on their way through the chain

    @property
    def ends_early(self) -> bool:
        return self._recording.ends_early

    def carried_over(self) -> list[LocalizedFish]:
        """Earlier frames of the tracks that were open when the recording began.

        Empty for a selection in time, which begins without them.
        """
        if self._selection.time_ns is not None:
            return []
        fish = [decode(LocalizedFish, payload) for payload in self._recording.carried_over()]
        return [message for message in fish if self._selection.includes(message)]

    def of_type(self, kind: type[M], *, keep_payloads: bool = True) -> Iterator[M]:
        """The messages of a type; with `keep_payloads`, `payload` returns the encoding of each.

        Frames have no images if they were recorded by reference.
        """
        for _, payload in self._recording.payloads([kind], self._selection):
            message = decode(kind, payload)
            if self._selection.includes(message):
                if keep_payloads:
                    self._payloads[id(message)] = payload
                yield message

    def frames_with_images(
        self, restorer: FrameRestorer | None, *, exact: bool, missing_source: str
    ) -> Iterator[Frame]:
        """The frames with the images of `restorer`, or with those that the recording holds.

        Raises RecordingError if it holds none (`missing_source`: why the source was not found) and,
        with `exact`, if they are not the very pixels that the run continued with; without `exact`,
        this is added to `notes`.
        """
        restorer = restorer or RecordedPictures(self._recording, self._selection)
        for frame in self.of_type(Frame):
            payload = self._payloads.pop(id(frame))
            restored = restorer.restore(frame, payload)
            if restored.image.size == 0:
                raise RecordingError(
                    f"--from crop: the recording refers to its source's pictures: {missing_source}"
                )
            if not has_original_pixels(restored, payload):
                self._note_lossy_pictures(exact=exact)
            self._payloads[id(restored)] = payload
            yield restored

    def _note_lossy_pictures(self, *, exact: bool) -> None:
        line = "the recording's pictures are for viewing, the run used better ones"
        if exact:
            raise RecordingError(f"--from crop --check: {line}; give --source")
        note = f"{line}: crops differ a little; give --source to avoid that"
        if note not in self.notes:
            self.notes.append(note)

    def payload(self, message: Message) -> bytes:
        """Remove and return the encoding of a message that came from here."""
        return self._payloads.pop(id(message))


# Number of frames beyond the sought frame in which a message may stand. Chosen.
_AHEAD_FRAMES = 300


class SoughtMessages:
    """Messages of one type, sought by frame and fish in nearly the order in which they stand.

    A track confirmed as a fish comes with crops of earlier frames, maybe in a later segment.
    """

    def __init__(self, messages: Iterator[Message]) -> None:
        self._messages = messages
        self._next = next(messages, None)
        self._passed: dict[tuple[int, int], Message] = {}  # passed and not taken yet

    def until(self, frame_index: int) -> list[Message]:
        """The next messages up to a frame, in their order."""
        return [*iter(partial(self._take_next, frame_index), None)]

    def take(self, frame_index: int, track_id: int) -> Message | None:
        """The message of this frame and fish, if there is one."""
        key, last = (frame_index, track_id), frame_index + _AHEAD_FRAMES
        while key not in self._passed and (message := self._take_next(last)) is not None:
            self._passed[message.frame_index, track_of(message)] = message
        return self._passed.pop(key, None)

    def rest(self) -> Iterator[Message]:
        """The messages that were not taken."""
        yield from self._passed.values()
        if self._next is not None:
            yield self._next
        yield from self._messages

    def _take_next(self, last_frame: int) -> Message | None:
        """The next message, unless it is of a later frame."""
        message = self._next
        if message is None or message.frame_index > last_frame:
            return None
        self._next = next(self._messages, None)
        return message


class PlaybackNode:
    """Takes the place of a node and returns the messages that the node returned in the run.

    The first node of a chain returns the ends of tracks as well. Recordings from before 0.2 have
    none: there a track ends when its fish is unseen for `track_timeout_s`.
    """

    def __init__(
        self, recorded: RecordedMessages, kind: type[Message], *, track_timeout_s: float
    ) -> None:
        self._messages = SoughtMessages(recorded.of_type(kind))
        self._ends = deque(recorded.of_type(TrackEnded, keep_payloads=False))
        self._timeout = None if self._ends else TrackTimeout(track_timeout_s)
        self._last: Frame | None = None

    def step(self, message: Frame | FishCrop | FittedMesh, /) -> Sequence[Message]:
        """The messages of a frame and the tracks that end there, or of a fish in a frame."""
        if not isinstance(message, Frame):
            found = self._messages.take(message.frame_index, message.track_id)
            return [] if found is None else [found]
        recorded = self._messages.until(message.frame_index)
        self._last = message
        return [*recorded, *self._ends_after(message, recorded)]

    def _ends_after(self, frame: Frame, recorded: Sequence[Message]) -> Iterator[TrackEnded]:
        if self._timeout is not None:
            seen = [message.track_id for message in recorded if isinstance(message, FishMessage)]
            for track_id in self._timeout.step(frame.timestamp_ns, seen):
                yield TrackEnded.after(frame, track_id, "timeout")
        while self._ends and self._ends[0].frame_index <= frame.frame_index:
            yield self._ends.popleft()

    def close(self) -> Sequence[Message]:
        """The ends of the tracks that are left, if none was recorded."""
        if self._timeout is None or self._last is None:
            return ()
        return [TrackEnded.after(self._last, track, "end") for track in self._timeout.open_ids]
