"""Many masks as the batched solver needs them: `fitting.target.Target`, stacked on a device."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stream_dmr.fitting.batched.distance_map import signed_distance
from stream_dmr.fitting.heading import told
from stream_dmr.fitting.target import Target, mask_contour
from stream_dmr.messages import FishCrop


class Targets(NamedTuple):
    """Pictures of one size. Contours are as long as the longest; what is added has length 0."""

    focal: Float[Tensor, "B 2"]
    middle: Float[Tensor, "B 2"]  # the principal point
    anchor: Float[Tensor, "B 3"]
    plane_normal: Float[Tensor, "B 3"]
    heading: Float[Tensor, "B 2"]
    mask: Float[Tensor, "B S S"]
    distance: Float[Tensor, "B S S"]
    mask_area: Float[Tensor, "B"]
    contour: Float[Tensor, "B C 2"]
    contour_normals: Float[Tensor, "B C 2"]
    contour_lengths: Float[Tensor, "B C"]

    @classmethod
    def stack(cls, targets: Sequence[Target], *, device: str, dtype: torch.dtype) -> "Targets":
        """Targets that the CPU has prepared."""

        def real(values: object) -> Tensor:
            return torch.as_tensor(np.array(values), dtype=dtype, device=device)

        contours = [(t.contour, t.contour_normals, t.contour_lengths) for t in targets]
        return cls(
            focal=real([t.K[[0, 1], [0, 1]] for t in targets]),
            middle=real([t.K[:2, 2] for t in targets]),
            anchor=real([t.anchor for t in targets]),
            plane_normal=real([t.plane_normal for t in targets]),
            heading=real([t.heading for t in targets]),
            mask=real([t.mask for t in targets]),
            distance=real([t.distance for t in targets]),
            mask_area=real([t.mask_area for t in targets]),
            **{name: real(rows) for name, rows in _padded(contours).items()},
        )

    @classmethod
    def from_crops(
        cls,
        crops: Sequence[FishCrop],
        *,
        plane_normal: Float[np.ndarray, "3"],
        device: str,
        dtype: torch.dtype,
    ) -> "Targets":
        """Distance maps by the device; contours, which are traced, by threads of the CPU."""

        def real(values: object) -> Tensor:
            return torch.as_tensor(np.array(values), dtype=dtype, device=device)

        masks = torch.as_tensor(np.stack([crop.mask for crop in crops]), device=device)
        distance = signed_distance(masks, dtype=dtype)
        with ThreadPoolExecutor() as pool:
            contours = list(pool.map(mask_contour, (crop.mask for crop in crops)))
        K = [crop.crop_camera.K for crop in crops]
        return cls(
            focal=real([k[[0, 1], [0, 1]] for k in K]),
            middle=real([k[:2, 2] for k in K]),
            anchor=real([crop.crop_camera.middle_ray() for crop in crops]),
            plane_normal=real([plane_normal] * len(crops)),
            heading=real([told(crop.ends, crop.crop_camera) for crop in crops]),
            mask=masks.to(dtype),
            distance=distance,
            mask_area=masks.sum(dim=(1, 2)).to(dtype),
            **{name: real(rows) for name, rows in _padded(contours).items()},
        )

    def coarse(self) -> "Targets":
        """The same at half the resolution; see `Target.coarse`."""
        return self._replace(
            focal=self.focal / 2,
            middle=(self.middle + 0.5) / 2 - 0.5,
            mask=torch.nn.functional.avg_pool2d(self.mask[:, None], 2)[:, 0],
            distance=torch.nn.functional.avg_pool2d(self.distance[:, None], 2)[:, 0] / 2,
            mask_area=self.mask_area / 4,
            contour=(self.contour[:, ::2] + 0.5) / 2 - 0.5,
            contour_normals=self.contour_normals[:, ::2],
            contour_lengths=self.contour_lengths[:, ::2],
        )

    def select(self, index: Int[Tensor, "K"] | slice) -> "Targets":
        """Some of them, in a new order."""
        return Targets(*(part[index] for part in self))


def _padded(contours: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> dict[str, np.ndarray]:
    most = max(len(points) for points, _, _ in contours)
    out = np.zeros((len(contours), most, 5))
    for row, (points, normals, lengths) in zip(out, contours, strict=True):
        row[: len(points), :2], row[: len(points), 2:4] = points, normals
        row[: len(points), 4] = lengths
    return {
        "contour": out[..., :2],
        "contour_normals": out[..., 2:4],
        "contour_lengths": out[..., 4],
    }
