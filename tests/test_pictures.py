import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.pictures import is_cut_off

JPEGS = {
    "plain": [],
    "progressive": [cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
    "with restarts": [cv2.IMWRITE_JPEG_RST_INTERVAL, 2],
}


def jpeg(kind: str) -> bytes:
    """A picture whose segments hold a thumbnail, as those of cameras do."""
    noise = np.random.default_rng(0).integers(0, 255, (64, 48, 3)).astype(np.uint8)
    content, small = (cv2.imencode(".jpg", n, JPEGS[kind])[1].tobytes() for n in (noise, noise[:9]))
    segment = b"\xff\xe1" + (len(small) + 2).to_bytes(2) + small
    return content[:2] + segment + content[2:]


@pytest.mark.parametrize("kind", JPEGS)
@given(share=st.floats(0, 1, exclude_max=True), rest=st.binary(max_size=50))
def test_a_jpeg_is_cut_off_before_its_end_and_whole_with_more_after_it(
    kind: str, share: float, rest: bytes
):
    content = jpeg(kind)
    assert not is_cut_off(content + rest)
    assert is_cut_off(content[: 2 + int(share * (len(content) - 2))])


def test_other_files_are_not_taken_for_cut_off_jpegs():
    for content in (b"", b"\xff", b"\x89PNG and so on"):
        assert not is_cut_off(content)
