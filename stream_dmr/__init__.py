"""Lengths of hooked, bent fish from one calibrated camera.

::

    import stream_dmr as sd

    run = sd.measure("haul.mp4", calibration="calibration.yaml", out="haul")
    for fish in run.fish:  # typed rows; pandas.DataFrame(run.fish) is a table
        print(fish.track_id, fish.length_mm, fish.status)
    for message in sd.open("haul", [sd.LocalizedFish]):  # every stage is recorded
        print(message.frame_index, message.bending_ratio)
    again = sd.replay("haul", first="localize", calibration="new.yaml", out="haul-again")

Conventions, valid everywhere in this package:

Camera frame
    OpenCV's: x right, y down, z forward, in millimetres. The world frame is the reference
    plane's: world Z = 0 is the plane. Transforms are named so that the names cancel:
    ``points_camera = camera_from_world @ points_world``.
Pixels
    (x, y) with the centre of the top-left pixel at (0, 0). An array index is [row, column].
    Boxes are `bbox_xyxy_px`, half-open, in frame pixels.
Frames
    `frame_index` counts from 1, as the boxes and masks files do. `timestamp_ns` is the capture
    time, an integer: since the start of the file for files, since the Unix epoch for live sources.
Template
    Unit: one body length (snout to tail along the midline). x runs from head to tail along the
    midline, y across the broad side of the body, z through its thickness; the center keypoint is
    the origin.
Fits
    `FittedMesh` is in the orientation of the camera at a relative scale: only ratios of its
    coordinates mean anything. `LocalizedFish` is in the camera frame in millimetres.
Suffixes
    `_mm _px _s _ns _rad`; `num_*` for counts, `is_*` for predicates.
"""

import importlib
from typing import TYPE_CHECKING

from stream_dmr.version import __version__

if TYPE_CHECKING:
    from stream_dmr.api import FishRow, FrameRow, RecordedRun, Run, measure, open, replay
    from stream_dmr.errors import UserError
    from stream_dmr.messages import (
        FishCrop,
        FittedMesh,
        Frame,
        LengthEstimate,
        LocalizedFish,
        TrackEnded,
    )
    from stream_dmr.simulation import DEMO_SCENE

__all__ = [
    "DEMO_SCENE",
    "FishCrop",
    "FishRow",
    "FittedMesh",
    "Frame",
    "FrameRow",
    "LengthEstimate",
    "LocalizedFish",
    "RecordedRun",
    "Run",
    "TrackEnded",
    "UserError",
    "__version__",
    "measure",
    "open",
    "replay",
]

_MODULES = {
    **dict.fromkeys(("RecordedRun", "Run", "measure", "open", "replay"), "api"),
    **dict.fromkeys(("FishRow", "FrameRow"), "api"),
    **dict.fromkeys(
        ("FishCrop", "FittedMesh", "Frame", "LengthEstimate", "LocalizedFish", "TrackEnded"),
        "messages",
    ),
    "UserError": "errors",
    "DEMO_SCENE": "simulation",
}


def __getattr__(name: str) -> object:
    """Import a name when it is first used (PEP 562), so that importing the package stays cheap."""
    if name not in _MODULES:
        raise AttributeError(f"module 'stream_dmr' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"stream_dmr.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
