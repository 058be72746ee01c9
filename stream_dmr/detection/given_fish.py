"""Fish of a user's own boxes, masks and named pictures."""

import csv
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
from jaxtyping import Bool, Float

from stream_dmr.detection.box_files import UNKNOWN_ID, AnnotatedBox, load_boxes, unused_boxes
from stream_dmr.detection.detector import Candidate, Detector
from stream_dmr.detection.mask_folder import Labels, MaskFolder
from stream_dmr.errors import AnnotationError, reason_of
from stream_dmr.files import MAX_TEXT_BYTES, read_text
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.crop import Detection

_SHOWN = 8


def joined(names: Sequence[object]) -> str:
    """The first of them, and how many more there are."""
    shown = ", ".join(map(str, names[:_SHOWN]))
    return shown if len(names) <= _SHOWN else f"{shown} and {len(names) - _SHOWN} more"


def open_annotated_fish(
    *,
    boxes: Path | None,
    masks: Path | None,
    pictures: Path | None = None,
    across_frames: bool = True,
) -> "AnnotatedFish":
    """Open a boxes file, a masks folder, or both; the boxes must have ids.

    `pictures`: the source of the frames, `across_frames`: False for stills, see `MaskFolder`.
    Raises AnnotationError if a file cannot be read or boxes have no ids.
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


class _GivenFish:
    """A `FishFinder` of fish that somebody gave: all of them count, and their ids stay."""

    open_ids: None = None  # a given id may come again at any time

    def confirm(self, crops: Mapping[int, FishCrop]) -> dict[int, list[FishCrop]]:
        return {track_id: [crop] for track_id, crop in crops.items()}


class AnnotatedFish(_GivenFish):
    """A `FishFinder` that reads boxes and masks from files.

    With boxes alone, masks that their file draws are used, and the segmenter finds the others. With
    masks alone, each id's tightest box is used. With both, the boxes decide which fish there are
    and the masks their shapes; a fish without a mask gets an empty mask.
    """

    def __init__(
        self,
        *,
        boxes: dict[int, list[AnnotatedBox]] | None,
        masks: MaskFolder | None,
        across_frames: bool = True,
    ) -> None:
        """`across_frames`: False for stills, in which repeated ids are reported."""
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
    def has_masks(self) -> bool:
        """True with a masks folder, and if there are boxes and each has a mask of its own."""
        boxes = [*chain.from_iterable((self._boxes or {}).values())]
        has_all = bool(boxes) and all(box.mask is not None for box in boxes)
        return self._masks is not None or has_all

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
                mask=self._mask_of(box, labels, frame.image.shape[:2]),
                visible_fraction=box.visibility,
                unknown=None if labels is None else labels.unknown,
            )
            for box in boxes
        ]

    def _mask_of(
        self, box: AnnotatedBox, labels: Labels | None, shape: tuple[int, int]
    ) -> Bool[np.ndarray, "H W"] | None:
        if labels is not None:
            return labels.ids == box.track_id
        if self._masks is not None:
            return np.zeros(shape, bool)
        return None if box.mask is None else box.mask(shape)

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
        """Boxes and masks that are beyond the last frame so far, one line each."""
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
        for box in (given.in_px(width, height) for given in boxes):
            x0, y0, x1, y1 = box.bbox_xyxy_px
            if x0 <= width - 1 and y0 <= height - 1 and x1 >= 1 and y1 >= 1:
                inside.append(box)
            else:
                self._boxes_outside.append((frame.frame_index, box.track_id))
        self._boxed_ids.update(box.track_id for box in inside)
        return inside


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


PICTURE, FISH = "picture", "fish"


def names_pictures(path: Path) -> bool:
    """True for a CSV with the words `picture` and `fish` in its header, in any notation."""
    if path.suffix.lower() != ".csv" or not path.is_file():
        return False
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        header = file.readline(MAX_TEXT_BYTES)
    return {PICTURE, FISH} <= set(re.findall(r"\w+", header.lower()))


class NamedPictures(_GivenFish):
    """A `FishFinder` of pictures that show one fish each; the same id is the same fish.

    The fish is the largest candidate of the detector, or all fish pixels of the masks folder.
    """

    def __init__(self, path: Path, found_by: Detector | MaskFolder) -> None:
        """Raises AnnotationError, with the line, if an id is no number from 1 on."""
        self._fish = _read(path)
        self._masks = found_by if isinstance(found_by, MaskFolder) else None
        self.has_masks = self._masks is not None
        self._detector = found_by if isinstance(found_by, Detector) else None
        self._unnamed: list[str] = []
        self._seen: set[str] = set()

    @property
    def warnings(self) -> list[str]:
        """The pictures without a row so far, in one line."""
        if not self._unnamed:
            return []
        return [f"pictures without a fish in the CSV: {joined(self._unnamed)}; left out"]

    @property
    def unused(self) -> list[str]:
        """The rows without a picture so far, in one line."""
        missing = sorted(self._fish.keys() - self._seen)
        if not missing:
            return []
        return [f"pictures of the CSV that the source doesn't have: {joined(missing)}"]

    def detect(self, frame: Frame) -> list[Detection]:
        """The fish of a picture. Raises AnnotationError for an unusable mask."""
        fish = self._fish.get(frame.source)
        if fish is None:
            self._unnamed.append(frame.source)
            return []
        self._seen.add(frame.source)
        height, width = frame.image.shape[:2]
        mask = unknown = None
        if self._masks is not None:
            labels = self._masks.labels(
                frame.frame_index, width=width, height=height, picture=frame.source
            )
            mask = np.zeros((height, width), bool) if labels is None else labels.ids > 0
            unknown = None if labels is None else labels.unknown
        return [
            Detection(
                source_id=fish,
                bbox_xyxy_px=self._box(frame),
                mask=mask,
                visible_fraction=1.0,
                unknown=unknown,
            )
        ]

    def _box(self, frame: Frame) -> Float[np.ndarray, "4"]:
        """The box of the largest candidate; the whole picture if there is none."""
        height, width = frame.image.shape[:2]
        found = [] if self._detector is None else self._detector.find(frame)
        boxes = [candidate.bbox_xyxy_px for candidate in found]
        areas = [np.prod(box[2:] - box[:2]) for box in boxes]
        return boxes[int(np.argmax(areas))] if boxes else np.array([0.0, 0.0, width, height])


_MAX_BYTES = 100_000_000  # a million pictures; chosen


def _read(path: Path) -> dict[str, int]:
    try:
        header, *rows = csv.reader(read_text(path, max_bytes=_MAX_BYTES).splitlines())
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise AnnotationError(
            f"{path}: expected a CSV in UTF-8, got: {reason_of(error)}; save it as CSV UTF-8"
        ) from error
    columns = [cell.strip() for cell in header]
    if not {PICTURE, FISH} <= {*columns}:
        raise AnnotationError(
            f"{path}: expected the columns {PICTURE} and {FISH}, separated by a comma, got "
            f"{','.join(header)}"
        )
    found: dict[str, int] = {}
    for line, cells in enumerate(rows, start=2):
        if not cells:
            continue  # an empty line
        row = dict(zip(columns, cells, strict=False))
        name, fish = row.get(PICTURE, "").strip(), row.get(FISH, "").strip()
        if not name or not fish.isdecimal() or int(fish) < 1:
            raise AnnotationError(
                f"{path}:{line}: expected a picture's file name and a fish's number from 1 on, "
                f"got {name!r} and {fish!r}"
            )
        if found.setdefault(name, int(fish)) != int(fish):
            raise AnnotationError(
                f"{path}:{line}: expected one fish per picture, got another one for {name!r}; "
                "pictures of several fish need --boxes or --masks with ids"
            )
    return found


class BoxDetector:
    """A `Detector` that returns the boxes of a file, clipped to the frame."""

    refused: Mapping[str, int] = MappingProxyType({})  # every box of the file is a candidate

    def __init__(self, frames: Mapping[int, Sequence[AnnotatedBox]]) -> None:
        self._frames = frames
        self._last_frame = 0

    @property
    def unused(self) -> list[str]:
        """Boxes that are beyond the last frame so far, in one line."""
        return unused_boxes(self._frames, self._last_frame)

    def find(self, frame: Frame) -> list[Candidate]:
        """The file's boxes of this frame that are at least one pixel wide and high inside it."""
        self._last_frame = max(self._last_frame, frame.frame_index)
        height, width = frame.image.shape[:2]
        candidates = []
        for box in self._frames.get(frame.frame_index, ()):
            inside = box.in_px(width, height).bbox_xyxy_px.clip(0, [width, height, width, height])
            if np.all(inside[2:] - inside[:2] >= 1):
                candidates.append(Candidate(bbox_xyxy_px=inside, score=box.score))
        return candidates
