"""masks.json names pictures so that `train --masks` finds them."""

import numpy as np
import pytest

from stream_dmr.export.coco_masks import coco_masks
from stream_dmr.recording.codec import compress


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("IMG_7.jpg", "IMG_7.jpg"),
        ("haul.mp4", "000007.png"),
        ("http://box/picture.jpg", "000007.png"),
    ],
)
def test_pictures_of_a_folder_keep_their_names(source: str, name: str):
    picture = compress(np.zeros((4, 6, 3), np.uint8), format="reference")
    (image,) = coco_masks([(7, source, picture)], [], {})["images"]
    assert image == {"id": 7, "file_name": name, "width": 6, "height": 4}
