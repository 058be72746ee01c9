"""The data set of real pictures: its manifest, and how fish are cut out of pictures for it."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from benchmarks.segmentation import real_images
from benchmarks.segmentation.mask_proposer import MaskProposer, ProposedMask
from benchmarks.segmentation.real_images import (
    READERS,
    Proposal,
    keep,
    put_before,
    window,
)

MANIFEST = Path(real_images.__file__).parent / "real_sources.toml"
OPEN = {"MIT", "CC BY 4.0", "Apache-2.0", "BSD-3-Clause", "CC0"}
KEPT_FOR_CHECKS = {
    *("Zhanglab-abe/Catfish-Segment", "WENLU-W/WENLU-W.github.io", "mooch443/trex"),
    *("JonatanAde/underwater-detection", "emilyferguson989/FishSense_237D_SP21"),
    *("fritzfrancisco/Fish-Measurer", "lwoiceshyn/Kaggle-Fish-Detection-with-Deep-Learning"),
    *("MTA21634/P6_Fish_Detection", "wibuhekers/ar-salmon", "arin1405/fish_detector_edge_ML"),
    *("kasperfg16/fish_species_detection", "briancknight/HandsFreeFishing"),
    *("Kazuhito00/YOLOX-Colaboratory-Training-Sample",),
}


@pytest.fixture(scope="module")
def manifest() -> dict:
    return tomllib.loads(MANIFEST.read_text(encoding="utf-8"))


def test_only_pictures_under_open_licences_are_trained_on(manifest):
    listed = [*manifest["sources"].values(), *manifest["frames"].values()]
    trained = [source for source in listed if source["role"] == "train"]
    assert len(trained) >= 6
    backgrounds = [manifest["backgrounds"], *manifest["more_backgrounds"].values()]
    assert {source["licence"] for source in [*trained, *backgrounds]} <= OPEN


def test_no_repository_is_used_that_is_kept_for_later_checks(manifest):
    tables = ("sources", "frames", "more_backgrounds")
    listed = [source for table in tables for source in manifest[table].values()]
    used = {source["repository"] for source in listed}
    assert not used & KEPT_FOR_CHECKS


def test_every_source_can_be_read_and_says_which_fish_were_kept(manifest):
    for source in manifest["sources"].values():
        assert source["kind"] in READERS
        assert ("accepted" in source) != ("rejected" in source)
        names = source.get("accepted", source.get("rejected"))
        assert len(set(names)) == len(names) > 0


def test_a_window_stays_in_the_picture_and_holds_the_box():
    image = np.zeros((100, 200, 3), np.uint8)
    for box in ([10.0, 20.0, 60.0, 40.0], [150.0, 0.0, 200.0, 100.0]):
        left, top, right, bottom = window(image, np.array(box), margin=0.7)
        assert 0 <= left <= box[0] <= box[2] <= right <= 200
        assert 0 <= top <= box[1] <= box[3] <= bottom <= 100


def test_a_kept_fish_has_its_surroundings_and_is_not_large():
    image, mask = np.zeros((2000, 2000, 3), np.uint8), np.zeros((2000, 2000), bool)
    mask[900:1100, 700:1300] = True
    proposal = Proposal(name="x", image=image, box=np.array([700.0, 900.0, 1300.0, 1100.0]))
    kept, kept_mask = keep(proposal, mask)
    assert kept.shape[:2] == kept_mask.shape
    assert max(kept.shape) <= 480
    assert kept_mask.mean() == pytest.approx(600 * 200 / (2.4 * 600) ** 2, rel=0.05)


def test_a_cut_out_covers_the_photograph_where_its_mask_is():
    mask = np.zeros((60, 90), bool)
    mask[20:40, 20:70] = True
    fish = np.full((60, 90, 3), 250, np.uint8)
    image, whole = put_before(np.zeros((50, 50, 3), np.uint8), fish, mask)
    assert image.shape[:2] == whole.shape
    assert image[whole].mean() > 150
    assert not image[:100].any()


def test_padding_is_cut_off_and_dark_pictures_keep_their_size():
    sizes = [(40, 60), (60, 40)]
    image = np.zeros((60, 60, 3), np.uint8)
    image[:40] = 90
    assert real_images.without_padding(image, sizes).shape[:2] == (40, 60)
    image[:] = 90
    assert real_images.without_padding(image, sizes).shape[:2] == (60, 60)
    assert real_images.without_padding(image, []).shape[:2] == (60, 60)


def test_of_several_versions_of_a_picture_the_first_is_read():
    paths = ["a/x_jpg.rf.1.jpg", "a/x_jpg.rf.2.jpg", "a/y.jpg"]
    assert real_images.first_versions(paths) == {"x_jpg": paths[0], "y": paths[2]}


def test_a_mask_on_which_both_views_agree_is_proposed(monkeypatch: pytest.MonkeyPatch):
    class Session:
        """Marks what is bright."""

        def get_inputs(self):
            return [type("Input", (), {"name": "input"})]

        get_outputs = get_inputs

        def run(self, _names: list, inputs: dict) -> list:
            return [inputs["input"].mean(axis=1, keepdims=True)]

    monkeypatch.setattr("benchmarks.segmentation.mask_proposer.open_session", lambda _: Session())
    image = np.full((100, 200, 3), 20, np.uint8)
    image[40:60, 50:120] = 220
    proposed = MaskProposer(Path("u2net.onnx")).propose(image, np.array([48.0, 38.0, 122.0, 62.0]))
    assert isinstance(proposed, ProposedMask)
    assert (proposed.mask & (image[..., 0] > 100)).sum() > 0.95 * proposed.mask.sum()
    assert proposed.mask.sum() > 0.9 * 20 * 70
    assert proposed.agreement > 0.9
