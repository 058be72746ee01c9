"""Masks of fish in boxes, proposed by a network for salient objects."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from stream_dmr.networks.onnx_session import open_session

_SIDE_PX = 320  # the network's input
_MARGINS = (0.18, 0.4)  # around the box, of its longer side; one view each
_GROW = 0.06  # of the box's longer side: masks end there
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet, RGB

Image = UInt8[np.ndarray, "H W 3"]
Mask = Bool[np.ndarray, "H W"]
Box = Float[np.ndarray, "4"]  # left, top, right, bottom, px


class ProposedMask(NamedTuple):
    """A mask, and how far it can be trusted without being looked at."""

    mask: Mask
    agreement: float  # IoU of the masks of two views


class MaskProposer:
    """U2-Net (Qin et al., Pattern Recognition 2020, Apache-2.0), asked twice for every box.

    The second view is mirrored and shows more of the surroundings. Where both say the same, the
    mask is mostly right; where not, something else stands out as well.
    """

    def __init__(self, path: Path) -> None:
        """`path` is `u2net.onnx`, as background removers bring it along."""
        self._session = open_session(path)

    def propose(self, image: Image, box: Box) -> ProposedMask | None:
        """The largest shape that stands out in a box; None without any."""
        close = self._saliency(image, box, margin=_MARGINS[0], mirror=False)
        wide = self._saliency(image, box, margin=_MARGINS[1], mirror=True)
        mask = largest_shape(_inside((close + wide) / 2 > 0.5, box))
        if mask is None:
            return None
        views = [largest_shape(_inside(view > 0.5, box)) for view in (close, wide)]
        agreement = 0.0 if views[0] is None or views[1] is None else _iou(views[0], views[1])
        return ProposedMask(mask=mask, agreement=agreement)

    def _saliency(
        self, image: Image, box: Box, *, margin: float, mirror: bool
    ) -> Float32[np.ndarray, "H W"]:
        x0, y0, x1, y1 = window(image, box, margin=margin)
        part = image[y0:y1, x0:x1]
        small = cv2.resize(part, (_SIDE_PX, _SIDE_PX), interpolation=cv2.INTER_AREA)
        rgb = small[:, :: -1 if mirror else 1, ::-1] / max(float(small.max()), 1.0)
        blob = ((rgb - _MEAN) / _STD).transpose(2, 0, 1)[None].astype(np.float32)
        [output] = self._session.run([self._first_output], {self._input: blob})
        output = output[0, 0, :, :: -1 if mirror else 1]
        output = (output - output.min()) / max(float(np.ptp(output)), 1e-6)
        saliency = np.zeros(image.shape[:2], np.float32)
        saliency[y0:y1, x0:x1] = cv2.resize(output, part.shape[1::-1])
        return saliency

    @property
    def _input(self) -> str:
        return self._session.get_inputs()[0].name

    @property
    def _first_output(self) -> str:
        return self._session.get_outputs()[0].name


def window(image: Image, box: Box, *, margin: float) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of a square around a box, within the picture."""
    half = float((box[2:] - box[:2]).max()) * (1 + 2 * margin) / 2
    center, size = (box[:2] + box[2:]) / 2, image.shape[1::-1]
    left, top = np.floor(center - half).astype(int).clip(0).tolist()
    right, bottom = np.minimum(np.ceil(center + half).astype(int), size).tolist()
    return left, top, right, bottom


def box_of(mask: Mask) -> Box:
    """The half-open box of a mask, px."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return np.array([x, y, x + width, y + height], np.float64)


def largest_shape(mask: Mask) -> Mask | None:
    """The largest connected shape; None of an empty mask."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    return labels == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax()) if count > 1 else None


def _inside(mask: Mask, box: Box) -> Mask:
    grow = _GROW * float((box[2:] - box[:2]).max())
    left, top = np.ceil(box[:2] - grow).astype(int).clip(0).tolist()
    right, bottom = np.floor(box[2:] + grow).astype(int).clip(0).tolist()
    area = np.s_[top : bottom + 1, left : right + 1]
    inside = np.zeros_like(mask)
    inside[area] = mask[area]
    return inside


def _iou(a: Mask, b: Mask) -> float:
    return float(np.count_nonzero(a & b) / max(np.count_nonzero(a | b), 1))
