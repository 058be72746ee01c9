"""Lengths of hooked, bent fish from one calibrated camera.

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

__version__ = "0.1.0"
