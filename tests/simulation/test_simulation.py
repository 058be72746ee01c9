"""The whole scene: what is written, that it repeats, and that annotations match the film."""

import csv
import tomllib

import cv2
import numpy as np
import pytest
import trimesh

from stream_dmr.calibration.calibration_file import load_calibration
from stream_dmr.errors import OutputError, UserError
from stream_dmr.simulation import simulate
from stream_dmr.simulation.film import film, ragged
from stream_dmr.simulation.rail_scene import make_scene
from stream_dmr.simulation.write_scene import encode_mask

NUM_FISH, NUM_FRAMES = 3, 24


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    out = tmp_path_factory.mktemp("scene")
    simulate(out, num_fish=NUM_FISH, num_frames=NUM_FRAMES, preset="realistic", seed=4)
    return out


def read_csv(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def read_boxes(out):
    lines = (out / "boxes.txt").read_text().splitlines()
    return [[float(number) for number in line.split(",")] for line in lines]


def read_mask(out, frame_index):
    return cv2.imread(str(out / "masks" / f"{frame_index:06d}.png"), cv2.IMREAD_UNCHANGED)


def test_video_and_masks_have_every_frame(written):
    video = cv2.VideoCapture(str(written / "video.mp4"))
    frames = 0
    while video.read()[0]:
        frames += 1
    assert frames == NUM_FRAMES
    assert video.get(cv2.CAP_PROP_FPS) == 15
    assert (video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (
        1280,
        960,
    )
    names = sorted(path.name for path in (written / "masks").iterdir())
    assert names == [f"{index:06d}.png" for index in range(1, NUM_FRAMES + 1)]
    assert read_mask(written, 1).dtype == np.uint8


def test_boxes_are_tight_around_the_masks(written):
    boxes = read_boxes(written)
    assert {row[1] for row in boxes} == {1, 2, 3}
    for frame_index, track_id, x, y, width, height, *_, visible in boxes:
        rows, columns = np.nonzero(read_mask(written, int(frame_index)) == track_id)
        assert (columns.min(), rows.min()) == (x, y)
        assert (columns.max() + 1, rows.max() + 1) == (x + width, y + height)
        assert 0 < visible <= 1


def test_truth_agrees_with_calibration_and_itself(written):
    camera = load_calibration(written / "calibration.yaml").camera
    lengths = {row["track_id"]: float(row["length_mm"]) for row in read_csv(written / "truth.csv")}
    assert list(lengths) == ["1", "2", "3"]
    rows = read_csv(written / "truth_frames.csv")
    assert len(rows) > NUM_FRAMES / 2
    for row in rows:
        assert float(row["arc_mm"]) == pytest.approx(lengths[row["track_id"]], abs=1e-6)
        for point in ("head", "center", "tail"):
            in_mm = np.array([[float(row[f"{point}_{axis}_mm"]) for axis in "xyz"]])
            in_px = [float(row[f"{point}_{axis}"]) for axis in "uv"]
            np.testing.assert_allclose(camera.project(in_mm)[0], in_px, atol=1e-3)


def test_center_keypoint_lies_in_the_mask_of_an_unhidden_fish(written):
    boxes = {(int(row[0]), int(row[1])): row[-1] for row in read_boxes(written)}
    checked = 0
    for row in read_csv(written / "truth_frames.csv"):
        key = int(row["frame_index"]), int(row["track_id"])
        if boxes.get(key, 0.0) == 1.0:
            mask = read_mask(written, key[0])
            pixel = round(float(row["center_u"])), round(float(row["center_v"]))
            assert mask[pixel[1], pixel[0]] == key[1]
            checked += 1
    assert checked > 10


def test_template_beside_the_scene_keeps_the_contract(written):
    mesh = trimesh.load(written / "species.ply")
    described = tomllib.loads((written / "species.toml").read_text())
    assert mesh.is_watertight
    assert set(described["keypoints"]) == {"head", "center", "tail"}
    assert len(described["joints"]) >= 2
    assert all(len(point) == 3 for point in described["joints"])


def test_equal_seeds_write_equal_bytes_over_an_older_longer_scene(written, tmp_path):
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "000099.png").write_bytes(b"of an older scene")
    simulate(tmp_path, num_fish=NUM_FISH, num_frames=NUM_FRAMES, preset="realistic", seed=4)
    for path in written.rglob("*"):
        if path.is_file() and path.name != "video.mp4":
            assert (tmp_path / path.relative_to(written)).read_bytes() == path.read_bytes()
    assert not (tmp_path / "masks" / "000099.png").exists()


def test_other_seeds_give_other_fish():
    lengths = {
        make_scene(num_fish=1, num_frames=9, preset="clean", seed=seed).visits[0].fish.length_mm
        for seed in range(5)
    }
    assert len(lengths) == 5


def test_fish_come_and_go_several_at_a_time():
    scene = make_scene(num_fish=7, num_frames=120, preset="realistic", seed=0)
    together = [len(scene.visits_at(index)) for index in range(1, 121)]
    assert max(together) == 3
    assert together[0] == together[-1] == 0
    first_seen = min(visit.first_frame for visit in scene.visits)
    last_seen = max(visit.first_frame + len(visit.poses) for visit in scene.visits)
    assert 0 in together[first_seen : last_seen - 1]  # a pause between the groups


@pytest.mark.parametrize("num_frames", [1, 2, 5])
def test_every_fish_has_a_frame_however_short_the_clip(num_frames):
    scene = make_scene(num_fish=9, num_frames=num_frames, preset="severe", seed=0)
    for visit in scene.visits:
        assert visit.poses
        assert 1 <= visit.first_frame <= num_frames + 1 - len(visit.poses)


def test_the_gaff_hides_part_of_a_fish():
    scene = make_scene(num_fish=1, num_frames=24, preset="realistic", seed=1)
    camera = scene.calibration.camera
    visible = {}
    for shot in film(scene):
        for box in shot.boxes:
            posed = scene.pose(scene.visits[0], shot.frame_index)
            pixels = camera.project(posed.vertices)
            inside = (pixels > 4).all() and (pixels < [camera.width - 5, camera.height - 5]).all()
            if inside:
                visible[scene.visits[0].progress(shot.frame_index)] = box.visible_fraction
    before = [fraction for progress, fraction in visible.items() if progress < 0.36]
    during = [fraction for progress, fraction in visible.items() if 0.36 <= progress <= 0.66]
    assert min(before) == 1.0
    assert max(during) < 0.97
    assert min(during) > 0.3


def test_ragged_outlines_are_off_by_about_the_amplitude():
    mask = np.zeros((200, 200), bool)
    mask[50:150, 50:150] = True
    rough = ragged(mask, np.random.default_rng(0), amplitude_px=1.0)
    changed_per_outline_px = (rough != mask).sum() / 400
    assert 0.4 < changed_per_outline_px < 1.2  # the mean of |N(0, 1)| is 0.8
    assert abs(int(rough.sum()) - int(mask.sum())) < 0.03 * mask.sum()
    assert (ragged(mask, np.random.default_rng(0), amplitude_px=0.0) == mask).all()


def test_a_scene_without_fish_is_a_scene(tmp_path):
    simulate(tmp_path, num_fish=0, num_frames=2, preset="clean", seed=0)
    assert read_csv(tmp_path / "truth.csv") == []
    assert (tmp_path / "boxes.txt").read_text() == ""
    assert not read_mask(tmp_path, 2).any()


@pytest.mark.parametrize(("num_fish", "dtype"), [(255, np.uint8), (256, np.uint16)])
def test_masks_are_16_bit_only_where_ids_need_it(num_fish, dtype):
    labels = np.zeros((4, 5), np.uint16)
    labels[2, 3] = num_fish
    png = np.frombuffer(encode_mask(labels, num_fish=num_fish), np.uint8)
    read = cv2.imdecode(png, cv2.IMREAD_UNCHANGED)
    assert read.dtype == dtype
    np.testing.assert_array_equal(read, labels)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"preset": "stormy"}, "clean, realistic, severe"),
        ({"num_fish": -1}, "--fish"),
        ({"num_frames": 0}, "--frames"),
        ({"seed": -1}, "--seed"),
    ],
)
def test_impossible_wishes_are_refused_by_name(tmp_path, wrong, named):
    wishes = {"num_fish": 1, "num_frames": 1, "preset": "clean", "seed": 0} | wrong
    with pytest.raises(UserError, match=named):
        simulate(tmp_path / "scene", **wishes)
    assert not (tmp_path / "scene").exists()


def test_an_unwritable_folder_is_refused_by_name(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="file"):
        simulate(tmp_path / "file", num_fish=1, num_frames=1, preset="clean", seed=0)


def test_a_mixed_catch_says_which_fish_is_which(tmp_path):
    simulate(tmp_path, num_fish=3, num_frames=2, preset="clean", seed=1, species="gar,perch")
    rows = (tmp_path / "species.csv").read_text().split()
    assert rows == ["track_id,species", "1,gar", "2,perch", "3,gar"]
    breadths = {
        name: np.ptp(trimesh.load(tmp_path / f"{name}.ply").vertices[:, 1])
        for name in ("gar", "perch")
    }
    assert breadths["gar"] < breadths["perch"] / 2
