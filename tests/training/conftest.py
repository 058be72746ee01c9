"""Images of a vessel with their masks."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.support.frames import ellipse_mask


@pytest.fixture
def vessel(tmp_path: Path) -> Path:
    """Six images with one or two fish each, and their masks."""
    (tmp_path / "images").mkdir()
    (tmp_path / "masks").mkdir()
    rng = np.random.default_rng(0)
    for index in range(6):
        labels = ellipse_mask(angle=30.0 * index)
        if index == 0:
            labels += 2 * ellipse_mask(center=(20, 20), axes=(15, 6))
        image = rng.integers(0, 60, (*labels.shape, 3), np.uint8)
        image[labels > 0] += 120
        cv2.imwrite(str(tmp_path / "images" / f"haul-{index}.png"), image)
        cv2.imwrite(str(tmp_path / "masks" / f"haul-{index}.png"), labels)
    return tmp_path
