"""Boxes of fish from a file, in whichever of three formats it is written."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from stream_dmr.errors import AnnotationError
from stream_dmr.files import read_text
from stream_dmr.pictures import pictures_in
from stream_dmr.segmentation.annotations.annotated_box import AnnotatedBox
from stream_dmr.segmentation.annotations.coco import parse_coco
from stream_dmr.segmentation.annotations.cvat import parse_cvat
from stream_dmr.segmentation.annotations.mot import COLUMNS, parse_mot

_MAX_BYTES = 1 << 29  # chosen: some ten million boxes
_PARSERS = {".json": parse_coco, ".xml": parse_cvat}


def load_boxes(path: Path, *, pictures: Path | None = None) -> dict[int, list[AnnotatedBox]]:
    """Boxes by frame (from 1), within a frame by id; none from an empty text file.

    `.json` is read as COCO, `.xml` as CVAT, everything else as MOT Challenge text. `pictures`: the
    source of the frames; where it is a folder, COCO and CVAT name its pictures. Raises
    AnnotationError with the place in the file and what was expected there.
    """
    text, suffix = _read_text(path), path.suffix.lower()
    if suffix not in _PARSERS:
        return parse_mot(text, path)
    named = pictures_in(pictures) if pictures is not None and pictures.is_dir() else []
    return _PARSERS[suffix](text, path, named)


def unused_boxes(frames: Mapping[int, Sequence[AnnotatedBox]], last_frame: int) -> list[str]:
    """A line where no frame up to the last one had boxes, or some are beyond it."""
    if not any(frames.values()):
        return ["boxes: the file has none, so there are no fish"]
    beyond = sorted(index for index, boxes in frames.items() if boxes and index > last_frame)
    if not beyond:
        return []
    which = "all" if len(beyond) == sum(map(bool, frames.values())) else "some"
    return [
        f"boxes: {which} are past the end of the source, {len(beyond)} frames from {beyond[0]} on, "
        f"and it ended at frame {last_frame}; are they of another video?"
    ]


def _read_text(path: Path) -> str:
    try:
        return read_text(path, encoding="utf-8-sig", max_bytes=_MAX_BYTES)
    except UnicodeDecodeError:
        raise AnnotationError(
            f"{path}: expected a text file of boxes ({COLUMNS}), got binary data"
        ) from None
    except OSError as error:
        raise AnnotationError(
            f"{path}: expected a file of boxes, but it can't be read: {error.strerror}"
        ) from None
