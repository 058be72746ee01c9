"""Label pictures give ids however they are stored; others are refused."""

import shlex
import subprocess
import sys

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from stream_dmr.detection.mask_folder import Labels, MaskFolder, are_grey_levels
from stream_dmr.errors import AnnotationError
from tests.support.annotation_files import LABELS_SIZE, labels_of


def write_palette(path, labels):
    picture = Image.fromarray(labels, mode=None).convert("L")
    palette = Image.frombytes("P", picture.size, picture.tobytes())
    palette.putpalette([value for i in range(256) for value in (255 - i, 7 * i % 256, 3 * i % 256)])
    palette.save(path)


@pytest.mark.parametrize("kind", ["grey", "palette", "16-bit"])
def test_masks_give_ids_in_every_storage_format(tmp_path, kind):
    labels = labels_of(id1=(0, 0, 2, 2), id3=(4, 1, 7, 5))
    path = tmp_path / "000001.png"
    if kind == "palette":
        write_palette(path, labels)
    else:
        labels = labels.astype(np.uint16) * 100 if kind == "16-bit" else labels
        cv2.imwrite(str(path), labels)
    np.testing.assert_array_equal(MaskFolder(tmp_path).labels(1, **LABELS_SIZE).ids, labels)


def test_a_1_bit_mask_is_fish_1(tmp_path):
    labels = labels_of(id1=(1, 1, 5, 4))
    Image.fromarray(labels == 1).save(tmp_path / "000001.png")
    np.testing.assert_array_equal(MaskFolder(tmp_path).labels(1, **LABELS_SIZE).ids, labels)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_fish_lie_within_the_window(tmp_path, dtype):
    labels = labels_of(id1=(2, 1, 4, 3), id3=(5, 4, 7, 5)).astype(dtype)
    cv2.imwrite(str(tmp_path / "000001.png"), labels)
    cv2.imwrite(str(tmp_path / "000002.png"), np.zeros_like(labels))
    masks = MaskFolder(tmp_path)
    found = masks.labels(1, **LABELS_SIZE)
    assert found.present == [1, 3]
    assert np.count_nonzero(found.ids[found.window]) == np.count_nonzero(labels)
    assert masks.labels(2, **LABELS_SIZE).present == []


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_largest_value_is_no_fish_but_unknown(tmp_path, dtype):
    labels = labels_of(id1=(0, 0, 4, 3)).astype(dtype)
    labels[1] = np.iinfo(dtype).max
    cv2.imwrite(str(tmp_path / "000001.png"), labels)
    found = MaskFolder(tmp_path).labels(1, **LABELS_SIZE)
    np.testing.assert_array_equal(found.ids, np.where(labels == 1, 1, 0))
    np.testing.assert_array_equal(found.unknown, labels > 1)


def test_masks_may_be_named_like_the_pictures_of_the_source(tmp_path):
    pictures, folder = tmp_path / "pictures", tmp_path / "masks"
    labels = labels_of(id1=(0, 0, 2, 2))
    for one in (pictures, folder):
        one.mkdir()
    cv2.imwrite(str(folder / "IMG_7.png"), labels)
    for unlike in (None, tmp_path / "haul.mp4", pictures):
        with pytest.raises(AnnotationError, match=r"pictures of the source, found IMG_7\.png"):
            MaskFolder(folder, pictures=unlike)
    (pictures / "IMG_7.JPG").touch()
    masks = MaskFolder(folder, pictures=pictures)
    found = masks.labels(1, **LABELS_SIZE, picture="IMG_7.JPG")
    np.testing.assert_array_equal(found.ids, labels)
    assert masks.labels(7, **LABELS_SIZE, picture="IMG_8.JPG") is None


def test_numbered_masks_go_by_frame_whatever_pictures_are_called(tmp_path):
    first, second = labels_of(id1=(0, 0, 2, 2)), labels_of(id3=(4, 1, 7, 5))
    cv2.imwrite(str(tmp_path / "000001.png"), first)
    cv2.imwrite(str(tmp_path / "000002.png"), second)
    found = MaskFolder(tmp_path).labels(1, **LABELS_SIZE, picture="000002.jpg")
    np.testing.assert_array_equal(found.ids, first)


@pytest.mark.parametrize("first", [0, 8])
def test_numbered_pictures_with_masks_of_their_own_names_have_those(tmp_path, first: int):
    pictures, folder = tmp_path / "pictures", tmp_path / "masks"
    pictures.mkdir()
    folder.mkdir()
    for number in (first, first + 1):
        (pictures / f"{number:06d}.jpg").touch()
        labels = np.full((LABELS_SIZE["height"], LABELS_SIZE["width"]), number + 1, np.uint8)
        cv2.imwrite(str(folder / f"{number:06d}.png"), labels)
    masks = MaskFolder(folder, pictures=pictures)
    for frame_index, number in enumerate((first, first + 1), start=1):
        found = masks.labels(frame_index, **LABELS_SIZE, picture=f"{number:06d}.jpg")
        assert found is not None
        assert found.present == [number + 1]
    assert masks.unused(1) == []


def test_masks_that_show_fish_as_unknown_are_refused(tmp_path):
    """A mask of one fish is often written as 255 on 0."""
    labels = labels_of(id1=(0, 0, 4, 3)) * np.uint8(255)
    cv2.imwrite(str(tmp_path / "000001.png"), labels)
    with pytest.raises(AnnotationError, match=r"only 0 and 255.*the value 1"):
        MaskFolder(tmp_path).labels(1, **LABELS_SIZE)
    cv2.imwrite(str(tmp_path / "000002.png"), labels // 255)
    assert MaskFolder(tmp_path).labels(1, **LABELS_SIZE).unknown.sum() == 12


@pytest.mark.parametrize(("across_frames", "ids"), [(True, [1, 1]), (False, [1, 2])])
def test_the_command_in_the_refusal_makes_ids(tmp_path, across_frames, ids):
    """Of video one fish, of stills one fish a picture."""
    folder, inside = tmp_path / "masks", labels_of(id1=(1, 1, 5, 4))
    folder.mkdir()
    for name in ("000001.png", "000002.png"):
        cv2.imwrite(str(folder / name), inside * np.uint8(255))
    with pytest.raises(AnnotationError, match="only 0 and 255") as refused:
        MaskFolder(folder, across_frames=across_frames).labels(1, **LABELS_SIZE)
    command = str(refused.value).partition(".venv/bin/python")[2]
    subprocess.run(f"{shlex.quote(sys.executable)}{command}", shell=True, check=True)
    masks = MaskFolder(folder, across_frames=across_frames)
    for frame_index, fish in zip((1, 2), ids, strict=True):
        labels = masks.labels(frame_index, **LABELS_SIZE)
        np.testing.assert_array_equal(labels.ids, inside.astype(int) * fish)
        assert labels.unknown is None


def test_unusable_masks_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "000001.png"), np.zeros((12, 16), np.uint8))
    cv2.imwrite(str(tmp_path / "000002.png"), np.zeros((6, 8, 3), np.uint8))
    whole = (tmp_path / "000001.png").read_bytes()
    (tmp_path / "000003.png").write_bytes(b"no picture")
    (tmp_path / "000004.png").write_bytes(whole[:-30])
    (tmp_path / "000005.png").touch()
    masks = MaskFolder(tmp_path)
    with pytest.raises(AnnotationError, match=r"000001.*8x6 px, got 16x12 px"):
        masks.labels(1, **LABELS_SIZE)
    with pytest.raises(AnnotationError, match=r"000002.*colour \(RGB\)"):
        masks.labels(2, **LABELS_SIZE)
    for frame in (3, 4, 5):
        with pytest.raises(AnnotationError, match=f"00000{frame}.*decoded"):
            masks.labels(frame, width=16, height=12)
    assert masks.labels(6, **LABELS_SIZE) is None


def test_folders_without_masks_are_refused(tmp_path):
    with pytest.raises(AnnotationError, match="found none there"):
        MaskFolder(tmp_path / "missing")
    with pytest.raises(AnnotationError, match="found no PNG"):
        MaskFolder(tmp_path)
    (tmp_path / "00001.png").touch()
    with pytest.raises(AnnotationError, match=r"found 00001\.png"):
        MaskFolder(tmp_path)
    (tmp_path / "000000.png").touch()
    with pytest.raises(AnnotationError, match=r"counted from 000001\.png"):
        MaskFolder(tmp_path)


SIZE = {"width": 320, "height": 240}
POINT = st.tuples(st.integers(0, SIZE["width"]), st.integers(0, SIZE["height"]))
FISH = st.tuples(POINT, st.integers(6, 60), st.integers(3, 12), st.integers(0, 180))


def draw(fish, dtype=np.uint8):
    labels = np.zeros((SIZE["height"], SIZE["width"]), dtype)
    for number, (center, length, depth, angle) in enumerate(fish, start=1):
        cv2.ellipse(labels, center, (length, depth), angle, 0, 360, number, -1)
    return labels


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@given(fish=st.lists(FISH, min_size=8, max_size=100))
def test_dozens_of_fish_are_no_grey_levels(dtype, fish):
    assert not are_grey_levels(Labels(draw(fish, dtype), None))
    assert not are_grey_levels(Labels(draw(fish, dtype).astype(np.int32), None))


@pytest.mark.parametrize("white", [254, 255])
@given(length=st.integers(30, 100), angle=st.integers(0, 180), sigma_px=st.floats(0.8, 20))
def test_a_soft_edge_is_grey_levels(white, length, angle, sigma_px):
    fish = draw([((160, 120), length, length // 4, angle)]) * np.uint8(white)
    soft = cv2.GaussianBlur(fish, (0, 0), sigma_px)
    assert are_grey_levels(Labels(np.where(soft == 255, 0, soft), None))


@pytest.mark.parametrize("white", [254, 255])
def test_masks_with_soft_edges_are_refused(tmp_path, white):
    fish = draw([((160, 120), 80, 20, 30)]) * np.uint8(white)
    cv2.imwrite(str(tmp_path / "000001.png"), cv2.GaussianBlur(fish, (0, 0), 2))
    with pytest.raises(AnnotationError, match=r"000001.png: .* values in thin bands.*the value 1"):
        MaskFolder(tmp_path).labels(1, **SIZE)


def test_a_mask_with_a_wrong_checksum_is_refused(tmp_path):
    """Decoders forgive it, and the fish gets another length."""
    path = tmp_path / "000001.png"
    cv2.imwrite(str(path), labels_of(id1=(0, 0, 2, 2), id3=(4, 1, 7, 5)))
    content = bytearray(path.read_bytes())
    begin = content.index(b"IDAT")
    content[begin + 4 + int.from_bytes(content[begin - 4 : begin], "big")] ^= 1  # behind the data
    path.write_bytes(content)
    with pytest.raises(AnnotationError, match="can't be decoded"):
        MaskFolder(tmp_path).labels(1, **LABELS_SIZE)


def test_a_mask_without_pixels_is_refused(tmp_path):
    path = tmp_path / "000001.png"
    cv2.imwrite(str(path), labels_of(id1=(0, 0, 2, 2)))
    content = path.read_bytes()
    begin = content.index(b"IDAT") - 4
    path.write_bytes(content[:begin] + content[content.index(b"IEND") - 4 :])
    with pytest.raises(AnnotationError, match="can't be decoded"):
        MaskFolder(tmp_path).labels(1, **LABELS_SIZE)
