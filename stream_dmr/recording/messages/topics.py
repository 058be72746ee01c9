"""The one table of what a message is called in each kind of recording."""

from dataclasses import dataclass

from stream_dmr.messages import (
    FishCrop,
    FittedMesh,
    Frame,
    LearntShapes,
    LengthEstimate,
    LocalizedFish,
    Message,
    Position,
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Topic:
    """Where the messages of one type lie."""

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
VESSEL, TRACK = "map/vessel", "map/track"  # where it is; where it has been, once and static
CAMERA, PLANE = "scene/camera", "scene/plane"  # static, from the header
FISH_ROOTS = ("scene/camera/fish", "scene/fish")  # cleared by every new frame
END = "messages/end"  # the last row of a whole .rrd: how many messages each payload path has
# Metadata records of an .mcap: of the run; of one of several segments, with its `number`; of a file
# that was repaired after a crash; of one whose pictures and masks were removed to free disk space.
RUN, SEGMENT, RECOVERED, THINNED = "run", "segment", "recovered", "thinned"
SPANS = "tracks.json"  # attachment of a whole .mcap: each track's first and last capture time, ns
KEY_FRAME_NS = 1_000_000_000  # capture time between key frames: a reader seeks back one second
VIDEO = "/video"  # in the .mcap with frames = "h264": foxglove.CompressedVideo

TOPICS: dict[type[Message], Topic] = {
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
        Topic(message=LengthEstimate, topic="/length", entities=(LENGTH, REFUSALS, RESULTS)),
        Topic(message=Position, topic="/position", entities=(VESSEL,)),
        Topic(message=LearntShapes, topic="/shapes", entities=()),
    )
}


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


def topics_table() -> str:
    """The Markdown tables of topics in `docs/files.md`; `python -m` this module prints them."""
    lines = ["| message | topic (.mcap) | schema | entities (.rrd) |", "|---|---|---|---|"]
    for row in TOPICS.values():
        entities = ", ".join(f"`{path}`" for path in row.entities)
        lines.append(f"| `{row.message.__name__}` | `{row.topic}` | `{row.schema}` | {entities} |")
    lines += ["", "| topic with `foxglove = true` | schema |", "|---|---|"]
    lines += [f"| `{topic}` | `{schema}` |" for topic, schema in FOXGLOVE_TOPICS.items()]
    return "\n".join(lines)


if __name__ == "__main__":
    print(topics_table())
