"""BFS: exhaustive search of a database of deformed silhouettes for the one most like the mask.

The mask is brought to the database's frame (a camera turned to look straight at it, moments
removed) and compared, both ways round, with every entry by IoU. Entries whose area alone rules out
a better IoU than the best so far are passed over, which doesn't change the answer.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numba import njit
from scipy.spatial.transform import Rotation

from benchmarks.table1.filmed_scene import FilmedScene
from benchmarks.table1.frame_lengths import fitted_mesh, measure_frames, unfitted
from benchmarks.table1.silhouettes import DISTANCE, HEIGHT, PX_PER_STD, WIDTH, Database, pack, posed
from stream_dmr.evaluation.length_tables import LengthRow
from stream_dmr.messages import FishCrop, FittedMesh
from stream_dmr.template.template import Template

ROWS = ("bfs", "bfs-flat")
_BLUR_PX = 0.8  # a bitmap's pixel is about two of the crop's


class BruteForce:
    """The row and its variant without bending."""

    def __init__(self, template: Template, database: Database) -> None:
        self._template = template
        self._database = database

    def measure(self, filmed: FilmedScene) -> dict[str, dict[int, LengthRow]]:
        """Lengths by row and track id."""
        return measure_frames(filmed, self.fit, ROWS)

    def fit(self, crop: FishCrop) -> FittedMesh:
        """The entry of the database that is most like the mask."""
        if np.count_nonzero(crop.mask) < 50:
            return unfitted(crop, "no mask")
        view = _View(crop)
        found = [self._nearest(view.bitmap(flip)) for flip in (0.0, np.pi)]
        flip = int(found[1][1] > found[0][1])
        entry, iou = found[flip]
        return fitted_mesh(
            crop,
            keypoints=self._placed(self._template.keypoints, entry, view, flip * np.pi),
            midline=self._placed(self._template.midline, entry, view, flip * np.pi),
            iou=iou,
        )

    def _nearest(self, bitmap: Bool[np.ndarray, "H W"]) -> tuple[int, float]:
        words = np.zeros(self._database.bits.shape[1], np.uint64)
        area = pack(bitmap, words)
        return _search(words, area, self._database.bits, self._database.areas)

    def _placed(
        self, points: Float[np.ndarray, "N 3"], entry: int, view: "_View", flip: float
    ) -> Float[np.ndarray, "N 3"]:
        """Points of the entry where the mask is: before the crop's camera, at any scale."""
        x, y, angle, std = self._database.frames[entry]
        body = posed(np.ascontiguousarray(points), np.array(self._database.poses[entry]))
        # To the middle of the picture; turned in it; so far away that it is as large as the mask.
        body[:, :2] -= DISTANCE * np.array([x, y])
        body = Rotation.from_euler("z", view.angle + flip - angle).apply(body)
        body[:, 2] += DISTANCE * std / view.std
        return body @ view.camera_from_view.T


class _View:
    """A mask as a camera sees it that was turned to look at its centroid."""

    def __init__(self, crop: FishCrop) -> None:
        self._crop = crop
        rows, columns = np.nonzero(crop.mask)
        rays = crop.crop_camera.back_project(np.stack([columns, rows], axis=1).astype(np.float64))
        ahead = np.array([0.0, 0.0, 1.0])
        toward = rays.mean(axis=0) / np.linalg.norm(rays.mean(axis=0))
        self.camera_from_view = Rotation.align_vectors([toward], [ahead])[0].as_matrix()
        seen = rays @ self.camera_from_view
        image = seen[:, :2] / seen[:, 2:]
        self._middle = image.mean(axis=0)
        values, axes = np.linalg.eigh(np.cov((image - self._middle).T))
        self.angle, self.std = float(np.arctan2(axes[1, 1], axes[0, 1])), float(np.sqrt(values[1]))

    def bitmap(self, flip: float) -> Bool[np.ndarray, "H W"]:
        """The mask in the frame of the database, turned by `flip` (rad)."""
        x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
        aligned = np.stack([x - (WIDTH - 1) / 2, y - (HEIGHT - 1) / 2], axis=-1).reshape(-1, 2)
        turn = Rotation.from_euler("z", self.angle + flip).as_matrix()[:2, :2]
        image = self._middle + self.std / PX_PER_STD * aligned @ turn.T
        rays = np.column_stack([image, np.ones(len(image))]) @ self.camera_from_view.T
        pixels = self._crop.crop_camera.project(rays).astype(np.float32).reshape(HEIGHT, WIDTH, 2)
        soft = cv2.GaussianBlur(self._crop.mask.astype(np.float32), (0, 0), _BLUR_PX)
        return cv2.remap(soft, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR) > 0.5


@njit(cache=True)
def _search(words, area, bits, areas):
    """Index and IoU of the best entry, from the entries of the same area outwards."""
    best, best_iou = 0, 0.0
    above = np.searchsorted(areas, area)
    below = above - 1
    while True:
        bound_above = area / areas[above] if above < len(areas) else 0.0
        bound_below = areas[below] / area if below >= 0 else 0.0
        if max(bound_above, bound_below) <= best_iou:
            return best, best_iou
        entry = above if bound_above >= bound_below else below
        above, below = above + (entry == above), below - (entry == below)
        common = 0
        for w in range(len(words)):
            common += _count(words[w] & bits[entry, w])
        iou = common / (area + areas[entry] - common)
        if iou > best_iou:
            best, best_iou = entry, iou


@njit(cache=True)
def _count(word):
    """Bits that are set; compilers know this form."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + (
        (word >> np.uint64(2)) & np.uint64(0x3333333333333333)
    )
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))
