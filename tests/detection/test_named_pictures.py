"""A CSV says which fish each picture shows."""

import cv2
import numpy as np
import pytest

from stream_dmr.detection.detector import Candidate
from stream_dmr.detection.given_fish import NamedPictures
from stream_dmr.detection.mask_folder import MaskFolder
from stream_dmr.detection.open_detector import DetectFishSettings
from stream_dmr.errors import AnnotationError
from stream_dmr.messages import Frame
from stream_dmr.tracking.finder import TrackFishSettings, open_finder


def ids_file(folder, text="picture,fish\na.jpg,7\nb.jpg,7\n\nc.jpg,2\n"):
    path = folder / "fish.csv"
    path.write_text(text)
    return path


class TwoThings:
    """A detector of a small thing and a larger one."""

    refused = {}  # noqa: RUF012

    def find(self, frame):
        boxes = np.array([[0.0, 0.0, 5.0, 5.0], [2.0, 3.0, 28.0, 15.0]])
        return [Candidate(bbox_xyxy_px=box, score=0.9) for box in boxes]


def frame_of(name, index=1, size=(20, 30)):
    image = np.zeros((*size, 3), np.uint8)
    return Frame(frame_index=index, timestamp_ns=index, image=image, source=name)


def test_a_csv_of_pictures_is_known_by_its_header(tmp_path):
    finder = open_finder(
        boxes=ids_file(tmp_path), masks=None, detect=DetectFishSettings(), track=TrackFishSettings()
    )
    assert isinstance(finder, NamedPictures)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("picture;fish\na.jpg;7\n", "separated by a comma, got picture;fish"),
        ("Picture,Fish\na.jpg,7\n", "the columns picture and fish"),
        ("picture,fish\nB\xe4r.jpg,7\n", "a CSV in UTF-8"),
    ],
)
def test_tables_of_a_spreadsheet_are_refused_clearly(tmp_path, text, expected):
    path = tmp_path / "fish.csv"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(AnnotationError, match=expected):
        open_finder(boxes=path, masks=None, detect=DetectFishSettings(), track=TrackFishSettings())


def test_pictures_of_one_fish_have_its_id_and_the_largest_thing_is_the_fish(tmp_path):
    finder = NamedPictures(ids_file(tmp_path), TwoThings())
    assert finder.open_ids is None
    assert not finder.has_masks
    found = [finder.detect(frame_of(name)) for name in ("a.jpg", "b.jpg", "c.jpg")]
    assert [one.source_id for [one] in found] == [7, 7, 2]
    np.testing.assert_array_equal(found[0][0].bbox_xyxy_px, [2, 3, 28, 15])
    assert found[0][0].mask is None


def test_masks_show_the_one_fish_whatever_their_ids(tmp_path):
    labels = np.zeros((20, 30), np.uint8)
    labels[5:10, 5:25] = 3
    labels[5:10, 12] = 255
    cv2.imwrite(str(tmp_path / "000001.png"), labels)
    finder = NamedPictures(ids_file(tmp_path), MaskFolder(tmp_path))
    [found] = finder.detect(frame_of("a.jpg"))
    np.testing.assert_array_equal(found.mask, labels == 3)
    np.testing.assert_array_equal(found.unknown, labels == 255)
    [without] = finder.detect(frame_of("b.jpg", index=2))
    assert not without.mask.any()


def test_pictures_and_rows_that_do_not_match_are_said(tmp_path):
    finder = NamedPictures(ids_file(tmp_path), TwoThings())
    assert finder.detect(frame_of("d.jpg")) == []
    finder.detect(frame_of("a.jpg"))
    [unnamed], [missing] = finder.warnings, finder.unused
    assert "d.jpg" in unnamed
    assert "b.jpg, c.jpg" in missing


@pytest.mark.parametrize(
    ("rows", "complaint"),
    [("a.jpg,x\n", r":2: .*'x'"), (",3\n", ":2: "), ("a.jpg,1\na.jpg,2\n", ":3: .*one fish")],
)
def test_rows_that_say_nothing_are_refused_with_their_line(tmp_path, rows, complaint):
    with pytest.raises(AnnotationError, match=complaint):
        NamedPictures(ids_file(tmp_path, "picture,fish\n" + rows), TwoThings())
