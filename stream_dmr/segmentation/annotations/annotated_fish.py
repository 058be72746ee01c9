"""Fish by the boxes and masks that annotation files give for each frame."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool

from stream_dmr.errors import AnnotationError
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.annotations.annotated_box import UNKNOWN_ID, AnnotatedBox
from stream_dmr.segmentation.annotations.box_files import load_boxes, unused_boxes
from stream_dmr.segmentation.annotations.joined_names import joined
from stream_dmr.segmentation.annotations.mask_folder import Labels, MaskFolder
from stream_dmr.segmentation.detection.fish_detection import Detection


def open_annotated_fish(
    *,
    boxes: Path | None,
    masks: Path | None,
    pictures: Path | None = None,
    across_frames: bool = True,
) -> "AnnotatedFish":
    """Open a boxes file, a masks folder, or both; the boxes must have ids.

    `pictures`: the source of the frames, `across_frames`: False for stills, see `MaskFolder`.
    Raises AnnotationError where one cannot be read or boxes have no ids.
    """
    by_frame = None if boxes is None else load_boxes(boxes, pictures=pictures)
    for box in (box for found in (by_frame or {}).values() for box in found):
        if box.track_id == UNKNOWN_ID:
            raise AnnotationError(
                f"{boxes}: expected the ids of --masks, got boxes without ids; add the ids, or "
                "leave out --boxes: the masks give boxes as well"
            )
    folder = None
    if masks is not None:
        folder = MaskFolder(masks, pictures=pictures, across_frames=across_frames)
    return AnnotatedFish(boxes=by_frame, masks=folder, across_frames=across_frames)


class AnnotatedFish:
    """A `FishFinder` that reads boxes and masks from files.

    With boxes alone, the segmenter finds the masks. With masks alone, each id's tightest box is
    used. With both, the boxes decide which fish there are; one without a mask gets an empty mask.
    """

    def __init__(
        self,
        *,
        boxes: dict[int, list[AnnotatedBox]] | None,
        masks: MaskFolder | None,
        across_frames: bool = True,
    ) -> None:
        """`across_frames`: False for stills, where an id in several pictures is said."""
        self._boxes = boxes
        self._masks = masks
        self._last_frame = 0
        self._frames_without_mask: list[int] = []
        self._boxes_outside: list[tuple[int, int]] = []  # frame, id
        self._boxed_ids: set[int] = set()
        self._masked_ids: set[int] = set()
        self._across_frames = across_frames
        self._pictures_of = defaultdict[int, set[int]](set)  # of stills: id -> frames

    @property
    def gives_masks(self) -> bool:
        """True with a masks folder: a fish that is in no mask gets an empty one."""
        return self._masks is not None

    def detect(self, frame: Frame) -> list[Detection]:
        """The fish of one frame, ordered by id. Raises AnnotationError for an unusable mask."""
        detections = self._detect(frame)
        if not self._across_frames:
            for detection in detections:
                self._pictures_of[detection.source_id].add(frame.frame_index)
        return detections

    def _detect(self, frame: Frame) -> list[Detection]:
        self._last_frame = max(self._last_frame, frame.frame_index)
        if self._boxes is None:
            labels = self._labels(frame, is_expected=True)
            return [] if labels is None else _detections_of(labels)
        boxes = self._boxes_inside(frame, self._boxes.get(frame.frame_index, ()))
        labels = self._labels(frame, is_expected=bool(boxes))
        return [
            Detection(
                source_id=box.track_id,
                bbox_xyxy_px=box.bbox_xyxy_px,
                mask=self._mask(frame, box, labels),
                visible_fraction=box.visibility,
                unknown=None if labels is None else labels.unknown,
            )
            for box in boxes
        ]

    @property
    def knows_ids(self) -> bool:
        """True: files say which fish is which."""
        return True

    def confirm(self, crops: Mapping[int, FishCrop]) -> list[int]:
        """All ids: every annotated object is a fish."""
        return list(crops)

    @property
    def warnings(self) -> list[str]:
        """Mismatches between boxes and masks so far, and ids in several stills; one line each."""
        lines: list[str] = []
        several = {fish: len(found) for fish, found in self._pictures_of.items() if len(found) > 1}
        if several:
            ids = joined([f"id {fish} in {several[fish]} pictures" for fish in sorted(several)])
            lines.append(
                f"--stills: equal ids were taken for one fish with one length: {ids}; where "
                "pictures show different fish, give each of these an id of its own"
            )
        if missing := self._frames_without_mask:
            lines.append(
                f"masks: no picture for {len(missing)} frames, the first of them {missing[0]}"
            )
        if outside := self._boxes_outside:
            lines.append(
                f"boxes: {len(outside)} lie outside the picture and were left out, "
                f"the first of them of id {outside[0][1]} in frame {outside[0][0]}"
            )
        if self._boxes is not None and self._masks is not None:
            if unmasked := sorted(self._boxed_ids - self._masked_ids):
                lines.append(f"boxes: ids {joined(unmasked)} are in no mask, so have no outline")
            if unboxed := sorted(self._masked_ids - self._boxed_ids):
                lines.append(f"masks: ids {joined(unboxed)} have no box, so were left out")
        return lines

    @property
    def unused(self) -> list[str]:
        """Whether boxes and masks are beyond the last frame so far, one line each."""
        boxes = [] if self._boxes is None else unused_boxes(self._boxes, self._last_frame)
        masks = [] if self._masks is None else self._masks.unused(self._last_frame)
        return [*boxes, *masks]

    def _labels(self, frame: Frame, *, is_expected: bool) -> Labels | None:
        if self._masks is None:
            return None
        height, width = frame.image.shape[:2]
        labels = self._masks.labels(
            frame.frame_index, width=width, height=height, picture=frame.source
        )
        if labels is not None:
            self._masked_ids.update(labels.present)
        elif is_expected:  # a frame without boxes needs no mask
            self._frames_without_mask.append(frame.frame_index)
        return labels

    def _boxes_inside(self, frame: Frame, boxes: Sequence[AnnotatedBox]) -> list[AnnotatedBox]:
        """The boxes that contain at least one pixel centre of the frame."""
        height, width = frame.image.shape[:2]
        inside = []
        for box in boxes:
            x0, y0, x1, y1 = box.bbox_xyxy_px
            if x0 <= width - 1 and y0 <= height - 1 and x1 >= 1 and y1 >= 1:
                inside.append(box)
            else:
                self._boxes_outside.append((frame.frame_index, box.track_id))
        self._boxed_ids.update(box.track_id for box in inside)
        return inside

    def _mask(
        self, frame: Frame, box: AnnotatedBox, labels: Labels | None
    ) -> Bool[np.ndarray, "H W"] | None:
        if self._masks is None:
            return None
        if labels is None:
            return np.zeros(frame.image.shape[:2], bool)
        return labels.ids == box.track_id


def _detections_of(labels: Labels) -> list[Detection]:
    """One detection per id in a label picture, with its tightest box."""
    detections = []
    rows, columns = labels.window
    ids = labels.ids[rows, columns]
    for source_id in labels.present:
        mask = ids == source_id
        x, y, width, height = cv2.boundingRect(mask.view(np.uint8))
        left, top = columns.start + x, rows.start + y
        detections.append(
            Detection(
                source_id=source_id,
                bbox_xyxy_px=np.array([left, top, left + width, top + height], np.float64),
                mask=mask[y : y + height, x : x + width],
                mask_corner=(left, top),
                visible_fraction=1.0,
                unknown=labels.unknown,
            )
        )
    return detections
