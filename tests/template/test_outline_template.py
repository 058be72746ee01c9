"""Templates from masks of a straight fish, and the command that makes them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from stream_dmr.errors import TemplateError
from stream_dmr.template.fish_outline import fish_outline
from stream_dmr.template.from_masks import nearest_form, template_from_masks
from stream_dmr.template.template_file import bundled_names, load_template
from tests.support.command import invoke
from tests.support.template_files import body_of


def write_views(folder: Path, name: str, *, turn_top: bool = False) -> tuple[Path, Path]:
    """Masks of a bundled form from the side and, at another scale, from above."""
    template = load_template(name)
    paths = []
    for view, axis, scale in (("side", 1, 900.0), ("top", 2, 500.0)):
        points = template.rest_vertices[:, [0, axis]] * scale * [1, -1] + [700, 400]
        mask = np.zeros((800, 1400), np.uint8)
        for face in np.round(points * 16).astype(np.int32)[template.faces]:
            cv2.fillConvexPoly(mask, face, 255, cv2.LINE_8, 4)
        path = folder / f"{view}.png"
        cv2.imwrite(str(path), mask[:, ::-1] if turn_top and view == "top" else mask)
        paths.append(path)
    return paths[0], paths[1]


# A flat, a long and a usual body in every run.
FORMS = [
    name if name in ("cod", "eel", "halibut") else pytest.param(name, marks=pytest.mark.slow)
    for name in bundled_names()
]


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize("turn_top", [False, True])
def test_two_views_of_a_fish_give_its_body_back(tmp_path: Path, name: str, turn_top: bool):
    side, top = write_views(tmp_path, name, turn_top=turn_top)
    made = template_from_masks(side, top=top, name=name)
    expected, template = load_template(name), made.template
    body, original = body_of(template), body_of(expected)
    assert body.is_watertight
    assert body.volume == pytest.approx(original.volume, rel=0.06)  # an eel is 30 px thick
    np.testing.assert_allclose(body.extents, original.extents, atol=0.006)
    np.testing.assert_allclose(template.keypoints, expected.keypoints, atol=1e-9)
    assert template.total_per_fork == pytest.approx(expected.total_per_fork, abs=0.007)


@pytest.mark.parametrize("name", FORMS)
def test_the_silhouette_keeps_the_fork_of_the_tail(tmp_path: Path, name: str):
    side, top = write_views(tmp_path, name)
    template = template_from_masks(side, top=top, name=name).template
    seen = cv2.imread(str(side), cv2.IMREAD_GRAYSCALE) > 0
    drawn = np.zeros(seen.shape, np.uint8)
    points = template.rest_vertices[:, :2] * 900 * [1, -1] + [700, 400]
    for face in np.round(points * 16).astype(np.int32)[template.faces]:
        cv2.fillConvexPoly(drawn, face, 1, cv2.LINE_8, 4)
    overlap = (seen & (drawn > 0)).sum() / (seen | (drawn > 0)).sum()
    assert overlap > 0.96


@pytest.mark.parametrize("name", FORMS)
def test_without_a_view_from_above_the_nearest_form_gives_the_thickness(tmp_path: Path, name: str):
    side, _ = write_views(tmp_path, name)
    made = template_from_masks(side, name=name)
    assert made.thickness_source == f"the bundled body form nearest in outline, {name}"
    assert body_of(made.template).volume == pytest.approx(
        body_of(load_template(name)).volume, rel=0.04
    )


def test_thickness_is_a_share_of_the_breadth(tmp_path: Path):
    side, top = write_views(tmp_path, "cod")
    made = template_from_masks(side, thickness=0.5, name="cod")
    _, breadth, thickness = body_of(made.template).extents
    assert made.thickness == pytest.approx(0.5)
    assert thickness == pytest.approx(0.5 * breadth, rel=0.02)
    both = {"--side": str(side), "--top": str(top), "--thickness": "0.5"}
    refused = invoke("make-template", {**both, "--out": str(tmp_path / "both.ply")})
    assert (refused.code, "got both" in refused.error) == (2, True)
    assert not (tmp_path / "both.ply").exists()


def test_upper_and_lower_edge_may_differ(tmp_path: Path):
    side, _ = write_views(tmp_path, "cod")
    mask = cv2.imread(str(side), cv2.IMREAD_GRAYSCALE)
    cv2.ellipse(mask, (650, 400), (250, 138), 0, 180, 360, 255, -1)  # a hump on the back
    cv2.imwrite(str(side), mask)
    low, high = body_of(template_from_masks(side, name="cod").template).bounds[:, 1]
    assert sorted((-low, high)) == pytest.approx([0.113, 138 / 900], abs=0.004)


def test_every_form_is_nearest_to_itself(tmp_path: Path):
    for name in bundled_names():
        mask = cv2.imread(str(write_views(tmp_path, name)[0]), cv2.IMREAD_GRAYSCALE) > 0
        assert nearest_form(fish_outline(mask, name=name)).name == name


@pytest.mark.parametrize("thickness", [0.0, -0.1, 2.1, float("nan")])
def test_an_impossible_thickness_is_refused(tmp_path: Path, thickness: float):
    side, _ = write_views(tmp_path, "cod")
    with pytest.raises(TemplateError, match="--thickness: expected thickness over breadth"):
        template_from_masks(side, thickness=thickness, name="cod")


def test_the_command_writes_a_template_and_says_what_it_found(tmp_path: Path):
    side, top = write_views(tmp_path, "tuna")
    out = tmp_path / "mine.ply"
    done = invoke("make-template", {"--side": str(side), "--top": str(top), "--out": str(out)})
    assert done.code == 0, done.err
    assert "head found at pixel 249,400, tail at 115" in done.out
    assert "of the breadth: the view from above, top.png" in done.out
    template = load_template(out)
    assert (template.name, template.tail_gives) == ("mine", "fork")


@pytest.mark.parametrize(
    ("content", "message", "name"),
    [
        (None, "can't be read", "side.png"),
        (b"", "expected a picture of a mask", "side.png"),
        (b"text", "of a mask", "side.png"),
        (None, "got a JPEG", "side.JPG"),
    ],
)
def test_a_mask_that_is_none_is_refused_in_one_line(
    tmp_path: Path, content: bytes | None, message: str, name: str
):
    side = tmp_path / name
    if content is not None:
        side.write_bytes(content)
    with pytest.raises(TemplateError, match=f"{name}: expected a .*mask.*{message}|{message}"):
        template_from_masks(side, name="x")


@pytest.mark.parametrize("name", ["salmon", "deep", "slender"])
def test_two_photographs_give_the_species_mean_mesh(scenes: Path, name: str):
    scene = scenes / name
    made = template_from_masks(scene / "side.png", top=scene / "top.png", name=name)
    mean = body_of(load_template(scene / "species.ply"))
    body = body_of(made.template)
    np.testing.assert_allclose(body.extents, mean.extents, atol=0.002)
    assert body.volume == pytest.approx(mean.volume, rel=0.015)
