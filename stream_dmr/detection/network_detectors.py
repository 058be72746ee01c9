"""Candidates by a user's own ONNX detector and by the U-Net.

An ONNX file is run by onnxruntime. It is tried on three pictures before the first frame, so that an
unusable model is refused at once and not in the middle of a run.

The U-Net, which also finds masks, finds fish in the whole frame at low resolution, for cameras and
seas that move so much that no fish stands out by its motion.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from pydantic import Field

from stream_dmr.detection.detector import Candidate
from stream_dmr.detection.onnx_outputs import MASKS, NUM_OUTPUTS, Layout, OutputShapeError, decode
from stream_dmr.errors import ModelError, first_line
from stream_dmr.geometry import components, whole_pixels
from stream_dmr.messages import Frame
from stream_dmr.networks.onnx_session import open_session
from stream_dmr.networks.unet_interface import SIZE_MULTIPLE_PX
from stream_dmr.segmentation.unet_segmenter import UNetSegmenter
from stream_dmr.settings import Settings

_GREY_LEVEL = 114  # of the bars, as the YOLO family is trained


@dataclass(frozen=True, eq=False, kw_only=True)
class Letterbox:
    """Input pixels are frame pixels times `scale` plus `offset`, counted from pixel edges.

    A frame is resized to whole pixels, so its two sides may scale by slightly different factors.
    """

    input_size: tuple[int, int]  # width, height
    resized: tuple[int, int]  # of the frame inside the input; width, height
    offset: Float[np.ndarray, "2"]
    scale: Float[np.ndarray, "2"]

    @classmethod
    def from_sizes(cls, *, frame_size: tuple[int, int], input_size: tuple[int, int]) -> "Letterbox":
        """The largest picture of a frame's proportions, centered in the input; (width, height)."""
        ratio = min(input_size[0] / frame_size[0], input_size[1] / frame_size[1])
        resized = tuple(max(1, round(side * ratio)) for side in frame_size)
        offset = [(inner - side) // 2 for inner, side in zip(input_size, resized, strict=True)]
        return cls(
            input_size=input_size,
            resized=(resized[0], resized[1]),
            offset=np.array(offset, np.float64),
            scale=np.array(resized, np.float64) / np.array(frame_size, np.float64),
        )

    def apply(self, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """The input for a frame: resized, with grey bars."""
        width, height = self.input_size
        x, y = self.offset.astype(int).tolist()
        framed = np.full((height, width, 3), _GREY_LEVEL, np.uint8)
        small = cv2.resize(image, self.resized, interpolation=cv2.INTER_LINEAR)
        framed[y : y + self.resized[1], x : x + self.resized[0]] = small
        return framed

    def to_frame(self, boxes_xyxy_px: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 4"]:
        """Boxes of the input as boxes of the frame, half-open, px."""
        return (boxes_xyxy_px - np.tile(self.offset, 2)) / np.tile(self.scale, 2)

    def mask_to_frame(
        self, probability: Float32[np.ndarray, "h w"], bbox_xyxy_px: Float[np.ndarray, "4"]
    ) -> Bool[np.ndarray, "H W"]:
        """The part of a mask of the whole input that lies in a box of the frame, in its pixels."""
        x0, y0, x1, y1 = whole_pixels(bbox_xyxy_px)
        per_input = np.array(probability.shape[::-1]) / self.input_size
        scale = self.scale * per_input
        # From the middle of a frame pixel of the box to the middle of a mask pixel.
        shift = scale * (np.array([x0, y0]) + 0.5) + self.offset * per_input - 0.5
        affine = np.column_stack([np.diag(scale), shift])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        border = cv2.BORDER_REPLICATE
        size = (x1 - x0, y1 - y0)
        return cv2.warpAffine(probability, affine, size, flags=flags, borderMode=border) > 0.5


_MIN_INPUT_PX = 32  # the stride of the usual detectors
_SCORE_TOLERANCE = 1e-3  # rounding may put a score of 1 above 1
_IMAGENET_MEAN = np.array([0.485, 0.456, 0.406], np.float32)[:, None, None]  # RGB
_IMAGENET_STD = np.array([0.229, 0.224, 0.225], np.float32)[:, None, None]


class OnnxSettings(Settings):
    """The part of `[detect_fish]` that a detector from an ONNX file reads."""

    onnx_layout: Layout = Field(
        default="yolo", description="output format of the model; docs/models.md has the shapes"
    )
    onnx_input_px: int = Field(
        default=640, ge=_MIN_INPUT_PX, le=4096, description="input side of a model of any size, px"
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
    """A `Detector` of boxes and scores, and of masks if its layout has them."""

    refused: Mapping[str, int] = MappingProxyType({})  # what was not found is not known

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
    def has_masks(self) -> bool:
        return self._settings.onnx_layout in MASKS

    def find(self, frame: Frame) -> list[Candidate]:
        """The boxes of a frame after non-maximum suppression, without boxes with empty masks."""
        height, width = frame.image.shape[:2]
        letterbox = Letterbox.from_sizes(frame_size=(width, height), input_size=self._input_size)
        boxes, scores, outputs = self._run(letterbox.apply(frame.image))
        boxes = letterbox.to_frame(boxes).clip(0, [width, height, width, height])
        sides = boxes[:, 2:] - boxes[:, :2]
        usable = np.isfinite(boxes).all(axis=1) & (sides >= 1).all(axis=1)
        usable &= scores >= self._min_score  # not NaN
        indices, boxes, scores = np.flatnonzero(usable), boxes[usable], scores[usable]
        kept = cv2.dnn.NMSBoxes(
            np.column_stack([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]]).tolist(),
            scores.tolist(),
            self._min_score,
            self._settings.onnx_overlap,
        )
        mask_of, found = MASKS.get(self._settings.onnx_layout), list[Candidate]()
        for i in np.array(kept, int).ravel():
            inside = None
            if mask_of is not None:
                probability = mask_of(outputs, int(indices[i])).astype(np.float32)
                inside = letterbox.mask_to_frame(probability, boxes[i])
            if inside is None or inside.any():
                score = float(min(scores[i], 1.0))
                found.append(Candidate(bbox_xyxy_px=boxes[i], score=score, foreground=inside))
        return found

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
    ) -> tuple[Float[np.ndarray, "N 4"], Float[np.ndarray, "N"], list[np.ndarray]]:
        """Boxes x0, y0, x1, y1 in input pixels, the best score of any fish class, all outputs."""
        blob = cv2.dnn.blobFromImage(picture, swapRB=True)
        blob /= 255
        if self._settings.onnx_imagenet:
            blob -= _IMAGENET_MEAN
            blob /= _IMAGENET_STD
        outputs = self._session.run(None, {self._input_name: blob})
        boxes, scores = decode(outputs, self._settings.onnx_layout, input_size=self._input_size)
        return boxes, self._fish_scores(scores).max(axis=1, initial=0.0), outputs

    def _fish_scores(self, scores: Float[np.ndarray, "N C"]) -> Float[np.ndarray, "N F"]:
        """The scores of the classes that `onnx_classes` names."""
        classes = self._settings.onnx_classes
        if not classes:
            return scores
        if self._settings.onnx_layout in (
            "yolo-nms",
            "mask-rcnn",
        ):  # have as many columns as classes were found
            classes = [c for c in classes if c < scores.shape[1]]
        elif max(classes) >= scores.shape[1]:
            raise OutputShapeError(f"with class {max(classes)}, which onnx_classes names")
        return scores[:, classes]

    def _try(self, picture: UInt8[np.ndarray, "h w 3"]) -> None:
        """Raise ModelError if the model fails on a picture or has impossible outputs."""
        layout = self._settings.onnx_layout
        try:
            boxes, scores, _ = self._run(picture)
        except OutputShapeError as error:
            shapes = ", ".join(str(tuple(o.shape)) for o in self._session.get_outputs())
            raise self._refusal(
                f'outputs of [detect_fish] onnx_layout = "{layout}", {error}', shapes
            ) from None
        except Exception as error:  # onnxruntime's errors share no base class
            raise self._refusal(
                f"a model that takes a picture of {self._input_size[0]}x{self._input_size[1]} px",
                first_line(error),
                remedy="set [detect_fish] onnx_input_px",
            ) from None
        if not (np.isfinite(boxes).all() and np.isfinite(scores).all()):
            raise self._refusal("finite boxes and scores", "NaN or infinity", remedy="export again")
        low, high = scores.min(initial=0.0), scores.max(initial=0.0)
        if low < -_SCORE_TOLERANCE or high > 1 + _SCORE_TOLERANCE:
            raise self._refusal("scores from 0 to 1", f"{scores.min():.3g} to {scores.max():.3g}")

    def _refusal(self, expected: str, got: str, *, remedy: str = "") -> ModelError:
        remedy = remedy or "export it again, or set [detect_fish] onnx_layout"
        return ModelError(f"{self._path}: expected {expected}, got {got}; {remedy}")


_MIN_AREA_PX = 24  # in the network's input; chosen by hand, a few pixels wide and high


class UNetDetector:
    """A `Detector` of connected shapes with fish probability above 0.5; the score is their mean."""

    refused: Mapping[str, int] = MappingProxyType({})  # what was not found is not known

    def __init__(self, segmenter: UNetSegmenter, *, longer_px: int) -> None:
        """`longer_px`: longer side of the network's input; fish should be 40 to 140 px in it."""
        self._segmenter = segmenter
        self._longer_px = longer_px

    def find(self, frame: Frame) -> list[Candidate]:
        height, width = frame.image.shape[:2]
        scale = self._longer_px / max(width, height)
        size = [
            SIZE_MULTIPLE_PX * max(1, round(side * scale / SIZE_MULTIPLE_PX))
            for side in (width, height)
        ]
        small = cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)
        probability = self._segmenter.segment_all(small)
        fish = cv2.resize(probability, (width, height), interpolation=cv2.INTER_LINEAR)
        min_area_px = _MIN_AREA_PX * width * height / (size[0] * size[1])
        count, labels, stats = components((fish > 0.5).astype(np.uint8))
        large = [i for i in range(1, count) if stats[i, cv2.CC_STAT_AREA] >= min_area_px]
        return [_candidate(labels == i, fish) for i in large]


def _candidate(
    shape: Bool[np.ndarray, "H W"], probability: Float32[np.ndarray, "H W"]
) -> Candidate:
    x, y, w, h = cv2.boundingRect(shape.view(np.uint8))
    return Candidate(
        bbox_xyxy_px=np.array([x, y, x + w, y + h], np.float64),
        score=float(probability[shape].mean()),
        foreground=shape[y : y + h, x : x + w].copy(),
    )
