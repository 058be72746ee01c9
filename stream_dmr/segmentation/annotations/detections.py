"""Which fish are in a frame, where, and of what outline: here as files say it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Integer

from stream_dmr.errors import UserError
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.annotations.files import Box, Masks, load_boxes


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Detection:
    """One fish seen in one frame."""

    track_id: int
    bbox_xyxy_px: Float[np.ndarray, "4"]  # half-open, frame pixels
    # Of the frame's size, all False where there is nothing; None: for a segmenter to find.
    mask: Bool[np.ndarray, "H W"] | None
    visible_fraction: float  # 0 to 1


def open_annotations(*, boxes: Path | None, masks: Path | None) -> "Annotations":
    """The fish that a boxes file, a masks folder or both describe.

    Raises AnnotationError where they can't be read, UserError where neither is given.
    """
    if boxes is None and masks is None:
        raise UserError("expected to be told where the fish are: give --boxes, --masks or both")
    return Annotations(
        boxes=None if boxes is None else load_boxes(boxes),
        masks=None if masks is None else Masks(masks),
    )


class Annotations:
    """Fish by boxes and masks from files.

    Boxes alone: a segmenter is to find the masks. Masks alone: they give the boxes. Both: the boxes
    say which fish there are; one whose mask is missing keeps its box and gets an empty mask.
    """

    def __init__(self, *, boxes: dict[int, list[Box]] | None, masks: Masks | None) -> None:
        self._boxes = boxes
        self._masks = masks
        self._frames_without_mask: list[int] = []
        self._boxes_outside: list[tuple[int, int]] = []  # frame, id
        self._boxed_ids: set[int] = set()
        self._masked_ids: set[int] = set()

    def detect(self, frame: Frame) -> list[Detection]:
        """The fish of one frame, by id. Raises AnnotationError where its mask can't be used."""
        if self._boxes is None:
            labels = self._labels(frame, is_expected=True)
            return [] if labels is None else _detections_of(labels)
        boxes = self._boxes_inside(frame, self._boxes.get(frame.frame_index, ()))
        labels = self._labels(frame, is_expected=bool(boxes))
        return [
            Detection(
                track_id=box.track_id,
                bbox_xyxy_px=box.bbox_xyxy_px,
                mask=self._mask(frame, box, labels),
                visible_fraction=box.visibility,
            )
            for box in boxes
        ]

    def admit(self, crops: Iterable[FishCrop]) -> list[FishCrop]:
        """All of them: what files describe is fish."""
        return list(crops)

    @property
    def warnings(self) -> list[str]:
        """What didn't fit together in the frames so far, a line each; best read at the end."""
        lines = []
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
                lines.append(f"boxes: ids {_join(unmasked)} are in no mask, so have no outline")
            if unboxed := sorted(self._masked_ids - self._boxed_ids):
                lines.append(f"masks: ids {_join(unboxed)} have no box, so were left out")
        return lines

    def _labels(self, frame: Frame, *, is_expected: bool) -> Integer[np.ndarray, "H W"] | None:
        if self._masks is None:
            return None
        height, width = frame.image.shape[:2]
        labels = self._masks.labels(frame.frame_index, width=width, height=height)
        if labels is not None:
            self._masked_ids.update(_ids(labels))
        elif is_expected:  # where no fish is boxed, none is missed
            self._frames_without_mask.append(frame.frame_index)
        return labels

    def _boxes_inside(self, frame: Frame, boxes: Sequence[Box]) -> list[Box]:
        """Those with at least a pixel's centre in the frame."""
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
        self, frame: Frame, box: Box, labels: Integer[np.ndarray, "H W"] | None
    ) -> Bool[np.ndarray, "H W"] | None:
        if self._masks is None:
            return None
        if labels is None:
            return np.zeros(frame.image.shape[:2], bool)
        return labels == box.track_id


def _detections_of(labels: Integer[np.ndarray, "H W"]) -> list[Detection]:
    """One detection per id in a label picture, with the tightest box around it."""
    detections = []
    for track_id in _ids(labels):
        mask = labels == track_id
        columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
        box = np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float64)
        detections.append(
            Detection(track_id=track_id, bbox_xyxy_px=box, mask=mask, visible_fraction=1.0)
        )
    return detections


def _ids(labels: Integer[np.ndarray, "H W"]) -> list[int]:
    return np.unique(labels[labels > 0]).tolist()  # only fish are sorted, not the sea around them


def _join(ids: list[int]) -> str:
    shown = ", ".join(map(str, ids[:8]))
    return shown if len(ids) <= 8 else f"{shown} and {len(ids) - 8} more"
