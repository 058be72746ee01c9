"""A folder of Ultralytics' labels gives `run --boxes` the boxes of the frames that they name."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from stream_dmr.detection.box_files import UNKNOWN_ID, load_boxes
from stream_dmr.errors import AnnotationError
from stream_dmr.messages import FishCrop
from stream_dmr.recording.header import InputFile
from tests.support.command import invoke
from tests.support.fish_run import measure
from tests.support.reading import read_messages


def labels(folder: Path, **texts: str) -> Path:
    folder.mkdir()
    for name, text in texts.items():
        (folder / f"{name}.txt").write_text(text)
    return folder


def boxes_of(run: Path) -> dict[tuple[int, int], list[float]]:
    """By frame and fish."""
    messages = read_messages(run / "recording.mcap", [FishCrop])
    crops = [one for one in messages if isinstance(one, FishCrop)]
    return {(one.frame_index, one.track_id): one.bbox_xyxy_px.tolist() for one in crops}


def test_a_run_has_the_boxes_and_ids_of_its_labels(tmp_path: Path):
    """As Ultralytics writes them: `%g`, no file for a frame without boxes."""
    boxes, texts = boxes_of(measure(tmp_path)), dict[str, str]()
    for (frame, fish), (x0, y0, x1, y1) in boxes.items():
        shares = ((x0 + x1) / 320, (y0 + y1) / 240, (x1 - x0) / 160, (y1 - y0) / 120)
        row = " ".join(f"{value:g}" for value in (0, *shares, 0.9, fish))
        texts[f"video_{frame}"] = texts.get(f"video_{frame}", "") + row + "\n"
    clip, again = tmp_path / "clip", tmp_path / "again"
    given = {"--source": str(clip / "video.mp4"), "--template": str(clip / "tiny.ply")}
    given |= {"--calibration": str(clip / "calibration.yaml"), "--config": str(clip / "quick.toml")}
    folder = labels(tmp_path / "labels", **texts, classes="fish\n")
    done = invoke("run", given | {"--boxes": str(folder), "--out": str(again)})
    assert done.code == 0, done.err
    assert boxes_of(again) == {key: pytest.approx(box, abs=1e-3) for key, box in boxes.items()}
    recorded = InputFile.read(folder)
    assert recorded.is_unchanged()
    (folder / "video_1.txt").write_text("0 .5 .5 .1 .1 .9 1\n")
    assert not recorded.is_unchanged()


def test_pictures_are_known_by_their_names(tmp_path: Path):
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for name in ("IMG_3.jpg", "IMG_5.jpg"):
        cv2.imwrite(str(pictures / name), np.zeros((9, 9, 3), np.uint8))
    folder = labels(tmp_path / "labels", IMG_5="2 0.5 0.25 0.5 0.1 0.75")
    ((box,),) = (found := load_boxes(folder, pictures=pictures)).values()
    assert [*found] == [2]
    assert (box.track_id, box.score) == (UNKNOWN_ID, 0.75)
    in_px = box.in_px(200, 100).bbox_xyxy_px
    np.testing.assert_allclose(in_px, [50, 20, 150, 30])
    (folder / "IMG_5.txt").rename(folder / "other_1.txt")
    with pytest.raises(
        AnnotationError, match=r"named like the pictures .* got such as other_1\.txt"
    ):
        load_boxes(folder, pictures=pictures)
    (pictures / "IMG_3.txt").touch()
    with pytest.raises(AnnotationError, match="got pictures beside them"):
        load_boxes(pictures)


@pytest.mark.parametrize(
    ("rows", "ids", "scores"),
    [
        (["0 .5 .5 .1 .1"], [0], [1.0]),
        (["0 .5 .5 .1 .1 .5", "0 .7 .5 .1 .1 1"], [0, 0], [0.5, 1.0]),
        (["0 .5 .5 .1 .1 1", "0 .7 .5 .1 .1 7"], [1, 7], [1.0, 1.0]),
        (["0 .5 .5 .1 .1 .5 1", "0 .7 .5 .1 .1 1 7"], [1, 7], [0.5, 1.0]),
    ],
)
def test_a_sixth_number_is_an_id_where_one_is_above_1(
    tmp_path: Path, rows: list[str], ids: list[int], scores: list[float]
):
    found = load_boxes(labels(tmp_path / "labels", clip_12="\n".join(rows)))[12]
    assert [box.track_id for box in found] == ids
    assert [box.score for box in found] == scores


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("clip_1", "0 .5 .5 .1", "line 1: expected class, centre"),
        ("clip_1", "0 .1 .1 .1 .2 .2 .3 .3 .4 .4", "got '0 .1 .1 .1 .2"),  # a polygon
        ("clip_1", "0 50 60 10 10", "in shares of the picture"),
        ("clip_1", "0 .5 .5 .1 .1 .5 1.5", "an id from 1"),
        ("clip_1", "0 .5 .5 .1 .1 x", "an id from 1"),
        ("clip_1", "0 .5 .5 0 .1", "above 0"),
        ("clip_1", "0 nan .5 .1 .1", "above 0"),
        ("clip_0", "0 .5 .5 .1 .1", "from 1"),
        ("clip", "0 .5 .5 .1 .1", r"got such as clip\.txt"),
    ],
)
def test_other_labels_are_refused(tmp_path: Path, name: str, text: str, why: str):
    with pytest.raises(AnnotationError, match=why):
        load_boxes(labels(tmp_path / "labels", **{name: text}))
