"""What Foxglove Studio draws: pictures, camera, plane, meshes and keypoints in its own schemas."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from stream_dmr.camera import Calibration
from stream_dmr.errors import ConfigError
from stream_dmr.messages import FishCrop, FittedMesh, FittedShape, Frame, LocalizedFish
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.pictures import compress
from stream_dmr.recording.record import Record
from stream_dmr.recording.rerun_geometry import halved, outlines, place, view_factor
from stream_dmr.recording.settings import RecordingSettings
from stream_dmr.recording.showing import Pace, Waiting
from stream_dmr.recording.topics import FoxgloveTopic

try:
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
    from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
    from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
except ImportError as error:
    raise ConfigError(
        "[recording] foxglove = true: expected the package foxglove-schemas-protobuf, found none; "
        "install it with: pip install 'stream-dmr[foxglove]'"
    ) from error
