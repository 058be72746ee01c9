"""How a recording opens in Rerun: layout, colours, camera and reference plane."""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float, Int

from stream_dmr.camera import Calibration, Camera
from stream_dmr.recording import topics
from stream_dmr.recording.header import RunHeader
from stream_dmr.recording.topics import CAMERA, LOG, PLANE
from stream_dmr.recording.view_geometry import color

_GRID_MM = 100.0
_GREY = (150, 160, 170, 90)
# Depths, points of view and opacity are chosen by eye.
_PICTURE_DEPTH = 0.25  # of the picture before the camera, as a share of the fish's depth
NOMINAL_DEPTH = 2.5  # body lengths, without calibration: the fish fills half the picture
RUN = "run"
_THIN = rr.Radius.ui_points(1.2)
_DOTS = rr.Radius.ui_points([5.5, 3.5, 3.5])  # head, center, tail: the large one is the head
_WHITE = (255, 255, 255)
# Eye and target of the 3D views, in units of the fish's depth: near the fish, near a fish without a
# calibration, and from behind the camera.
_NEAR = np.array([[0.42, -0.18, 0.5], [0.0, 0.0, 0.92]])
_RELATIVE = np.array([[0.35, -0.2, 0.0], [0.0, 0.0, 1.0]])
_FAR = np.array([[0.7, -0.4, -0.05], [0.0, -0.02, 0.85]])
PICTURES = {
    topics.FRAME: rr.EncodedImage.from_fields(media_type="image/jpeg"),
    topics.MASKS: rr.EncodedImage.from_fields(media_type="image/png", opacity=0.35, draw_order=1.0),
}
_LOG_COLUMNS = rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])
_MESH_OPACITY = 150  # of 255, so that the midline shows through


def appearance(track_id: int, faces: Int[np.ndarray, "F 3"]) -> dict[str, rr.AsComponents]:
    """The static components of a track, by entity path with `{id}` left open."""
    tint, name = color(track_id), f"fish {track_id}"
    lines = rr.SeriesLines(
        names=[name, f"{name} low", f"{name} high"],
        colors=[tint, (*tint, 110), (*tint, 110)],
        widths=[2.5, 1.0, 1.0],
    )
    curve = rr.SeriesLines(names=name, colors=tint)
    return {
        topics.BOX: rr.Boxes2D.from_fields(colors=[tint], radii=rr.Radius.ui_points(0.6)),
        topics.OUTLINE: rr.LineStrips2D.from_fields(colors=[tint], radii=_THIN),
        topics.KEYPOINTS_2D: rr.Points2D.from_fields(colors=[_WHITE], radii=_DOTS),
        topics.MESH: rr.Mesh3D.from_fields(
            triangle_indices=faces, albedo_factor=(*tint, _MESH_OPACITY)
        ),
        topics.KEYPOINTS_3D: rr.Points3D.from_fields(colors=[_WHITE], radii=_DOTS),
        topics.MIDLINE: rr.LineStrips3D.from_fields(colors=[_WHITE], radii=_THIN),
        topics.LENGTH: lines,
        topics.FRAME_LENGTH: rr.SeriesPoints(names=f"{name}, frame", colors=tint, marker_sizes=2.0),
        **dict.fromkeys((topics.IOU, topics.BENDING, topics.FIT_MS), curve),
    }


class Layout(rrb.Blueprint):
    """A layout that can end the stream that Rerun writes it to, which holds itself else.

    That would be two threads and some 8 MB for each video or segment.
    """

    _stream: rr.RecordingStream | None = None

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        super()._log_to_stream(stream)

    def end(self) -> None:
        """Call it when the layout has been sent."""
        if self._stream is not None:
            self._stream.disconnect()
            self._stream = None


def blueprint(header: RunHeader) -> Layout:
    """The layout: frame and 3D scene above; length, IoU and the log of events below.

    Without a calibration there are no lengths, so the bending ratio takes their place. With
    positions there is a map; its ground needs the internet.
    """
    calibration = header.calibration
    has_positions = header.inputs is not None and header.inputs.nmea is not None
    maps = [rrb.MapView(origin="map", name="Map")] if has_positions else []
    second = f"{topics.SECOND_SCENE}/camera"
    seconds = [] if header.second is None else [rrb.Spatial2DView(origin=second, name="Second")]
    return Layout(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial2DView(origin=CAMERA, name="Frame: masks, outlines, keypoints"),
                *seconds,
                rrb.Tabs(
                    _scene_view(calibration, "Fish", _RELATIVE if calibration is None else _NEAR),
                    _scene_view(calibration, "Whole scene", _FAR),
                ),
            ),
            rrb.Horizontal(
                _series("bending", "Bending ratio")
                if calibration is None
                else _series("length", "Length, its 95 % band, and single frames, mm"),
                rrb.Vertical(
                    _series("iou", "Silhouette IoU", axis_y=rrb.ScalarAxis(range=(0.5, 1.0))),
                    _series("fit_ms", "Time of a fit, ms", axis_y=rrb.ScalarAxis(range=(0, 100))),
                ),
                rrb.Tabs(
                    *maps,
                    rrb.TextLogView(origin=LOG, name="Refusals and lengths", columns=_LOG_COLUMNS),
                    rrb.TextDocumentView(origin=RUN, name="Run"),
                ),
            ),
            row_shares=[3, 2],
        ),
        rrb.TimePanel(timeline="frame", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _series(origin: str, name: str, *, axis_y: rrb.ScalarAxis | None = None) -> rrb.TimeSeriesView:
    legend = rrb.PlotLegend(visible=False)  # it hides the lines; hovering names them
    return rrb.TimeSeriesView(origin=origin, name=name, axis_y=axis_y, plot_legend=legend)


def _scene_view(
    calibration: Calibration | None, name: str, eye: Float[np.ndarray, "2 3"]
) -> rrb.Spatial3DView:
    """`eye` is the eye's position and target, in units of the fish's depth."""
    depth = NOMINAL_DEPTH if calibration is None else middle_mm(calibration)[2]
    unit = "relative" if calibration is None else "mm"
    return rrb.Spatial3DView(
        origin="scene",
        contents=[
            "scene/**",
            *("- scene/camera/fish/**", f"- {topics.MASKS}"),
            *(f"- {topics.SECOND_SCENE}/camera/{part}" for part in ("fish/**", "masks")),
        ],
        name=f"{name} (camera frame, {unit})",
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            position=depth * eye[0], look_target=depth * eye[1], eye_up=(0.0, -1.0, 0.0)
        ),
    )


def log_camera(
    rec: rr.RecordingStream, camera: Camera, place: str, *, depth: float, factor: int
) -> None:
    """Log the camera, static, for fish at a depth of some `depth` (mm, or body lengths).

    `factor` is the number of frame pixels per pixel of the shown picture.
    """
    # Rerun's origin is the corner of the top-left pixel, ours its centre.
    shift = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    pinhole = rr.Pinhole(
        image_from_camera=np.diag([1 / factor, 1 / factor, 1.0]) @ shift @ camera.K,
        resolution=(camera.width / factor, camera.height / factor),
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=_PICTURE_DEPTH * depth,
    )
    rec.log(place, pinhole, static=True)


def log_plane(rec: rr.RecordingStream, calibration: Calibration) -> None:
    """Log the reference plane, static, as a grid of 100 mm or a multiple of it."""
    middle, camera, plane = middle_mm(calibration), calibration.camera, calibration.plane
    half = 0.6 * middle[2] * max(camera.width / camera.K[0, 0], camera.height / camera.K[1, 1])
    lines = _grid(plane.rotation.T @ (middle - plane.translation_mm), half)
    strips = lines @ plane.rotation.T + plane.translation_mm
    grid = rr.LineStrips3D(strips, colors=[_GREY], radii=rr.Radius.ui_points(0.7))
    rec.log(PLANE, grid, static=True)


def middle_mm(calibration: Calibration) -> Float[np.ndarray, "3"]:
    """Where the camera's axis meets the plane, mm; the plane's origin if it doesn't."""
    ray = np.array([[0.0, 0.0, 1.0]])
    depth = calibration.plane.depth_mm(ray)[0]
    if np.isfinite(depth) and depth > 0:
        return ray[0] * depth
    return calibration.plane.translation_mm


def _grid(middle: Float[np.ndarray, "3"], half: float) -> Float[np.ndarray, "L 2 3"]:
    """Start and end of the lines of a square grid at world Z = 0, on multiples of its spacing."""
    # At most 40 lines in each direction.
    spacing = _GRID_MM * max(1.0, np.ceil(half / _GRID_MM / 20))
    count = int(np.ceil(half / spacing))
    center = np.round(middle[:2] / spacing) * spacing
    offsets = np.arange(-count, count + 1) * spacing
    ends = np.array([-count, count]) * spacing
    along, across = np.meshgrid(offsets, ends, indexing="ij")
    vertical = np.stack([along, across, np.zeros_like(along)], axis=-1)
    lines = np.concatenate([vertical, vertical[..., [1, 0, 2]]])
    return lines + np.array([*center, 0.0])
