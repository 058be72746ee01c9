"""Blobs that several fish share are split where the fish are predicted; single fish stay whole."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.detection.detector import Candidate
from stream_dmr.geometry import oriented_extent
from stream_dmr.tracking.split_blobs import PredictedSilhouette, split_merged_blob

SIZE = (400, 500)


def fish(x, y, *, length=160, width=50, angle=90.0):
    canvas = np.zeros(SIZE, np.uint8)
    cv2.ellipse(canvas, ((x, y), (length, width), angle), 1, cv2.FILLED)
    return canvas > 0


def candidate_of(mask):
    x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
    box = np.array([x, y, x + w, y + h], np.float64)
    return Candidate(bbox_xyxy_px=box, score=0.8, foreground=mask[y : y + h, x : x + w])


def predicted(mask, *, off=(0.0, 0.0)):
    one = candidate_of(mask)
    return PredictedSilhouette(
        shape=one.foreground,
        corner=one.bbox_xyxy_px[:2] + off,
        length_px=oriented_extent(mask)[1],
        area_px=float(mask.sum()),
        is_whole=True,
    )


def in_frame(one):
    mask = np.zeros(SIZE, bool)
    x0, y0, x1, y1 = one.bbox_xyxy_px.astype(int)
    mask[y0:y1, x0:x1] = one.foreground
    return mask


def share(part_of, mask):
    return (part_of & mask).sum() / part_of.sum()


offsets = st.tuples(st.floats(-6, 6), st.floats(-6, 6))


@given(st.integers(0, 45), st.integers(90, 130), offsets, offsets)
def test_two_known_fish_get_their_own_pieces(across, along, one_off, other_off):
    one, other = fish(200, 120), fish(200 + across, 120 + along)
    pieces = split_merged_blob(
        candidate_of(one | other),
        [predicted(one, off=one_off), predicted(other, off=other_off)],
    )
    assert len(pieces) == 2
    for piece, true, others in zip(
        pieces, (one & ~other, other & ~one), (other & ~one, one & ~other), strict=True
    ):
        assert share(others, in_frame(piece)) < 0.25
        assert share(true, in_frame(piece)) > 0.65
        assert piece.score == 0.8


def test_a_piece_has_its_place_in_the_scene_and_the_looks_of_the_whole():
    one, other, camera_px = fish(200, 120), fish(220, 220), np.array([7.0, -3.0])
    whole = candidate_of(one | other)
    middle = whole.bbox_xyxy_px.reshape(2, 2).mean(axis=0)
    whole = replace(whole, place_px=middle + camera_px, looks=0.4)
    for piece in split_merged_blob(whole, [predicted(one), predicted(other)]):
        middle = piece.bbox_xyxy_px.reshape(2, 2).mean(axis=0)
        np.testing.assert_allclose(piece.place_px, middle + camera_px)
        assert piece.looks == 0.4


@given(st.integers(-40, 40), offsets)
def test_an_unknown_fish_is_the_remainder(across, off):
    known, new = fish(250, 120), fish(250 + across, 250)
    pieces = split_merged_blob(candidate_of(known | new), [predicted(known, off=off)])
    assert len(pieces) == 2
    assert share(new & ~known, in_frame(pieces[1])) > 0.65
    assert share(known & ~new, in_frame(pieces[1])) < 0.2


@pytest.mark.parametrize("width", [20, 50, 80])
@pytest.mark.parametrize("off", [(0, 0), (15, 25), (-10, -40)])
def test_a_fish_that_turns_or_was_predicted_elsewhere_stays_whole(width, off):
    before, now = fish(250, 200, width=20), fish(250, 200, width=width)
    assert len(split_merged_blob(candidate_of(now), [predicted(before, off=off)])) == 1


def test_a_line_at_a_fish_is_no_second_fish():
    before = fish(250, 250)
    now = before.copy()
    now[20:200, 246:252] = True
    assert len(split_merged_blob(candidate_of(now), [predicted(before)])) == 1


def test_boxes_alone_are_not_split():
    whole = candidate_of(fish(200, 120) | fish(210, 240))
    box = Candidate(bbox_xyxy_px=whole.bbox_xyxy_px, score=1.0)
    assert split_merged_blob(box, [predicted(fish(200, 120))]) == [box]


@pytest.mark.parametrize("y", [110, 170])  # at 170 half of where it would be is the other one
def test_a_fish_that_has_gone_gets_no_piece_of_another(y):
    gone, here = fish(250, y), fish(250, 250)
    assert len(split_merged_blob(candidate_of(here), [predicted(gone), predicted(here)])) == 1
