"""Topics and entity paths of every message, and the settings of `[recording]`."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

from pydantic import Field

from stream_dmr.messages import (
    FishCrop,
    FittedMesh,
    Frame,
    LearntShapes,
    LengthEstimate,
    LocalizedFish,
    Message,
    Position,
    TrackEnded,
)
from stream_dmr.settings import Settings


@dataclass(frozen=True, kw_only=True, slots=True)
class Topic:
    """The paths of the messages of one type."""

    message: type[Message]
    topic: str  # in the .mcap
    entities: tuple[str, ...]  # in the .rrd; {id} is the track's

    @property
    def schema(self) -> str:
        """Name of the protobuf message, in `messages.proto`."""
        return f"stream_dmr.{self.message.__name__}"

    @property
    def payload(self) -> str:
        """Entity path of the encoded messages in the .rrd."""
        return f"messages{self.topic}"


# Entity paths in the .rrd.
FRAME, MASKS = "scene/camera/frame", "scene/camera/masks"
BOX, OUTLINE = "scene/camera/fish/{id}/box", "scene/camera/fish/{id}/outline"
MESH = "scene/fish/{id}/mesh"
KEYPOINTS_2D = "scene/camera/fish/{id}/keypoints"
KEYPOINTS_3D, MIDLINE = "scene/fish/{id}/keypoints", "scene/fish/{id}/midline"
FRAME_LENGTH, LENGTH = "length/{id}/frame", "length/{id}/estimate"
IOU, BENDING, FIT_MS = "iou/{id}", "bending/{id}", "fit_ms/{id}"
LOG, REFUSALS, RESULTS = "log", "log/refusals", "log/lengths"
VESSEL, TRACK = "map/vessel", "map/track"  # its present place; its past way, once and static
CAMERA, PLANE = "scene/camera", "scene/plane"  # static, from the header
SECOND_SCENE = "scene/second"  # view of the second camera in a recording of two
FISH_ROOTS = ("scene/camera/fish", "scene/fish")  # cleared by every new frame
END = "messages/end"  # the last row of a whole .rrd: how many messages each payload path has
# Metadata records of an .mcap: of the run; of one of several segments, with its `number`; of a file
# that was repaired after a crash; of a file whose pictures and masks were removed to free space.
RUN, SEGMENT, RECOVERED, THINNED = "run", "segment", "recovered", "thinned"
SPANS = "tracks.json"  # attachment of a whole .mcap: each track's first and last capture time, ns
KEY_FRAME_NS = 1_000_000_000  # capture time between key frames: a reader seeks back one second
VIDEO = "/video"  # in the .mcap with frames = "h264": foxglove.CompressedVideo

MessageTypes = Collection[type[Message]]
Topics = Mapping[type[Message], Topic]
TOPICS: Topics = {
    # A message without a row below has the name of its class as topic, and is not drawn.
    kind: Topic(message=kind, topic=f"/{kind.__name__.lower()}", entities=())
    for kind in get_args(Message)
} | {
    row.message: row
    for row in (
        Topic(message=Frame, topic="/frame", entities=(FRAME,)),
        Topic(message=FishCrop, topic="/crop", entities=(MASKS, OUTLINE)),
        Topic(message=FittedMesh, topic="/fit", entities=(MESH, IOU, FIT_MS)),
        Topic(
            message=LocalizedFish,
            topic="/localized",
            entities=(BOX, KEYPOINTS_2D, KEYPOINTS_3D, MIDLINE, FRAME_LENGTH, BENDING),
        ),
        Topic(message=TrackEnded, topic="/ended", entities=()),
        Topic(message=LengthEstimate, topic="/length", entities=(LENGTH, REFUSALS, RESULTS)),
        Topic(message=Position, topic="/position", entities=(VESSEL,)),
        Topic(message=LearntShapes, topic="/shapes", entities=()),
    )
}

SECOND_TOPICS: Topics = {
    kind: replace(TOPICS[kind], topic=f"/second{TOPICS[kind].topic}")
    for kind in (Frame, FishCrop, FittedMesh, LocalizedFish)
}
"""Topics of the second camera's messages in a recording of two cameras."""

CARRIED_OVER = "/carried/localized"
"""In a segment: the LocalizedFish from before it of the tracks that were open when it began."""

FOXGLOVE_TOPICS = {
    "/foxglove/picture": "foxglove.CompressedImage",
    "/foxglove/camera": "foxglove.CameraCalibration",
    "/foxglove/plane": "foxglove.FrameTransform",
    "/foxglove/fish": "foxglove.SceneUpdate",
    "/foxglove/outlines": "foxglove.ImageAnnotations",
    "/foxglove/keypoints": "foxglove.ImageAnnotations",
    "/foxglove/position": "foxglove.LocationFix",
}
"""Topic -> schema, in the .mcap with `foxglove = true`."""


class RecordingSettings(Settings):
    """What is recorded, and how exactly. `docs/files.md` explains what each choice keeps."""

    mcap: bool = Field(default=True, description="write recording.mcap, the record of truth")
    rrd: bool = Field(default=True, description="write recording.rrd, the view for Rerun")
    rrd_messages: bool = Field(
        default=True,
        description="put the messages into the .rrd too, so that it can be replayed alone",
    )
    frames: Literal["reference", "jpeg", "h264"] = Field(
        default="reference",
        description='the source\'s pictures: "reference" (number and checksum), "jpeg", '
        '"h264" (small, for the eye)',
    )
    crops: Literal["few", "none", "jpeg", "png"] = Field(
        default="few",
        description='pictures of the crops beside their masks: "few" (of each fish of a camera '
        'whose frames are not kept), "none", "jpeg", "png" (exact)',
    )
    meshes: Literal["parameters", "vertices"] = Field(
        default="parameters",
        description='of each fit: its "parameters", or "vertices" and covariance as well',
    )
    jpeg_quality: int = Field(
        default=85, ge=1, le=100, description="quality of every JPEG, 1 to 100 (no unit)"
    )
    h264_crf: int = Field(
        default=25, ge=0, le=51, description="coarseness of H.264 pictures, x264's CRF (no unit)"
    )
    view_rate_hz: float = Field(
        default=6.0,
        gt=0,
        le=1000,
        description="pictures and meshes drawn into the .rrd per second; plots have every frame",
    )
    view_px: int = Field(
        default=960,
        ge=64,
        description="pictures in the .rrd are halved until no side is longer, px",
    )
    foxglove: bool = Field(
        default=False,
        description="also write topics for Foxglove Studio into the .mcap, as often as the .rrd's",
    )
    flush_s: float = Field(
        default=0.5,
        gt=0,
        le=60,
        description="longest time that data wait for the disk, s: what a crash may lose; those of "
        "the .rrd four times as long",
    )
    segment_s: float = Field(
        default=60.0, ge=2, description="duration of one recording file of a live source, s"
    )
    segment_mb: float = Field(
        default=512.0, ge=1, description="largest .mcap of one recording file of a live source, MB"
    )
    keep_free_gb: float = Field(
        default=2.0,
        ge=0,
        description="free space below which the oldest of these files are deleted, GB; 0: never",
    )

    @property
    def keeps_pictures(self) -> bool:
        """True if the recording has the frames' pictures, beside those of the .rrd."""
        return self.frames != "reference" or self.foxglove

    @property
    def keeps_crops(self) -> bool:
        return self.crops in ("jpeg", "png")

    def keeps_photographs(self, *, is_live: bool) -> bool:
        """True if some crops of each fish are the only pictures that will be left of it."""
        return is_live and self.crops == "few" and self.frames == "reference"
