"""Find the fish of a video: detector, tracker and confirmation together.

A detector may find a fish twice in a picture, or take a part of a fish for another fish. A box with
a fish's tail and a box without it, or a fish and its fin, overlap too little to be one box. Their
masks decide: two fish share no pixels.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from stream_dmr.detection.box_files import UNKNOWN_ID, load_boxes
from stream_dmr.detection.detector import Detector
from stream_dmr.detection.fused_detector import FusedDetector
from stream_dmr.detection.given_fish import (
    AnnotatedFish,
    BoxDetector,
    NamedPictures,
    names_pictures,
    open_annotated_fish,
)
from stream_dmr.detection.mask_folder import MaskFolder
from stream_dmr.detection.network_detectors import OnnxDetector
from stream_dmr.detection.open_detector import DetectFishSettings, open_detector
from stream_dmr.detection.picture_views import find_in_still
from stream_dmr.detection.still_water import Repeats
from stream_dmr.errors import ConfigError
from stream_dmr.geometry import box_iou, long_axis, whole_pixels
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.crop import Detection
from stream_dmr.segmentation.crop_geometry import mask_in_crop
from stream_dmr.tracking.box_correction import BoxCorrector
from stream_dmr.tracking.confirmation import ConfirmationSettings, FishConfirmation, FishEvidence
from stream_dmr.tracking.track import TrackedCandidate
from stream_dmr.tracking.tracker import Tracker, TrackerSettings


@dataclass(kw_only=True)
class Sightings:
    """Counts of the candidates in the frames so far, to explain why there are no fish."""

    frames: int = 0
    candidates: int = 0  # shapes that a detector took for possible fish, over all frames
    tracks: int = 0
    any_moved: bool = False  # a track moved from its place
    any_fish_like: bool = False  # a track that moved looked like a fish
    any_cut_out: bool = False  # a track had sure masks, but did not move or look like a fish
    best_score: float = 0.0  # of any candidate
    best_confidence: float = 0.0  # highest `mask_confidence` of any crop
    without: int = 0  # stills without a fish that counts
    some_without: list[str] = field(default_factory=list)  # names of the first of these


class TrackFishSettings(TrackerSettings, ConfirmationSettings):
    """`[track_fish]`: how detected fish are followed, and which count."""


def explain_no_fish(
    seen: Sightings, refused: Mapping[str, int], settings: TrackFishSettings
) -> str:
    """Return one line: why no fish was found in these frames, and what to do.

    `refused` are the detector's shapes that were no candidates, by reason.
    """
    begin = f"no fish in {seen.frames} frames: "
    commonest = sorted(refused.items(), key=lambda item: -item[1])
    shapes = ", ".join(f"{count} {reason}" for reason, count in commonest)
    if 0 < seen.candidates < sum(refused.values()):  # what most often moved may be the fish
        begin += f"most of what moved was refused ({shapes}), change that where it was fish; else "
    if seen.candidates == 0 and not settings.across_frames:
        return begin + (
            "nothing looked like a fish that is a twentieth of the picture long or more; go "
            "nearer, or give --boxes"
        )
    if seen.candidates == 0 and not refused:
        return begin + (
            "nothing moved or looked like a fish; fish that hardly move and look unlike others "
            "need a detector of your own (.onnx), or --boxes"
        )
    if seen.candidates == 0:
        return begin + (
            f"all {sum(refused.values())} moving shapes were refused ({shapes}); change that "
            "setting where these were fish"
        )
    if seen.best_score < settings.min_score:
        return begin + (
            f"{seen.candidates} shapes looked a little like a fish, the most with a score of "
            f"{seen.best_score:.2f}, below [track_fish] min_score = {settings.min_score:g}; lower "
            "it, or give --boxes"
        )
    if seen.tracks > 0 and not seen.any_moved:
        return begin + (
            f"{seen.tracks} shapes were followed, none left its place by a quarter of its size, "
            "as plants and glitter don't; fish that stay need a detector of your own (.onnx) or "
            "--boxes; --stills for single pictures"
        )
    if seen.tracks > 0 and not seen.any_fish_like:
        return begin + (
            f"{seen.tracks} shapes were followed, none looked like a fish to the network; set "
            "[track_fish] min_fish_like_frames = 0 where they are fish"
        )
    if seen.best_confidence < settings.min_mask_confidence:
        return begin + (
            f"{seen.candidates} shapes were looked at, and no mask was as sure as [track_fish] "
            f"min_mask_confidence = {settings.min_mask_confidence:g} (the surest "
            f"{seen.best_confidence:.2f}); lower it, or train the network on these pictures"
        )
    if seen.any_cut_out:
        return begin + (
            f"{seen.tracks} shapes were followed; those with sure masks did not move, or did not "
            "look like a fish to the network; set [track_fish] min_fish_like_frames = 0 where they "
            "are fish"
        )
    return begin + (
        f"{seen.tracks} shapes were followed, none had a sure mask in a quarter of its frames and "
        f"in {settings.min_track_frames} within the zone; lower [track_fish] min_mask_confidence "
        "or min_track_frames, or widen zone; --stills for single pictures"
    )


_MAX_NAMED = 5  # pictures without fish


def explain_pictures_without(seen: Sightings) -> str:
    """Return one line: which stills have no fish that counts, and what to do."""
    names = ", ".join(seen.some_without)
    if seen.without > len(seen.some_without):
        names += ", ..."
    return (
        f"no fish that counts in {seen.without} of {seen.frames} pictures: {names}; where they "
        "show fish, lower [track_fish] min_score or min_mask_confidence, or give --boxes"
    )


# Share of a mask that lies inside another mask. In 70 stills, repeats and fins had 0.85 and more of
# their pixels in the fish's mask, neighbours at most 0.14; see docs/research/real-lengths.md.
_SAME = 0.5


def without_repeats(crops: Mapping[int, FishCrop], scores: Mapping[int, float]) -> list[int]:
    """Ids of the crops of a picture, without crops whose masks lie in a mask of higher score."""
    kept: list[int] = []
    for track in sorted(crops, key=lambda track: -scores[track]):
        if all(share_inside(crops[track], crops[other]) <= _SAME for other in kept):
            kept.append(track)
    return sorted(kept)


def share_inside(crop: FishCrop, other: FishCrop) -> float:
    """The share of a crop's mask that lies in another crop's of the same frame; 0 if it is empty.

    Both cameras have the frame camera's orientation and no distortion.
    """
    if box_iou(crop.bbox_xyxy_px, other.bbox_xyxy_px) == 0:
        return 0.0
    both = crop.mask & _mask_in(crop, other)
    return np.count_nonzero(both) / max(np.count_nonzero(crop.mask), 1)


def _mask_in(crop: FishCrop, other: FishCrop) -> Bool[np.ndarray, "S S"]:
    """Another crop's mask of the same frame, in the pixels of this one."""
    return mask_in_crop(other.mask, camera=other.crop_camera, other=crop.crop_camera)


# Of the length: what counts as an end, and how far beyond it another fish is looked for; how far to
# the sides, where a fish has others only if it lies upon them. Chosen.
_END, _ASIDE = 0.03, 0.15


def goes_under(crop: FishCrop, others: Iterable[FishCrop]) -> bool:
    """True if snout or tail ends at another fish's mask, which may hide the rest of it.

    An end with another fish on both its sides lies upon that fish.
    """
    rows, columns = np.nonzero(crop.mask)
    covered = np.zeros_like(crop.mask)
    for other in others:
        covered |= _mask_in(crop, other)
    if len(rows) < 3 or not covered.any():
        return False
    points = np.column_stack([columns, rows]).astype(np.float64)
    axis = long_axis(points)
    length_px = float(np.ptp(points @ axis))
    for along in (axis, -axis):
        place = points @ along
        end = points[place >= place.max() - _END * length_px]
        aside = _ASIDE * length_px * np.array([-along[1], along[0]])
        beyond, left, right = (
            _is_mostly(covered, end + step) for step in (_END * length_px * along, aside, -aside)
        )
        if beyond and not (left and right):
            return True
    return False


def _is_mostly(layer: Bool[np.ndarray, "S S"], points: Float[np.ndarray, "N 2"]) -> bool:
    """True if more than half of the pixels (x, y) are in a layer."""
    x, y = np.round(points).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < layer.shape[1]) & (y < layer.shape[0])
    return bool(np.count_nonzero(layer[y[inside], x[inside]]) > len(points) / 2)


def _judged(crops: Mapping[int, FishCrop], track: int, fish: Collection[int]) -> FishCrop:
    """The crop of one of a still's fish; without an end if it may go on under another one."""
    crop = crops[track]
    if not goes_under(crop, [crops[other] for other in fish if other != track]):
        return crop
    return replace(crop, quality=replace(crop.quality, missing_end=1.0))


_MAX_AT_ONCE = 2  # closer looks in a frame; each takes as long as four looks at a whole frame


class TrackedFish:
    """A `FishFinder` that tracks a detector's candidates and confirms those with fish masks."""

    def __init__(self, detector: Detector, settings: TrackFishSettings) -> None:
        self._detector = detector
        self._tracker = Tracker(settings)
        self._confirmation = FishConfirmation(settings)
        self._corrector = BoxCorrector()
        self._repeats = Repeats()
        self._tracked: list[TrackedCandidate] = []  # in the last frame
        self._settings = settings
        self._seen = Sightings()
        # Single pictures in which a detector's boxes are all that speaks for a fish.
        self._are_stills = not settings.across_frames and not isinstance(detector, BoxDetector)
        self._evidence: dict[int, FishEvidence] = {}  # of the frame's tracks
        self._scores: dict[int, float] = {}  # of the detector, likewise
        self._found_any = False
        self._name = ""  # of the last picture

    def detect(self, frame: Frame) -> list[Detection]:
        """All tracks seen in a frame, by track number. Frames must come in order."""
        self._name = frame.source
        self._seen.frames += 1
        tracked = self._tracked = self._follow(frame)
        boxes = {fish.track_number: fish.candidate.bbox_xyxy_px for fish in tracked}
        visible = {fish.track_number: fish.visible_fraction for fish in tracked}
        self._evidence = {fish.track_number: fish.evidence for fish in tracked}
        self._scores = {fish.track_number: fish.candidate.score for fish in tracked}
        self._look_closer(frame, boxes)
        self._seen.any_moved |= any(track.has_moved for track in self._evidence.values())
        self._seen.any_fish_like |= any(map(self._may_count, self._evidence))
        due = {
            track: box
            for track, box in boxes.items()
            if self._evidence[track].is_due
            or self._may_count(track)
            or self._confirmation.is_confirmed(track)
        }
        # Boxes of given masks are not corrected, since these have no confidence.
        masks = {fish.track_number: fish.candidate.foreground for fish in tracked}
        return [
            replace(
                detection,
                mask=masks[detection.source_id] if self.has_masks else None,
                mask_corner=whole_pixels(boxes[detection.source_id])[:2],
                may_be_no_fish=not self._is_surely_fish(detection.source_id),
            )
            for detection in self._corrector.correct(due, visible, frame)
        ]

    def _follow(self, frame: Frame) -> list[TrackedCandidate]:
        """The tracks seen in a frame.

        A picture that repeats the one before shows the same: its fish do not rest.
        """
        if self._are_stills and not self.has_masks:
            candidates = find_in_still(self._detector, frame)
        elif self._passes_over(frame):
            candidates = []
        elif self._repeats_the_last(frame):
            return self._tracked
        else:
            candidates = self._detector.find(frame)
        tracked = self._tracker.step(frame, candidates)
        self._seen.candidates += len(candidates)
        scores = [candidate.score for candidate in candidates]
        self._seen.best_score = max([self._seen.best_score, *scores])
        if self.has_masks:
            tracked = [fish for fish in tracked if fish.candidate.foreground is not None]
        return tracked

    def _passes_over(self, frame: Frame) -> bool:
        """True if nothing happens in a frame of a video."""
        return (
            self._settings.across_frames
            and isinstance(self._detector, FusedDetector)
            and self._detector.passes_over(frame, is_followed=self._tracker.is_following)
        )

    def _repeats_the_last(self, frame: Frame) -> bool:
        """True for a picture of a video that is none of its own, while something is followed.

        Boxes of a file are for each picture.
        """
        if not self._settings.across_frames or isinstance(self._detector, BoxDetector):
            return False
        return self._repeats.is_repeat(frame) and self._tracker.is_following

    def _look_closer(self, frame: Frame, boxes: Mapping[int, Float[np.ndarray, "4"]]) -> None:
        """Look closer at some of the moving tracks that do not yet count as fish."""
        if not isinstance(self._detector, FusedDetector):
            return
        waiting = [
            track
            for track, seen in self._evidence.items()
            if seen.has_moved and seen.wants_closer_look and not self._may_count(track)
        ]
        waiting.sort(key=lambda track: self._evidence[track].closer_looks)
        for track in waiting[:_MAX_AT_ONCE]:
            looks = self._detector.look_closer(frame, boxes[track])
            self._evidence[track].add_closer_look(looks)

    def _is_surely_fish(self, track: int) -> bool:
        """True for a confirmed track, and for a track that went far or need not move."""
        if self._are_stills:
            return False
        return self._evidence[track].went_far or self._confirmation.is_confirmed(track)

    def _may_count(self, track: int) -> bool:
        evidence = self._evidence[track]
        min_frames = self._settings.min_fish_like_frames
        return evidence.has_moved and evidence.looks_like_a_fish(min_frames)

    @property
    def open_ids(self) -> Collection[int]:
        """The track numbers that later frames may show."""
        return self._tracker.open_numbers

    def forget_tracks(self) -> None:
        """Forget all tracks: later frames show other fish."""
        self._tracker.forget_tracks()

    def confirm(self, crops: Mapping[int, FishCrop]) -> dict[int, list[FishCrop]]:
        """Confirmed fish by track number; `crops` are those of all detections of the frame."""
        self._corrector.update(crops)
        self._confirmation.forget_all_but(self._tracker.open_numbers)
        fish = {
            track: shown
            for track in self._without_parts(crops)
            if (
                shown := self._confirmation.update(
                    track, crops[track], may_count=self._may_count(track)
                )
            )
        }
        if self._are_stills:
            single = without_repeats({track: crops[track] for track in fish}, self._scores)
            fish = {track: [_judged(crops, track, single)] for track in single}
            if not fish:
                self._seen.without += 1
                if len(self._seen.some_without) < _MAX_NAMED:
                    self._seen.some_without.append(self._name)
        self._found_any |= bool(fish)
        self._seen.any_cut_out |= any(
            self._confirmation.is_cut_out(track) and not self._may_count(track) for track in crops
        )
        self._seen.tracks = max([self._seen.tracks, *crops])
        confidences = [crop.quality.mask_confidence or 0.0 for crop in crops.values()]
        self._seen.best_confidence = max([self._seen.best_confidence, *confidences])
        return fish

    def _without_parts(self, crops: Mapping[int, FishCrop]) -> Collection[int]:
        """The tracks of a film's frame, without those that follow a part of a confirmed fish.

        A fish that rests and moves its head is one fish. What is not confirmed yet and holds a
        confirmed fish is no other one either, but glare or a gaff with it, or a mask of both.
        """
        if not self._settings.across_frames or isinstance(self._detector, BoxDetector):
            return crops
        area_px = {track: crop.quality.mask_area_px for track, crop in crops.items()}
        sure = [track for track in crops if self._confirmation.is_confirmed(track)]
        return [
            track
            for track, crop in crops.items()
            if not any(
                share_inside(crop, crops[fish]) > _SAME
                for fish in sure
                if fish != track and (track not in sure or area_px[fish] > area_px[track])
            )
            and (track in sure or not any(share_inside(crops[fish], crop) > _SAME for fish in sure))
        ]

    @property
    def has_masks(self) -> bool:
        """True if the detector finds masks as well; else the segmenter finds them."""
        return isinstance(self._detector, OnnxDetector) and self._detector.has_masks

    @property
    def warnings(self) -> list[str]:
        """Why there are no fish, or which stills have none.

        A fish missed among others of its picture or film is not noticed.
        """
        if self._seen.frames == 0:
            return []
        if self._found_any:
            return [explain_pictures_without(self._seen)] if self._seen.without else []
        return [explain_no_fish(self._seen, self._detector.refused, self._settings)]

    @property
    def unused(self) -> list[str]:
        """Boxes of a file that are beyond the last frame so far; nothing without such a file."""
        return self._detector.unused if isinstance(self._detector, BoxDetector) else []


@runtime_checkable
class FishFinder(Protocol):
    """Finds the fish of each frame: `detect` before the crops are cut, then `confirm`."""

    @property
    def has_masks(self) -> bool:
        """True if every detection comes with a mask, so that no segmenter is needed."""
        ...

    @property
    def warnings(self) -> list[str]:
        """Warnings about the frames so far, one line each; complete at the end."""
        ...

    @property
    def unused(self) -> list[str]:
        """Entries of the given files that matched no frame so far, one line each.

        Complete at the end of the source.
        """
        ...

    def detect(self, frame: Frame) -> list[Detection]:
        """Detect candidates in a frame. Raises AnnotationError for an unusable mask."""
        ...

    @property
    def open_ids(self) -> Collection[int] | None:
        """The ids that later frames may show; None if ids are given and the future is unknown."""
        ...

    def confirm(self, crops: Mapping[int, FishCrop]) -> dict[int, list[FishCrop]]:
        """The crops of the frame's fish by `source_id`, from the `crops` of all detections.

        A fish that is confirmed in this frame comes with its crops of earlier frames.
        """
        ...


def open_finder(
    *,
    boxes: Path | None,
    masks: Path | None,
    detect: DetectFishSettings,
    track: TrackFishSettings,
    pictures: Path | None = None,
) -> FishFinder:
    """Open annotation files if there are any; else track fish, as also for boxes without ids.

    `pictures`: the source of the frames, whose names masks and boxes may refer to.
    Raises AnnotationError or ModelError if a file cannot be read, and ConfigError for motion in
    pictures of which none follows another.
    """
    if boxes is None and masks is None:
        if detect.detector == "motion" and not track.across_frames:
            raise ConfigError(
                "[track_fish] across_frames = false: expected a detector for single pictures, got "
                '[detect_fish] detector = "motion"; set it to "looks", or give --stills instead'
            )
        return TrackedFish(open_detector(detect), track)
    if boxes is not None and names_pictures(boxes):
        folder = None if masks is None else MaskFolder(masks, pictures=pictures)
        return NamedPictures(boxes, folder or open_detector(detect))
    if boxes is None or masks is not None:
        return open_annotated_fish(
            boxes=boxes, masks=masks, pictures=pictures, across_frames=track.across_frames
        )
    frames = load_boxes(boxes, pictures=pictures)
    if any(box.track_id == UNKNOWN_ID for found in frames.values() for box in found):
        return TrackedFish(BoxDetector(frames), track)
    return AnnotatedFish(boxes=frames, masks=None, across_frames=track.across_frames)
