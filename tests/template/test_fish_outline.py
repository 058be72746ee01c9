"""The outline of a straight fish in a mask: ends, edges, tail fin, and what is refused."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.errors import TemplateError
from stream_dmr.template.fish_outline import fish_outline
from stream_dmr.template.template import load_body_forms
from stream_dmr.template.template_file import bundled_names, load_template

SIZE = 1000  # px, of square pictures


def draw(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    view = np.zeros((SIZE, SIZE), np.uint8)
    for face in np.round(points * 16).astype(np.int32)[faces]:
        cv2.fillConvexPoly(view, face, 1, cv2.LINE_8, 4)
    return view > 0


def side_view(name: str, *, turn_rad: float = 0.0, length_px: float = 800.0) -> tuple:
    """A bundled form's mask, and its snout and fork in it."""
    template = load_template(name)
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    place = length_px * np.array([[cos, -sin], [sin, cos]])

    def project(points: np.ndarray) -> np.ndarray:
        return points[:, :2] @ place.T + SIZE / 2 - 0.5

    head, _, tail = project(template.keypoints)
    return draw(project(template.rest_vertices), template.faces), head, tail


@given(name=st.sampled_from(bundled_names()), turn_deg=st.floats(-180.0, 180.0))
@settings(max_examples=10)
def test_head_and_fork_are_found_in_any_direction(name: str, turn_deg: float):
    mask, head, tail = side_view(name, turn_rad=np.radians(turn_deg))
    outline = fish_outline(mask, name=name)
    np.testing.assert_allclose(outline.head_px, head, atol=2.0)
    np.testing.assert_allclose(outline.tail_px, tail, atol=3.0)


@pytest.mark.parametrize("name", bundled_names())
def test_edges_are_those_of_the_table(name: str):
    form = load_body_forms()[name]
    mask, _, _ = side_view(name)
    outline = fish_outline(mask, name=name)
    assert outline.breadth == pytest.approx(form.breadth, rel=0.03)
    assert outline.total_per_fork == pytest.approx(1 + form.lobe, abs=0.007)
    body = (outline.x > 0.05) & (outline.x < 0.85)
    atol = max(0.004, 0.01 * form.breadth)
    for edge in (outline.upper, outline.lower):
        np.testing.assert_allclose(edge[body], form.half_depth_at(outline.x[body]), atol=atol)
    assert (outline.peduncle == 1) == (name == "eel")


@pytest.mark.parametrize("name", bundled_names())
def test_who_says_where_the_head_is_is_believed(name: str):
    mask, head, tail = side_view(name)
    outline = fish_outline(mask, name=name, head_is_left=False)
    assert abs(outline.head_px[0] - tail[0]) < 0.1 * SIZE
    assert abs(outline.tail_px[0] - head[0]) < 0.1 * SIZE


def test_edges_above_and_below_are_told_apart():
    mask, _, _ = side_view("cod")
    hump = mask.astype(np.uint8)
    cv2.ellipse(hump, (450, 500), (200, 130), 0, 180, 360, 1, -1)
    outline = fish_outline(hump > 0, name="hump")
    middle = (outline.x > 0.4) & (outline.x < 0.46)
    np.testing.assert_allclose(outline.upper[middle], 130 / 800, atol=0.004)
    np.testing.assert_allclose(outline.lower[middle], 0.108, atol=0.004)


def test_specks_and_holes_do_not_matter():
    mask, _, _ = side_view("salmon")
    expected = fish_outline(mask, name="x")
    spoilt = mask.copy()
    spoilt[480:500, 400:420] = False
    spoilt[50:60, 50:60] = True
    outline = fish_outline(spoilt, name="x")
    np.testing.assert_array_equal(outline.upper, expected.upper)
    np.testing.assert_array_equal(outline.head_px, expected.head_px)


def banana() -> np.ndarray:
    view = np.zeros((SIZE, SIZE), np.uint8)
    cv2.ellipse(view, (500, 200), (400, 400), 0, 20, 160, 1, 80)
    return view > 0


def ellipse(breadth: float, *, pointed: float = 0.0, turn_rad: float = 0.0) -> np.ndarray:
    """`pointed`: by how much its right half is narrower, at half way to the end."""
    y, x = np.mgrid[-500:500, -500:500] / 400.0
    along, across = x * np.cos(turn_rad) + y * np.sin(turn_rad), y * np.cos(turn_rad)
    across -= x * np.sin(turn_rad)
    share = across / (breadth * (1 - pointed * np.clip(2 * along, 0, 1)))
    return along**2 + share**2 < 1


@given(breadth=st.floats(0.06, 0.7), turn_deg=st.floats(-180.0, 180.0))
@settings(max_examples=6)
def test_an_outline_that_is_alike_from_both_ends_is_no_fish(breadth: float, turn_deg: float):
    with pytest.raises(TemplateError, match="whose ends are alike"):
        fish_outline(ellipse(breadth, turn_rad=np.radians(turn_deg)), name="x")
    pointed = ellipse(breadth, pointed=0.3, turn_rad=np.radians(turn_deg))
    assert fish_outline(pointed, name="x").peduncle == 1


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (np.zeros((50, 50), bool), "expected a fish in the mask, got an empty mask"),
        (np.pad(np.ones((300, 300), bool), 9), "expected a fish longer than broad"),
        (np.pad(np.ones((10, 60), bool), 9), "expected a fish of at least 100 px"),
        (np.pad(np.ones((1, 1), bool), 9), "expected a fish of at least 100 px, got 0 px"),
        (side_view("cod")[0][:, 200:], "got one cut off by the picture's rim"),
        (side_view("cod")[0] | np.roll(side_view("cod")[0], 300, axis=0), "got 2 parts"),
        (banana(), "expected a straight fish"),
        (ellipse(0.22), "an outline without a tail fin whose ends are alike"),
    ],
    ids=["empty", "square", "small", "one pixel", "cut off", "two", "bent", "ellipse"],
)
def test_what_is_no_straight_fish_is_refused_in_one_line(mask: np.ndarray, message: str):
    with pytest.raises(TemplateError, match=f"side.png: .*{message}") as refusal:
        fish_outline(mask, name="side.png")
    assert "\n" not in str(refusal.value)
