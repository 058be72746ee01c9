"""Fish found in the video alone: detected in every frame, tracked, and confirmed by their masks."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.annotations.box_detector import BoxDetector
from stream_dmr.segmentation.detection.detector import Detector
from stream_dmr.segmentation.detection.fish_detection import Detection
from stream_dmr.segmentation.detection.fused_detector import FusedDetector
from stream_dmr.segmentation.tracking.box_correction import BoxCorrector
from stream_dmr.segmentation.tracking.confirmation import ConfirmationSettings, FishConfirmation
from stream_dmr.segmentation.tracking.fish_evidence import FishEvidence
from stream_dmr.segmentation.tracking.no_fish import Sightings, explain_no_fish
from stream_dmr.segmentation.tracking.repeated_fish import without_repeats
from stream_dmr.segmentation.tracking.tracker import Tracker, TrackerSettings

_MAX_CLOSER_LOOKS = 6  # at a track; each takes as long as one at a frame


class TrackFishSettings(TrackerSettings, ConfirmationSettings):
    """`[track_fish]`: how detected fish are followed, and which count."""


class TrackedFish:
    """A `FishFinder` that tracks a detector's candidates and confirms those with fish masks."""

    def __init__(self, detector: Detector, settings: TrackFishSettings) -> None:
        self._detector = detector
        self._tracker = Tracker(settings)
        self._confirmation = FishConfirmation(settings)
        self._corrector = BoxCorrector()
        self._settings = settings
        self._seen = Sightings()
        # Single pictures in which a detector's boxes are all that speaks for a fish.
        self._are_stills = not settings.across_frames and not isinstance(detector, BoxDetector)
        self._evidence: dict[int, FishEvidence] = {}  # of the frame's tracks
        self._scores: dict[int, float] = {}  # of the detector, likewise
        self._found_any = False

    def detect(self, frame: Frame) -> list[Detection]:
        """All tracks seen in a frame, by track number. Frames must come in order."""
        candidates = self._detector.find(frame)
        tracked = self._tracker.step(frame, candidates)
        self._seen.frames += 1
        self._seen.candidates += len(candidates)
        boxes = {one.track_number: one.candidate.bbox_xyxy_px for one in tracked}
        visible = {one.track_number: one.visible_fraction for one in tracked}
        self._evidence = {one.track_number: one.evidence for one in tracked}
        self._scores = {one.track_number: one.candidate.score for one in tracked}
        self._look_closer(frame, boxes)
        self._seen.any_moved |= any(one.has_moved for one in self._evidence.values())
        self._seen.any_fish_like |= any(map(self._may_count, self._evidence))
        return [
            replace(one, may_be_no_fish=not self._is_surely_fish(one.source_id))
            for one in self._corrector.correct(boxes, visible, frame)
        ]

    def _look_closer(self, frame: Frame, boxes: Mapping[int, Float[np.ndarray, "4"]]) -> None:
        """Look at one of those that move and, small as they are, look like no fish from afar."""
        if not isinstance(self._detector, FusedDetector):
            return
        waiting = [
            track
            for track, one in self._evidence.items()
            if one.has_moved and not self._may_count(track) and one.closer_looks < _MAX_CLOSER_LOOKS
        ]
        if waiting:
            track = min(waiting, key=lambda track: self._evidence[track].closer_looks)
            looks = self._detector.look_closer(frame, boxes[track])
            self._evidence[track].add_closer_look(looks)

    def _is_surely_fish(self, track: int) -> bool:
        """True for a confirmed track, and for one that went far or that need not move."""
        if self._are_stills:
            return False
        return self._evidence[track].went_far or self._confirmation.is_confirmed(track)

    def _may_count(self, track: int) -> bool:
        evidence = self._evidence[track]
        min_frames = self._settings.min_fish_like_frames
        return evidence.has_moved and evidence.looks_like_a_fish(min_frames)

    @property
    def knows_ids(self) -> bool:
        """False: track numbers also count what turns out to be no fish."""
        return False

    def confirm(self, crops: Mapping[int, FishCrop]) -> list[int]:
        """The track numbers of confirmed fish; `crops` are those of all detections of the frame."""
        self._corrector.update(crops)
        fish = [
            track
            for track, crop in crops.items()
            if self._confirmation.update(track, crop, may_count=self._may_count(track))
        ]
        if self._are_stills:
            fish = without_repeats({track: crops[track] for track in fish}, self._scores)
        self._found_any = self._found_any or bool(fish)
        self._seen.tracks = max(self._seen.tracks, *crops) if crops else self._seen.tracks
        for crop in crops.values():
            confidence = crop.quality.mask_confidence or 0.0
            self._seen.best_confidence = max(self._seen.best_confidence, confidence)
        return fish

    @property
    def gives_masks(self) -> bool:
        """False: the segmenter finds the masks."""
        return False

    @property
    def warnings(self) -> list[str]:
        """Why there are no fish, where there are none; a missed one of several is not noticed."""
        if self._found_any or self._seen.frames == 0:
            return []
        return [
            explain_no_fish(
                self._seen,
                self._detector.refused,
                min_frames=self._settings.min_track_frames,
                min_confidence=self._settings.min_mask_confidence,
            ),
        ]

    @property
    def unused(self) -> list[str]:
        """Boxes of a file that are beyond the last frame so far; nothing without such a file."""
        return self._detector.unused if isinstance(self._detector, BoxDetector) else []
