"""Pictures of one fish each, by a CSV that says which fish a picture shows."""

import csv
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from stream_dmr.errors import AnnotationError
from stream_dmr.messages import FishCrop, Frame
from stream_dmr.segmentation.annotations.joined_names import joined
from stream_dmr.segmentation.annotations.mask_folder import MaskFolder
from stream_dmr.segmentation.detection.detector import Detector
from stream_dmr.segmentation.detection.fish_detection import Detection

PICTURE, FISH = "picture", "fish"


def names_pictures(path: Path) -> bool:
    """True for a CSV whose header speaks of `picture` and `fish`, whatever stands between them."""
    if path.suffix.lower() != ".csv" or not path.is_file():
        return False
    header = path.read_text(encoding="utf-8-sig", errors="replace").partition("\n")[0]
    return {PICTURE, FISH} <= set(re.findall(r"\w+", header.lower()))


class NamedPictures:
    """A `FishFinder` of pictures that show one fish each; the same id is the same fish.

    The fish is the largest thing that the detector finds, or of the masks folder all that is fish.
    """

    def __init__(self, path: Path, found_by: Detector | MaskFolder) -> None:
        """Raises AnnotationError, with the line, where an id is no number from 1 on."""
        self._fish = _read(path)
        self._masks = found_by if isinstance(found_by, MaskFolder) else None
        self._detector = found_by if isinstance(found_by, Detector) else None
        self._unnamed: list[str] = []
        self._seen: set[str] = set()

    @property
    def gives_masks(self) -> bool:
        """True with a masks folder."""
        return self._masks is not None

    @property
    def knows_ids(self) -> bool:
        """True: the file says which fish is which."""
        return True

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
        """Around the largest candidate; the whole picture where there is none."""
        height, width = frame.image.shape[:2]
        found = [] if self._detector is None else self._detector.find(frame)
        boxes = [candidate.bbox_xyxy_px for candidate in found]
        return max(boxes, key=_area, default=np.array([0.0, 0.0, width, height]))

    def confirm(self, crops: Mapping[int, FishCrop]) -> list[int]:
        """All ids: every picture that is named shows a fish."""
        return list(crops)


def _area(bbox_xyxy_px: Float[np.ndarray, "4"]) -> float:
    return float(np.prod(bbox_xyxy_px[2:] - bbox_xyxy_px[:2]))


def _read(path: Path) -> dict[str, int]:
    try:
        header, *rows = csv.reader(path.read_text(encoding="utf-8-sig").splitlines())
    except (UnicodeDecodeError, csv.Error) as error:
        raise AnnotationError(
            f"{path}: expected a CSV in UTF-8, got: {error}; save it as CSV UTF-8"
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
                f"{path}:{line}: expected one fish a picture, got another one for {name!r}; "
                "pictures of several fish need --boxes or --masks with ids"
            )
    return found
