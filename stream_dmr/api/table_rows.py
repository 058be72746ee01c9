"""The rows of lengths.csv and frames.csv as typed values."""

import csv
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TypeVar, get_type_hints

from stream_dmr.errors import UserError


@dataclass(frozen=True, kw_only=True, slots=True)
class FishRow:
    """One fish: a row of lengths.csv. `pandas.DataFrame(run.fish)` makes a table of many."""

    track_id: int
    length_mm: float | None  # snout to tail along the midline; None: not measured, see `status`
    length_std_mm: float | None
    ci95_low_mm: float | None
    ci95_high_mm: float | None
    frames_seen: int
    frames_used: int  # that passed every gate
    first_frame: int  # from 1
    last_frame: int
    first_time: float  # capture time in s: from the start of a file, for cameras since 1970
    last_time: float
    status: str  # "measured", else why there is no length


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameRow:
    """One fish in one frame: a row of frames.csv. None where there is no value."""

    frame_index: int  # from 1
    timestamp_ns: int  # capture time
    track_id: int
    head_u: float | None  # keypoints in frame pixels, centre of the top-left pixel at (0, 0)
    head_v: float | None
    center_u: float | None
    center_v: float | None
    tail_u: float | None
    tail_v: float | None
    head_x_mm: float | None  # keypoints in the camera frame: x right, y down, z forward
    head_y_mm: float | None
    head_z_mm: float | None
    center_x_mm: float | None
    center_y_mm: float | None
    center_z_mm: float | None
    tail_x_mm: float | None
    tail_y_mm: float | None
    tail_z_mm: float | None
    bending_ratio: float | None  # arc over chord, eq. (13)
    length_mm: float | None
    length_std_mm: float | None
    iou: float | None  # of the fitted silhouette with the mask
    accepted: bool  # does this frame count towards the length?
    reason: str  # "" when accepted, else why not


Row = TypeVar("Row", FishRow, FrameRow)

_PARSERS: Mapping[object, tuple[Callable[[str], object], str]] = {
    int: (int, "a whole number"),
    float: (float, "a number"),
    float | None: (lambda text: float(text) if text else None, "a number or nothing"),
    bool: ({"true": True, "false": False}.__getitem__, "true or false"),
    str: (str, "text"),
}


def read_rows(path: Path, kind: type[Row]) -> list[Row]:
    """All rows of a table; columns that `kind` does not have are left out.

    UserError where the file can't be read, or a column or a value is not what it should be.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            missing = {field.name for field in fields(kind)} - set(reader.fieldnames or ())
            if missing:
                raise UserError(
                    f"{path}: expected the column {min(missing)}, found {reader.fieldnames}; "
                    "give the folder of a run"
                )
            return [_row(kind, row, f"{path}, line {reader.line_num}") for row in reader]
    except OSError as error:
        raise UserError(
            f"{path}: expected a table of a run, got: {error.strerror}; give the folder of a run"
        ) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path}: expected a table of a run, got: {error}") from error


def _row(kind: type[Row], texts: Mapping[str, str | None], where: str) -> Row:
    values: dict[str, object] = {}
    for name, annotation in get_type_hints(kind).items():
        parse, expected = _PARSERS[annotation]
        try:
            values[name] = parse(texts[name] or "")
        except (ValueError, KeyError) as error:
            raise UserError(
                f"{where}: expected {expected} for {name}, got {texts[name]!r}"
            ) from error
    return kind(**values)  # type: ignore[arg-type]
