"""A user's detector from an ONNX file, run by onnxruntime on the CPU.

It is tried on three pictures before the first frame, so that an unusable model is refused at once
and not in the middle of a run.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field

from stream_dmr.errors import ModelError
from stream_dmr.messages import Frame
from stream_dmr.segmentation.detection.detector import Candidate
from stream_dmr.segmentation.detection.letterbox import Letterbox
from stream_dmr.segmentation.detection.onnx_outputs import (
    NUM_OUTPUTS,
    Layout,
    OutputShapeError,
    decode,
)
from stream_dmr.segmentation.network.onnx_session import open_session
from stream_dmr.settings import Settings

_MIN_INPUT_PX = 32  # the stride of the usual detectors
_SCORE_TOLERANCE = 1e-3  # rounding may put a score of 1 above 1
_IMAGENET_MEAN = np.array([0.485, 0.456, 0.406], np.float32)  # RGB
_IMAGENET_STD = np.array([0.229, 0.224, 0.225], np.float32)


class OnnxSettings(Settings):
    """The part of `[detect_fish]` that a detector from an ONNX file reads."""

    onnx_layout: Layout = Field(
        default="yolo",
        description="output format of the model; docs/models.md has the shapes",
    )
    onnx_input_px: int = Field(
        default=640,
        ge=_MIN_INPUT_PX,
        le=4096,
        description="input side of a model of any size, px",
    )
    onnx_imagenet: bool = Field(
        default=False, description="input by ImageNet's mean and std, as DETR wants; else 0 to 1"
    )
    onnx_classes: list[Annotated[int, Field(ge=0)]] = Field(
        default=[], description="the model's classes that are fish, counted from 0; empty: all"
    )
    onnx_overlap: float = Field(
        default=0.6, ge=0, le=1, description="boxes with a higher IoU are one fish"
    )


class OnnxDetector:
    """A `Detector` of boxes and scores, without silhouettes."""

    def __init__(
        self,
        path: Path,
        settings: OnnxSettings,
        *,
        min_score: float = _SCORE_TOLERANCE,
        threads: int = 2,  # users' models may be large
    ) -> None:
        """`min_score`: of the boxes that are found. Raises ModelError for no usable detector."""
        self._path, self._settings, self._min_score = path, settings, min_score
        self._session = open_session(path, threads=threads)
        self._input_name, self._input_size = self._read_input()
        if len(self._session.get_outputs()) != NUM_OUTPUTS[settings.onnx_layout]:
            raise self._refusal(
                f"{NUM_OUTPUTS[settings.onnx_layout]} outputs",
                f"{len(self._session.get_outputs())}",
                remedy="set [detect_fish] onnx_layout to what the model was exported as",
            )
        width, height = self._input_size
        noise = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
        for picture in (noise, np.zeros_like(noise), np.full_like(noise, 255)):
            self._try(picture)

    @property
    def refused(self) -> Mapping[str, int]:
        """Empty: what was not found is not known."""
        return {}

    def find(self, frame: Frame) -> list[Candidate]:
        """The boxes of a frame after non-maximum suppression."""
        height, width = frame.image.shape[:2]
        letterbox = Letterbox.from_sizes(frame_size=(width, height), input_size=self._input_size)
        boxes, scores = self._run(letterbox.apply(frame.image))
        boxes = letterbox.to_frame(boxes).clip(0, [width, height, width, height])
        sides = boxes[:, 2:] - boxes[:, :2]
        usable = np.isfinite(boxes).all(axis=1) & (sides >= 1).all(axis=1)
        usable &= scores >= self._min_score  # not NaN
        boxes, scores = boxes[usable], scores[usable]
        kept = cv2.dnn.NMSBoxes(
            np.column_stack([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]]).tolist(),
            scores.tolist(),
            self._min_score,
            self._settings.onnx_overlap,
        )
        return [
            Candidate(bbox_xyxy_px=boxes[i], score=float(min(scores[i], 1.0)))
            for i in np.array(kept, int).ravel()
        ]

    def _read_input(self) -> tuple[str, tuple[int, int]]:
        """Name, and width and height, of the model's image input."""
        inputs = self._session.get_inputs()
        shape = inputs[0].shape if inputs else []
        takes_pictures = (
            len(inputs) == 1
            and inputs[0].type == "tensor(float)"
            and len(shape) == 4
            and (shape[0] == 1 or not isinstance(shape[0], int))
            and shape[1] == 3
        )
        side = self._settings.onnx_input_px
        sides = [n if isinstance(n, int) else side for n in shape[2:]]
        if not takes_pictures or min(sides) < _MIN_INPUT_PX:
            got = ", ".join(f"{i.name} {i.type} {i.shape}" for i in inputs) or "none"
            raise self._refusal("one float input of shape (1, 3, height, width)", got)
        return inputs[0].name, (sides[1], sides[0])

    def _run(
        self, picture: UInt8[np.ndarray, "h w 3"]
    ) -> tuple[Float[np.ndarray, "N 4"], Float[np.ndarray, "N"]]:
        """Boxes x0, y0, x1, y1 in input pixels, and the best score of any fish class."""
        values = picture[..., ::-1].astype(np.float32) / 255
        if self._settings.onnx_imagenet:
            values = (values - _IMAGENET_MEAN) / _IMAGENET_STD
        blob = np.ascontiguousarray(values.transpose(2, 0, 1)[None])
        outputs = self._session.run(None, {self._input_name: blob})
        boxes, scores = decode(outputs, self._settings.onnx_layout, input_size=self._input_size)
        return boxes, self._fish_scores(scores).max(axis=1, initial=0.0)

    def _fish_scores(self, scores: Float[np.ndarray, "N C"]) -> Float[np.ndarray, "N F"]:
        """The scores of the classes that `onnx_classes` names."""
        classes = self._settings.onnx_classes
        if not classes:
            return scores
        if self._settings.onnx_layout == "yolo-nms":  # has as many columns as classes were found
            classes = [c for c in classes if c < scores.shape[1]]
        elif max(classes) >= scores.shape[1]:
            raise OutputShapeError(f"with class {max(classes)}, which onnx_classes names")
        return scores[:, classes]

    def _try(self, picture: UInt8[np.ndarray, "h w 3"]) -> None:
        """Raise ModelError where the model fails on a picture or gives impossible outputs."""
        layout = self._settings.onnx_layout
        try:
            boxes, scores = self._run(picture)
        except OutputShapeError as error:
            shapes = ", ".join(str(tuple(o.shape)) for o in self._session.get_outputs())
            raise self._refusal(
                f'outputs of [detect_fish] onnx_layout = "{layout}", {error}', shapes
            ) from None
        except Exception as error:  # onnxruntime's errors share no base class
            raise self._refusal(
                f"a model that takes a picture of {self._input_size[0]}x{self._input_size[1]} px",
                f"{error}".strip().splitlines()[0][:120],
                remedy="set [detect_fish] onnx_input_px",
            ) from None
        if not (np.isfinite(boxes).all() and np.isfinite(scores).all()):
            raise self._refusal("finite boxes and scores", "NaN or infinity", remedy="export again")
        if (
            len(scores)
            and not -_SCORE_TOLERANCE <= scores.min() <= scores.max() <= 1 + _SCORE_TOLERANCE
        ):
            raise self._refusal("scores from 0 to 1", f"{scores.min():.3g} to {scores.max():.3g}")

    def _refusal(self, expected: str, got: str, *, remedy: str = "") -> ModelError:
        remedy = remedy or "export it again, or set [detect_fish] onnx_layout"
        return ModelError(f"{self._path}: expected {expected}, got {got}; {remedy}")
