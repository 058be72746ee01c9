"""A user's promptable model as an ONNX file: an image and a box in, a mask out.

Inputs: the crop as (1, 3, H, W), RGB from 0 to 1, and its box, either as one input of four numbers
(x0, y0, x1, y1 in input pixels), or as in the Segment Anything family (Kirillov et al., ICCV 2023):
two points with the labels 2 and 3. Outputs: logits (..., h, w) of one or more masks; with more than
one mask, a second output with a score for each.
"""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from stream_dmr.errors import ModelError, first_line
from stream_dmr.networks.onnx_session import open_session
from stream_dmr.segmentation.segmenter import SegmentedFish

_DEFAULT_SIDE_PX = 256  # for a model that takes images of any size; twice a default crop
_CORNER_LABELS = np.array([2.0, 3.0], np.float32)  # top left and bottom right, as in SAM


class PromptableSegmenter:
    """A `Segmenter` from an ONNX file, which locates no ends."""

    knows_fish = False

    def __init__(self, path: Path) -> None:
        """Raises ModelError for a file that is no such model; it is tried on three images."""
        self._path = path
        self._session = open_session(path)
        self._picture, self._prompts = self._read_inputs()
        shape = next(i.shape for i in self._session.get_inputs() if i.name == self._picture)
        sides = {n for n in shape[2:] if isinstance(n, int)}
        if len(sides) > 1 or any(n < 32 for n in sides):
            raise self._refusal("square pictures of at least 32 px", f"{shape}")
        self._size = sides.pop() if sides else _DEFAULT_SIDE_PX  # of the input's side, px
        box = np.array([40.0, 30.0, 90.0, 100.0])
        for value in (0, 90, 255):
            picture = np.full((128, 128, 3), value, np.uint8)
            picture[30:100, 40:90] = 160
            self._try(picture, box)

    def segment(
        self, image: UInt8[np.ndarray, "S S 3"], bbox_xyxy_px: Float[np.ndarray, "4"]
    ) -> SegmentedFish:
        """The fish in a box, half-open in pixels of the crop `image` (BGR)."""
        size = len(image)
        logits = self._run(image, bbox_xyxy_px)
        logits = cv2.resize(logits, (size, size))
        probability = 1 / (1 + np.exp(-np.nan_to_num(logits).clip(-50, 50)))
        return SegmentedFish(probability=probability.astype(np.float32), ends=None)

    def _run(
        self, image: UInt8[np.ndarray, "S S 3"], bbox_xyxy_px: Float[np.ndarray, "4"]
    ) -> Float32[np.ndarray, "h w"]:
        """The logits of the best mask, over the whole crop at the model's own size."""
        scale = self._size / len(image)
        interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        picture = cv2.resize(image, (self._size, self._size), interpolation=interpolation)
        rgb = picture[..., ::-1].transpose(2, 0, 1)[None].astype(np.float32) / 255
        # From half-open edges to pixel centers, from which such models count.
        corners = (bbox_xyxy_px * scale - 0.5).astype(np.float32)
        feed: dict[str, np.ndarray] = {self._picture: np.ascontiguousarray(rgb)}
        for name, shape in self._prompts.items():
            feed[name] = (_CORNER_LABELS if "label" in name.lower() else corners).reshape(shape)
        masks, *others = self._session.run(None, feed)
        masks = np.asarray(masks, np.float32).reshape(-1, *masks.shape[-2:])
        if len(masks) == 1 or not others or others[0].size != len(masks):
            return masks[0]
        return masks[int(np.argmax(others[0]))]

    def _read_inputs(self) -> tuple[str, dict[str, tuple[int, ...]]]:
        """The name of the image input, and the shape of one box in each prompt input."""
        pictures, prompts = [], {}
        for given in self._session.get_inputs():
            if len(given.shape) == 4 and given.shape[1] == 3:
                pictures.append(given.name)
                continue
            last = 2 if "label" in given.name.lower() else given.shape[-1] if given.shape else 0
            sizes = {"box": (4,), "label": (2,), "point": (2, 2), "coord": (2, 2)}
            kind = next((kind for kind in sizes if kind in given.name.lower()), None)
            if kind is None or last != sizes[kind][-1] or len(given.shape) < len(sizes[kind]):
                raise self._refusal("inputs for a picture and a box", f"{given.name} {given.shape}")
            ones = (1,) * (len(given.shape) - len(sizes[kind]))
            prompts[given.name] = (*ones, *sizes[kind])
        if len(pictures) != 1 or not prompts:
            names = ", ".join(f"{i.name} {i.shape}" for i in self._session.get_inputs()) or "none"
            raise self._refusal("one input (1, 3, H, W) and one for a box", names)
        return pictures[0], prompts

    def _try(self, image: UInt8[np.ndarray, "S S 3"], box: Float[np.ndarray, "4"]) -> None:
        try:
            logits = self._run(image, box)
        except Exception as error:  # onnxruntime's errors share no base class
            raise self._refusal(
                "a model that takes a picture and a box", first_line(error)
            ) from None
        if min(logits.shape) < 16:
            raise self._refusal("an output of at least 16x16 px", f"{logits.shape}")
        if not np.isfinite(logits).all():
            raise self._refusal("finite logits", "NaN or infinity")

    def _refusal(self, expected: str, got: str) -> ModelError:
        return ModelError(
            f"{self._path}: expected {expected}, got {got}; docs/models.md says what a "
            "promptable model looks like"
        )
