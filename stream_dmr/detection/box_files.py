"""Read boxes from MOT, COCO, CVAT and VIAME files, and from folders of YOLO labels.

COCO's JSON (cocodataset.org, "Data format") is read as annotation tools export it. Frames of a
video are those that names of six and more digits say, as `export --masks` writes them, else counted
from 1 in the natural order of the pictures' file names. The track id is `track_id` or
`instance_id`, of the annotation itself or among its `attributes`; boxes without either get
`UNKNOWN_ID`.

CVAT's XML, version 1.1 (docs.cvat.ai, "CVAT"), is read for videos and for pictures. CVAT counts
frames, pictures and tracks from 0, this package from 1. A box inside a video's track gets the
track's id; a box of a single picture gets `UNKNOWN_ID`.

VIAME CSV (github.com/Kitware/dive, `viame.py`) has a row for each box, with frames from 0; a track
0 gets the first free number, all others keep theirs.

YOLO's labels (docs.ultralytics.com, `save_txt`) are a text per frame: `picture.txt`, or of a video
`clip_12.txt` with the frame from 1. A row has shares of the picture: class, centre, width, height,
and with `save_conf` the confidence, with `track` the id. The class is not used.

COCO, CVAT, VIAME and YOLO know pictures of a folder by their names, since they may have another
order.
Polygons and run lengths of COCO and VIAME are the masks of their boxes.
"""

import csv
import json
import math
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from stream_dmr.errors import AnnotationError
from stream_dmr.files import natural_order, read_text
from stream_dmr.pictures import pictures_in
from stream_dmr.segmentation.mask_outlines import (
    Ring,
    decode_coco,
    fill_parts,
    require_size,
    ring_of,
)

UNKNOWN_ID = 0  # `track_id` of a box whose file does not follow fish from frame to frame


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class AnnotatedBox:
    """One fish of one frame, as a boxes file gives it."""

    track_id: int  # 1 or more, or UNKNOWN_ID
    # Half-open, frame pixels; may extend beyond the frame. Shares of the frame's size, see `in_px`.
    bbox_xyxy_px: Float[np.ndarray, "4"]
    visibility: float = 1.0  # visible fraction of the fish, 0 to 1; 1 where not given
    score: float = 1.0  # confidence of the detector, 0 to 1; 1 where not given
    # Makes the mask in a frame of a height and width, or raises AnnotationError; None: not given.
    mask: Callable[[tuple[int, int]], Bool[np.ndarray, "H W"]] | None = None
    # Of VIAME alone: the species or "", and head and tail in px from the picture's corner.
    species: str = ""
    ends_px: Float[np.ndarray, "2 2"] | None = None
    is_relative: bool = False  # of YOLO: the box is in shares of the frame's width and height
    check_size: Callable[[tuple[int, int]], None] | None = None  # as `mask`, of COCO and CVAT

    def in_px(self, width: int, height: int) -> "AnnotatedBox":
        """The box in a frame of a size. AnnotationError if the file means pictures of another."""
        if self.check_size is not None:
            self.check_size((height, width))
        if not self.is_relative:
            return self
        box = self.bbox_xyxy_px * [width, height, width, height]
        return replace(self, bbox_xyxy_px=box, is_relative=False)


def box_from_xywh(
    x: float, y: float, width: float, height: float, *, where: str
) -> Float[np.ndarray, "4"]:
    """Left, top, right, bottom of a box, in px. Raises AnnotationError for an empty one.

    `where` is the place in the file, for the message.
    """
    if not all(map(math.isfinite, (x, y, width, height))) or width <= 0 or height <= 0:
        raise AnnotationError(
            f"{where}: expected a width and height above 0, got {width:g} x {height:g}"
        )
    return np.array([x, y, x + width, y + height])


_MAX_ID = 2**53 - 1  # the last that no other number is rounded to when read as a float


def group_by_frame(boxes: Iterable[tuple[str, int, AnnotatedBox]]) -> dict[int, list[AnnotatedBox]]:
    """Boxes by frame (from 1), within a frame by id.

    Each box comes with its place in the file, for messages, and its frame. Raises AnnotationError
    where a fish has two boxes in a frame, only some boxes have ids, or an id is too large to be
    kept exactly.
    """
    frames: dict[int, list[AnnotatedBox]] = {}
    seen: set[tuple[int, int]] = set()
    has_ids: bool | None = None
    for where, frame_index, box in boxes:
        has_id = box.track_id != UNKNOWN_ID
        if has_ids is not None and has_id != has_ids:
            raise AnnotationError(
                f"{where}: expected ids for all boxes or for none; complete them or leave them out"
            )
        has_ids = has_id
        if box.track_id > _MAX_ID:
            raise AnnotationError(f"{where}: expected an id up to {_MAX_ID}, got {box.track_id}")
        if has_id and (frame_index, box.track_id) in seen:
            raise AnnotationError(
                f"{where}: expected one box per fish and frame, "
                f"got a second one of id {box.track_id} in frame {frame_index}; remove one"
            )
        seen.add((frame_index, box.track_id))
        frames.setdefault(frame_index, []).append(box)
    return {i: sorted(frames[i], key=lambda box: box.track_id) for i in sorted(frames)}


COLUMNS = "frame,id,x,y,w,h,conf,class,visibility"


def parse_mot(text: str, path: Path) -> dict[int, list[AnnotatedBox]]:
    """Boxes by frame (from 1), within a frame by id, from a file's text.

    Columns: frame, id, x, y, w, h, conf and optionally class and visibility; with ten columns the
    last three are MOT15's world coordinates. The class is not used. A visibility of -1 means "not
    given", as everywhere in MOT, and so does an id of -1, in all lines or in none.

    Raises AnnotationError with the line's number and what was expected there.
    """
    lines = enumerate(text.splitlines(), start=1)
    return group_by_frame(_parse_line(one, f"{path}, line {n}") for n, one in lines if one.strip())


def _parse_line(line: str, where: str) -> tuple[str, int, AnnotatedBox]:
    values = _parse_numbers(line, where)
    frame, track_id, x, y, width, height, confidence = values[:7]
    if frame < 1 or frame != int(frame):
        raise AnnotationError(f"{where}: expected a frame number, counted from 1, got {frame:g}")
    if track_id != -1 and (track_id < 1 or track_id != int(track_id)):
        raise AnnotationError(
            f"{where}: expected an id of 1 or more that follows one fish, "
            f"or -1 in every line for detections, got {track_id:g}"
        )
    bbox = box_from_xywh(x, y, width, height, where=where)
    visibility = values[8] if len(values) == 9 else -1.0
    if visibility != -1 and not 0 <= visibility <= 1:
        raise AnnotationError(f"{where}: expected a visibility from 0 to 1, got {visibility:g}")
    box = AnnotatedBox(
        track_id=UNKNOWN_ID if track_id == -1 else int(track_id),
        bbox_xyxy_px=bbox,
        visibility=1.0 if visibility == -1 else visibility,
        score=confidence if 0 <= confidence <= 1 else 1.0,
    )
    return where, int(frame), box


def _parse_numbers(line: str, where: str) -> list[float]:
    try:
        values = [float(column) for column in line.split(",")]
    except ValueError:
        values = []
    if not 7 <= len(values) <= 10 or not all(map(math.isfinite, values)):
        raise AnnotationError(
            f"{where}: expected numbers {COLUMNS}, separated by commas, got {line.strip()[:60]!r}"
        )
    return values


def frames_by_name(
    names: Mapping[int, str], pictures: Sequence[Path], *, where: Path
) -> dict[int, int]:
    """The frames of named pictures by their keys in `names`; none where no name is known.

    `pictures` of the source, in its order; empty of a video. A picture is known by its file name,
    else by that without its suffix. One that the source does not have gets a frame past its end.
    Raises AnnotationError, about `where`, where two names are one picture.
    """
    stems = Counter(path.stem for path in pictures)
    frames = {path.stem: i for i, path in enumerate(pictures, start=1) if stems[path.stem] == 1}
    frames |= {path.name: i for i, path in enumerate(pictures, start=1)}
    files = {key: Path(re.split(r"[\\/]", name)[-1]) for key, name in names.items()}
    found = {key: frames.get(file.name, frames.get(file.stem, 0)) for key, file in files.items()}
    if not any(found.values()):
        return {}
    keys = dict[int, int]()
    for key, frame in found.items():
        if frame and keys.setdefault(frame, key) != key:
            raise AnnotationError(
                f"{where}: expected each picture of the source once, got {names[keys[frame]]} and "
                f"{names[key]}; give the boxes of this folder alone"
            )
    past_end = iter(range(len(pictures) + 1, len(pictures) + len(found) + 1))
    return {key: frame or next(past_end) for key, frame in found.items()}


_NUMBER = re.compile(r"[0-9]{6,}")  # of a frame, as masks are named
_ID_NAMES = ("track_id", "instance_id")
_BOX_LENGTH = 10  # of a polygon's list that is no more than a box, first corner repeated or not
_TOO_LARGE = (OverflowError, RecursionError)  # an infinite number; deeply nested brackets


def parse_coco(
    text: str, path: Path, pictures: Sequence[Path] = ()
) -> dict[int, list[AnnotatedBox]]:
    """A `Parser`."""
    try:
        table = json.loads(text)
        images = {int(image["id"]): image for image in table["images"]}
        names = {number: str(image["file_name"]) for number, image in images.items()}
        annotations = list(table["annotations"])
    except (ValueError, KeyError, TypeError, AttributeError, *_TOO_LARGE) as error:
        raise AnnotationError(
            f'{path}: expected COCO\'s JSON with "images" (id, file_name) and "annotations", '
            f"got: {type(error).__name__} {error}"
        ) from None
    frames = _frames_of(names, pictures, path)
    return group_by_frame(_annotation_boxes(annotations, images, frames, path))


def _frames_of(names: dict[int, str], pictures: Sequence[Path], path: Path) -> dict[int, int]:
    """The frame of each image by its id."""
    if known := frames_by_name(names, pictures, where=path):
        return known
    order = sorted(names, key=lambda image_id: natural_order(Path(names[image_id])))
    if pictures and len(pictures) != len(names):
        raise AnnotationError(
            f"{path}: expected images named like the {len(pictures)} pictures of the source, got "
            f"{len(names)} of other names, such as {names[order[0]] if order else 'none'}; correct "
            "the names"
        )
    stems = {image_id: Path(name).stem for image_id, name in names.items()}
    if all(_NUMBER.fullmatch(stem) and int(stem) for stem in stems.values()):
        return {image_id: int(stem) for image_id, stem in stems.items()}
    return {image_id: number for number, image_id in enumerate(order, start=1)}


def _annotation_boxes(
    annotations: list[Any], images: dict[int, Any], frames: dict[int, int], path: Path
) -> Iterator[tuple[str, int, AnnotatedBox]]:
    for number, annotation in enumerate(annotations, start=1):
        where = f"{path}, annotation {number}"
        try:
            image_id = int(annotation["image_id"])
            frame_index = frames[image_id]
            x, y, width, height = (float(value) for value in annotation["bbox"])
            track_id, drawn = _track_id(annotation), annotation.get("segmentation")
            is_outline = bool(drawn) and (len(drawn) > 1 or len(drawn[0]) > _BOX_LENGTH)
            score = float(annotation.get("score", 1.0))
        except (ValueError, KeyError, TypeError, AttributeError, *_TOO_LARGE):
            raise AnnotationError(
                f"{where}: expected the image_id of one of the images and a bbox of x, y, width, "
                f"height, got {str(annotation)[:80]}"
            ) from None
        box = AnnotatedBox(
            track_id=track_id,
            bbox_xyxy_px=box_from_xywh(x, y, width, height, where=where),
            score=score,
            mask=partial(decode_coco, segmentation=drawn, where=where) if is_outline else None,
            check_size=partial(require_size, images[image_id], where=where),
        )
        yield where, frame_index, box


def _track_id(annotation: dict[str, Any]) -> int:
    """The annotation's track id; UNKNOWN_ID where it has none."""
    for place in (annotation, annotation.get("attributes") or {}):
        for name in _ID_NAMES:
            if place.get(name) is not None:
                track_id = int(place[name])
                if track_id < 1:
                    raise ValueError(f"{name} {track_id}")
                return track_id
    return UNKNOWN_ID


def parse_cvat(
    text: str, path: Path, pictures: Sequence[Path] = ()
) -> dict[int, list[AnnotatedBox]]:
    """A `Parser`."""
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise AnnotationError(f"{path}: expected CVAT's XML, got: {error}") from None
    if root.tag != "annotations":
        raise AnnotationError(f"{path}: expected CVAT's <annotations>, got <{root.tag}>")
    return group_by_frame(_track_boxes(root, path, pictures))


def _track_boxes(
    root: ET.Element, path: Path, pictures: Sequence[Path]
) -> Iterator[tuple[str, int, AnnotatedBox]]:
    size = root.find("meta//original_size")  # of a video
    video = {} if size is None else {side.tag: side.text or "" for side in size}
    for track in root.iter("track"):
        for box in track.iter("box"):
            where = f"{path}, track {track.get('id')}, frame {box.get('frame')}"
            if box.get("outside") != "1":
                yield _box(box, box.get("frame"), track.get("id"), video, where)
    images = [*root.iter("image")]
    names = {number: image.get("name", "") for number, image in enumerate(images)}
    frames = frames_by_name(names, pictures, where=path)
    for number, image in enumerate(images):
        where = f"{path}, image {image.get('id')}"
        frame = str(frames[number] - 1) if frames else image.get("id")
        for box in image.iter("box"):
            yield _box(box, frame, None, image.attrib, where)


def _box(
    element: ET.Element,
    frame: str | None,
    track: str | None,
    picture: Mapping[str, str],
    where: str,
) -> tuple[str, int, AnnotatedBox]:
    """`picture` may have its width and height."""
    try:
        x0, y0, x1, y1 = (float(element.attrib[name]) for name in ("xtl", "ytl", "xbr", "ybr"))
        frame_index = int(frame or "") + 1
        track_id = UNKNOWN_ID if track is None else int(track) + 1
    except (KeyError, ValueError):
        raise AnnotationError(
            f"{where}: expected a frame's number and a box with xtl, ytl, xbr, ybr, "
            f"got {element.attrib}"
        ) from None
    size = {name: int(text) for name, text in picture.items() if text.isdecimal()}
    box = AnnotatedBox(
        track_id=track_id,
        bbox_xyxy_px=box_from_xywh(x0, y0, x1 - x0, y1 - y0, where=where),
        check_size=partial(require_size, size, where=where),
    )
    return where, frame_index, box


_VIAME_HEAD = "# 1: Detection or Track-id"
_POLYGON = re.compile(r"\((poly|hole)\)(.*)", re.DOTALL)
_END = re.compile(r"\(kp\) (head|tail) (\S+) (\S+)")


def parse_viame(
    text: str, path: Path, pictures: Sequence[Path] = ()
) -> dict[int, list[AnnotatedBox]]:
    """A `Parser`."""
    lines = csv.reader(text.splitlines())
    try:
        rows = [
            (f"{path}, line {lines.line_num}", cells)
            for cells in lines
            if cells and not cells[0].lstrip().startswith("#")
        ]
    except csv.Error as error:  # a cell of more than 128 KiB
        where = f"{path}, line {lines.line_num}"
        raise AnnotationError(f"{where}: expected a row of VIAME CSV, got: {error}") from None
    names = dict(enumerate(dict.fromkeys(cells[1] for _, cells in rows if len(cells) > 1)))
    by_key = frames_by_name(names, pictures, where=path)
    frames = {name: by_key[key] for key, name in names.items()} if by_key else {}
    boxes = [_viame_box(cells, frames, where) for where, cells in rows]
    free = max((box.track_id for _, _, box in boxes), default=0) + 1
    return group_by_frame(
        (where, frame, replace(box, track_id=box.track_id or free)) for where, frame, box in boxes
    )


def _viame_box(
    cells: list[str], frames: Mapping[str, int], where: str
) -> tuple[str, int, AnnotatedBox]:
    parts, ends = list[list[Ring]](), dict[str, list[float]]()
    try:
        track_id, frame = int(cells[0]), int(cells[2])
        x0, y0, x1, y1, score = map(float, cells[3:8])
        for kind, numbers in (one.groups() for one in map(_POLYGON.match, cells[9:]) if one):
            ring = ring_of(numbers.split(), where=where)
            if kind == "poly":
                parts.append([ring])
            else:
                parts[-1].append(ring)
        for name, *point in (one.groups() for one in map(_END.match, cells[9:]) if one):
            ends[name] = [*map(float, point)]
        if track_id < 0 or frame < 0 or any(len(ring) < 3 for part in parts for ring in part):
            raise ValueError
    except (ValueError, IndexError):
        raise AnnotationError(
            f"{where}: expected VIAME's track, picture, frame from 0, box of four numbers, "
            "confidence, length, and polygons of three points and more, "
            f"got {','.join(cells)[:80]!r}"
        ) from None
    box = AnnotatedBox(
        track_id=track_id,
        bbox_xyxy_px=box_from_xywh(x0, y0, x1 - x0, y1 - y0, where=where),
        score=score if 0 <= score <= 1 else 1.0,
        mask=partial(fill_parts, parts=parts) if parts else None,
        species="" if cells[9:10] == [] or cells[9].startswith("(") else cells[9].strip(),
        ends_px=np.array([ends["head"], ends["tail"]]) if len(ends) == 2 else None,
    )
    return where, frames.get(cells[1], frame + 1), box


def _read_yolo(folder: Path, pictures: Sequence[Path]) -> dict[int, list[AnnotatedBox]]:
    """Boxes by frame. Raises AnnotationError with what was expected, and where."""
    files = sorted(folder.glob("*.txt"), key=natural_order)
    files = [path for path in files if path.name != "classes.txt"]
    if not files or pictures_in(folder):
        raise AnnotationError(
            f"{folder}: expected a folder of YOLO labels alone, a .txt per frame, got "
            f"{'pictures beside them' if files else 'none'}"
        )
    frames = frames_by_name({n: path.name for n, path in enumerate(files)}, pictures, where=folder)
    if not (frames or pictures):
        numbers = (re.search(r"[0-9]+$", path.stem) for path in files)
        frames = {n: int(found[0]) for n, found in enumerate(numbers) if found and int(found[0])}
    if len({*frames.values()}) < len(files):
        raise AnnotationError(
            f"{folder}: expected labels named like the pictures of the source, or each with a "
            f"frame of its own of a video, from 1 (clip_12.txt), got such as {files[0].name}"
        )
    return group_by_frame(
        _label_boxes(
            (f"{path}, line {line}", frames[n], cells.split())
            for n, path in enumerate(files)
            for line, cells in enumerate(_read_text(path).splitlines(), start=1)
            if cells.strip()
        )
    )


def _label_boxes(
    lines: Iterable[tuple[str, int, list[str]]],
) -> Iterator[tuple[str, int, AnnotatedBox]]:
    rows = [*lines]
    try:
        # One more number is a confidence, or where any is above 1 an id.
        is_id = any(len(cells) == 6 and float(cells[5]) > 1 for _, _, cells in rows)
    except ValueError:
        is_id = False  # the row is refused below
    for where, frame, cells in rows:
        try:
            _, x, y, width, height, *more = map(float, cells)
            track_id = more.pop() if len(more) == 2 or (more and is_id) else UNKNOWN_ID
            score = more.pop() if more else 1.0
            is_pixels = max(x, y, width, height) > _MAX_SHARE
            if more or is_pixels or not 0 <= score <= 1 or track_id < 0 or track_id % 1:
                raise ValueError
        except ValueError:
            raise AnnotationError(
                f"{where}: expected class, centre x and y, width and height in shares of the "
                "picture, and perhaps a confidence from 0 to 1 and an id from 1, got "
                f"{' '.join(cells)[:60]!r}"
            ) from None
        box = AnnotatedBox(
            track_id=int(track_id),
            bbox_xyxy_px=box_from_xywh(x - width / 2, y - height / 2, width, height, where=where),
            score=score,
            is_relative=True,
        )
        yield where, frame, box


_MAX_SHARE = 2.0  # chosen: a box may go on beyond the picture, and pixels are larger
_MAX_BYTES = 1 << 29  # chosen: some ten million boxes
Parser = Callable[[str, Path, Sequence[Path]], dict[int, list[AnnotatedBox]]]
"""Boxes by frame, from a file's text, its path for messages, and the source's pictures in order.

A video has none. Raises AnnotationError with what was expected, and where.
"""
_PARSERS: Mapping[str, Parser] = {".json": parse_coco, ".xml": parse_cvat}


def load_boxes(
    path: Path, *, pictures: Path | None = None, parse: Parser | None = None
) -> dict[int, list[AnnotatedBox]]:
    """Boxes by frame (from 1), within a frame by id; none from an empty text file.

    `.json` is read as COCO, `.xml` as CVAT, a file with VIAME's header or named `.viame.csv` as
    VIAME, a folder as YOLO's labels, everything else as MOT Challenge text; all by `parse` if
    given. `pictures`: the source of the frames; where it is a folder, all but MOT name its
    pictures. Raises AnnotationError with the place in the file and what was expected there.
    """
    named = pictures_in(pictures) if pictures is not None and pictures.is_dir() else []
    if path.is_dir():
        return _read_yolo(path, named)
    text, is_viame = _read_text(path), path.name.lower().endswith(".viame.csv")
    if parse is None and (is_viame or text.startswith(_VIAME_HEAD)):
        parse = parse_viame
    parse = parse or _PARSERS.get(path.suffix.lower())
    if parse is None:
        return parse_mot(text, path)
    return parse(text, path, named)


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
        return read_text(path, max_bytes=_MAX_BYTES)
    except UnicodeDecodeError:
        raise AnnotationError(
            f"{path}: expected a text file of boxes ({COLUMNS}), got binary data"
        ) from None
    except OSError as error:
        raise AnnotationError(
            f"{path}: expected a file of boxes, but it can't be read: {error.strerror}"
        ) from None
