"""Lists of species, the combination of frames, and what a classifier's file must be."""

import re
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import TensorProto, helper

from stream_dmr.camera import Camera
from stream_dmr.errors import ConfigError, ModelError
from stream_dmr.messages import CropQuality, FishCrop
from stream_dmr.pipeline.config import parse_config
from stream_dmr.segmentation.species_classifier import SpeciesClassifier
from stream_dmr.species import (
    CODE,
    LENGTHS,
    SpeciesEvidence,
    SpeciesSettings,
    converted_length,
    find_species,
    forms_of_species,
    is_longer_than_known,
    load_species,
)
from stream_dmr.template.template_file import bundled_names


def test_the_bundled_list_has_codes_names_and_bundled_forms():
    species = load_species()
    assert len(species) == len({one.scientific_name for one in species}) == 101
    assert all(CODE.fullmatch(one.code) and one.english_name for one in species)
    assert {one.form for one in species} - {""} <= set(bundled_names())
    by_code = {one.code: one for one in species}
    assert by_code["YFT"].scientific_name == "Thunnus albacares"
    assert by_code["HAP"].form == "halibut"


def test_the_lengths_of_the_bundled_list_have_their_order_and_their_way_back():
    listed = [one for one in load_species() if one.lengths]
    assert {"BSH", "SMA", "HER"} <= {one.code for one in listed}
    for one in listed:
        for length_mm in (1500.0, 2500.0):
            total = converted_length(one, length_mm, given="fork", wanted="total")
            assert total is not None
            assert 1.02 * length_mm < total[0] < 1.9 * length_mm, one.code  # threshers: long tails
            assert re.search(r"\w{4}", total[1])
            back = converted_length(one, total[0], given="total", wanted="fork")
            assert back is not None
            assert back[0] == pytest.approx(length_mm)
            shorter = converted_length(one, length_mm, given="fork", wanted="precaudal")
            assert shorter is None or 0.85 * length_mm < shorter[0] < length_mm, one.code
    for one in load_species():
        assert not one.largest or is_longer_than_known(one.code, 5000.0, given="fork"), one.code
        assert not is_longer_than_known(one.code, 900.0, given="fork"), one.code
        assert one.aphia_id.isdecimal() or not one.aphia_id


def test_a_length_is_converted_as_published_or_not_at_all():
    by_code = {one.code: one for one in load_species()}
    blue = by_code["BSH"]  # FL = 0.8313 TL + 1.39 cm, PCL = 0.92 FL - 0.22 cm
    fork = converted_length(blue, 2000.0, given="total", wanted="fork")
    assert fork is not None
    assert fork[0] == pytest.approx(10 * (0.8313 * 200 + 1.39))
    assert "Skomal" in fork[1]
    precaudal = converted_length(blue, 2000.0, given="fork", wanted="precaudal")
    assert precaudal is not None
    assert precaudal[0] == pytest.approx(10 * (0.92 * 200 - 0.22))
    assert converted_length(blue, 2000.0, given="total", wanted="precaudal") is None
    thresher = by_code["ALV"]
    assert converted_length(thresher, 50.0, given="fork", wanted="total") is None  # below 0
    for kind in LENGTHS:
        assert converted_length(by_code["COD"], 500.0, given=kind, wanted="total") is None


def test_only_a_length_that_can_be_compared_is_longer_than_known():
    cod, skipjack = "COD", "SKJ"  # 200 cm total, 110 cm fork
    for kind in ("fork", "total", None):  # none is above the total length
        assert is_longer_than_known(cod, 2000.1, given=kind)
        assert not is_longer_than_known(cod, 2000.0, given=kind)
    assert not is_longer_than_known(cod, 2500.0, given="disc width")
    assert is_longer_than_known(skipjack, 1100.1, given="fork")
    assert not is_longer_than_known(skipjack, 1150.0, given="total")
    assert not is_longer_than_known(skipjack, 1150.0, given=None)
    assert not is_longer_than_known("COE", 1e5, given="total")  # no source could be read


@pytest.mark.parametrize("text", ["swo", " Swordfish ", "xiphias gladius"])
def test_a_species_is_found_by_code_or_name(text: str):
    found = find_species(text, load_species())
    assert found is not None
    assert found.code == "SWO"
    assert find_species("sword", load_species()) is None


def test_own_species_are_added_and_replace(tmp_path: Path):
    own = tmp_path / "own.csv"
    own.write_text(
        "code,scientific_name,english_name,form\n"
        "XYZ,Piscis novus,New fish,eel\nHAP,Hippoglossus stenolepis,Butt,\n"
    )
    species = {one.code: one for one in load_species(str(own))}
    assert len(species) == 102
    assert species["HAP"].english_name == "Butt"
    settings = SpeciesSettings(own_list=str(own), forms=["HAP = halibut", "SWO=tuna"])
    forms = forms_of_species(settings)
    assert (forms["XYZ"], forms["HAP"], forms["SWO"]) == ("eel", "halibut", "tuna")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("code,name\nXYZ,a\n", "expected the columns code,scientific_name,english_name,form"),
        ("code,scientific_name,english_name\nxy,a,b\n", "line 2: expected a code of three"),
        ("code,scientific_name,english_name\nXYZ,,b\n", "line 2: expected a code of three"),
        ("code,scientific_name,english_name\nXYZ,a,b\nXYZ,c,d\n", "line 3: .* each code once"),
        ("", "got none"),
    ],
)
def test_a_wrong_list_is_refused(tmp_path: Path, text: str, message: str):
    (tmp_path / "own.csv").write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_species(str(tmp_path / "own.csv"))
    with pytest.raises(ConfigError, match="No such file"):
        load_species(str(tmp_path / "none.csv"))


@pytest.mark.parametrize(
    ("forms", "expected"),
    [
        ('["halibut"]', "pairs of a code and a body form"),
        ('["hap=halibut"]', "pairs of a code and a body form"),
        ('["HAP=halibut", "HAP = salmon"]', "each code once"),
    ],
)
def test_a_wrong_form_is_refused(forms: str, expected: str):
    with pytest.raises(ConfigError) as refusal:
        parse_config(f"[species]\nforms = {forms}", where="c")
    assert str(refusal.value).startswith(f"c [species]: 'forms' expected {expected}")
    assert str(refusal.value).endswith(f"received {forms}")


shares = st.lists(st.floats(0.01, 0.99), min_size=1, max_size=30)


@given(shares=shares, correlation=st.floats(0, 1))
def test_a_posterior_is_one_and_does_not_depend_on_the_order(
    shares: list[float], correlation: float
):
    def of(values: list[float]) -> dict[str, float]:
        evidence = SpeciesEvidence(SpeciesSettings(frame_correlation=correlation))
        for share in values:
            evidence.add({"HAP": share, "COD": 1 - share})
            evidence.add({})  # a frame at which nobody looked says nothing
        return evidence.posterior()

    posterior = of(shares)
    assert sum(posterior.values()) == pytest.approx(1)
    assert posterior["HAP"] == pytest.approx(of(shares[::-1])["HAP"])
    odds = np.mean([np.log(share / (1 - share)) for share in shares])
    worth = len(shares) / (1 + (len(shares) - 1) * correlation)
    expected = 1 / (1 + np.exp(-worth * odds))
    assert posterior["HAP"] == pytest.approx(expected, abs=1e-9)


def test_alike_frames_count_as_few_and_one_wild_frame_as_little():
    def after(*frames: float, correlation: float = 0.25) -> float:
        evidence = SpeciesEvidence(SpeciesSettings(frame_correlation=correlation))
        for share in frames:
            evidence.add({"HAP": share, "COD": 1 - share})
        return evidence.posterior()["HAP"]

    assert after(0.7) == pytest.approx(0.7)
    assert after(*[0.7] * 1000) == pytest.approx(after(*[0.7] * 4, correlation=0), abs=1e-3)
    assert after(*[0.7] * 1000, correlation=1) == pytest.approx(0.7)
    assert after(*[0.95] * 9, 0.0) > 0.9
    assert SpeciesEvidence(SpeciesSettings()).best() is None


def write_model(
    path: Path,
    *,
    shape: tuple[object, ...] = (1, 3, 16, 16),
    metadata: dict[str, str] | None = None,
    num_classes: int = 2,
) -> Path:
    """A model whose logits are the mean of each of the first channels, times ten."""
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, shape)
    logits = helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, num_classes])
    constants = [
        helper.make_tensor("ten", TensorProto.FLOAT, [], [10.0]),
        helper.make_tensor("from", TensorProto.INT64, [1], [0]),
        helper.make_tensor("to", TensorProto.INT64, [1], [num_classes]),
        helper.make_tensor("axis", TensorProto.INT64, [1], [1]),
    ]
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["mean"], axes=[2, 3], keepdims=0),
        helper.make_node("Slice", ["mean", "from", "to", "axis"], ["some"]),
        helper.make_node("Mul", ["some", "ten"], ["logits"]),
    ]
    graph = helper.make_graph(nodes, "species", [image], [logits], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, metadata or {})
    onnx.save(model, str(path))
    return path


def make_crop(bgr: tuple[int, int, int], **quality: float) -> FishCrop:
    facts = {"visible_fraction": 1.0, "sharpness": 1.0, "mask_area_px": 9.0} | quality
    camera = Camera.nominal(width=32, height=32)
    return FishCrop(
        frame_index=1,
        timestamp_ns=0,
        track_id=1,
        bbox_xyxy_px=np.array([0.0, 0, 32, 32]),
        image=np.full((32, 32, 3), bgr, np.uint8),
        mask=np.ones((32, 32), bool),
        crop_camera=camera,
        frame_camera=camera,
        quality=CropQuality(touches_border=False, **facts),  # type: ignore[arg-type]
    )


RED, GREEN = (0, 0, 255), (0, 255, 0)


def test_a_classifier_gets_rgb_and_answers_by_code(tmp_path: Path):
    classifier = SpeciesClassifier(
        write_model(tmp_path / "m.onnx", metadata={"species": "HAP,COD"})
    )
    red, green = (classifier.classify(make_crop(colour)) for colour in (RED, GREEN))
    assert red == pytest.approx({"HAP": 1 / (1 + np.exp(-10)), "COD": 1 / (1 + np.exp(10))})
    assert green["COD"] == pytest.approx(red["HAP"])
    assert classifier.classify(make_crop(RED, visible_fraction=0.3)) == {}


@pytest.mark.parametrize("side", [8, "any", 64])
def test_a_model_of_any_size_gets_its_size(tmp_path: Path, side: object):
    path = write_model(
        tmp_path / "m.onnx", shape=(1, 3, side, side), metadata={"species": "HAP,COD"}
    )
    assert SpeciesClassifier(path).classify(make_crop(RED))["HAP"] > 0.99


def test_the_classes_may_stand_beside_the_model_with_a_temperature(tmp_path: Path):
    path = write_model(tmp_path / "m.onnx", num_classes=3)
    (tmp_path / "m.toml").write_text('species = ["HAP", "COD", "ELE"]\ntemperature = 10.0\n')
    found = SpeciesClassifier(path).classify(make_crop(RED))
    assert list(found) == ["HAP", "COD", "ELE"]
    assert found["HAP"] == pytest.approx(np.e / (np.e + 2))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"metadata": {}}, "the FAO codes of two or more species"),
        ({"metadata": {"species": "HAP"}}, "the FAO codes of two or more species"),
        ({"metadata": {"species": "HAP,HAP"}}, "the FAO codes of two or more species"),
        ({"metadata": {"species": "halibut,cod"}}, "the FAO codes of two or more species"),
        ({"metadata": {"species": "HAP,COD,ELE"}}, "3 finite logits, got 2 numbers"),
        ({"metadata": {"species": "HAP,COD", "temperature": "0"}}, "a temperature above 0"),
        ({"metadata": {"species": "HAP,COD"}, "shape": (1, 1, 8, 8)}, r"one input \(1, 3, H, W\)"),
        ({"metadata": {"species": "HAP,COD"}, "shape": (4, 3, 8, 8)}, "that takes one picture"),
    ],
)
def test_what_is_no_classifier_is_refused(tmp_path: Path, changes: dict[str, object], message: str):
    path = write_model(tmp_path / "m.onnx", **changes)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match=message):
        SpeciesClassifier(path)


def test_no_model_and_another_file_are_refused(tmp_path: Path):
    with pytest.raises(ModelError, match="found none"):
        SpeciesClassifier(tmp_path / "none.onnx")
    cv2.imwrite(str(tmp_path / "m.png"), np.zeros((8, 8), np.uint8))
    with pytest.raises(ModelError, match="can't be loaded"):
        SpeciesClassifier(tmp_path / "m.png")
