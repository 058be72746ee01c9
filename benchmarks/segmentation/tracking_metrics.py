"""IDF1 and HOTA of tracks against the truth, straight from their definitions.

TrackEval (MIT) brings a second OpenCV and motmetrics 1.4 (MIT) calls what NumPy 2 has removed, so
the two formulas stand here. IDF1: Ristani et al., "Performance measures and a data set for
multi-target, multi-camera tracking", ECCV workshops 2016. HOTA: Luiten et al., IJCV 2021.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

THRESHOLDS = np.arange(0.05, 0.99, 0.05)  # of IoU, over which HOTA is a mean
_MATCH_IOU = 0.5  # IoU from which on IDF1 takes two boxes for one

Boxes = Mapping[int, np.ndarray]  # id -> left, top, right, bottom, px


class Score(NamedTuple):
    """How well tracks follow the true ones; each from 0 to 1."""

    idf1: float
    hota: float


def score(truth: Sequence[Boxes], found: Sequence[Boxes]) -> Score:
    """Compare frame by frame; both sequences have an entry for every frame."""
    pairs = [_similarity(t, f) for t, f in zip(truth, found, strict=True)]
    rows = {name: i for i, name in enumerate(sorted({i for boxes in truth for i in boxes}))}
    columns = {name: i for i, name in enumerate(sorted({i for boxes in found for i in boxes}))}
    frames = [
        (np.array([rows[i] for i in t], int), np.array([columns[i] for i in f], int), pair)
        for t, f, pair in zip(truth, found, pairs, strict=True)
    ]
    size = (len(rows), len(columns))
    track_lengths = (
        _track_lengths([f[0] for f in frames], size[0]),
        _track_lengths([f[1] for f in frames], size[1]),
    )
    return Score(idf1=_idf1(frames, size, track_lengths), hota=_hota(frames, size, track_lengths))


def _idf1(
    frames: list, size: tuple[int, int], track_lengths: tuple[np.ndarray, np.ndarray]
) -> float:
    """2 IDTP / (all true boxes + all found boxes), with the best pairing of whole tracks."""
    together = np.zeros(size)
    for truth, found, similarity in frames:
        together[np.ix_(truth, found)] += similarity >= _MATCH_IOU
    pairing = linear_sum_assignment(together, maximize=True)
    return float(
        2 * together[pairing].sum() / max(track_lengths[0].sum() + track_lengths[1].sum(), 1)
    )


def _hota(
    frames: list, size: tuple[int, int], track_lengths: tuple[np.ndarray, np.ndarray]
) -> float:
    """The mean over thresholds of sqrt(DetA AssA), eq. (7) to (10)."""
    overlap = np.zeros(size)
    for truth, found, similarity in frames:
        either = similarity.sum(0, keepdims=True) + similarity.sum(1, keepdims=True) - similarity
        share = np.divide(similarity, either, out=np.zeros_like(similarity), where=either > 0)
        overlap[np.ix_(truth, found)] += share
    lived = track_lengths[0][:, None] + track_lengths[1]
    alignment = overlap / np.maximum(lived - overlap, 1e-12)
    matches = np.zeros((len(THRESHOLDS), *size))
    for truth, found, similarity in frames:
        pairing = linear_sum_assignment(alignment[np.ix_(truth, found)] * similarity, maximize=True)
        for row, column in zip(*pairing, strict=True):
            matches[:, truth[row], found[column]] += similarity[row, column] >= THRESHOLDS
    hits = matches.sum(axis=(1, 2))
    detection = hits / np.maximum(track_lengths[0].sum() + track_lengths[1].sum() - hits, 1)
    jaccard = matches / np.maximum(lived - matches, 1)
    association = (matches * jaccard).sum(axis=(1, 2)) / np.maximum(hits, 1)
    return float(np.sqrt(detection * association).mean())


def _track_lengths(ids: list[np.ndarray], count: int) -> np.ndarray:
    """In how many frames each track has a box."""
    return np.bincount(np.concatenate([*ids, np.zeros(0, int)]), minlength=count)


def _similarity(truth: Boxes, found: Boxes) -> np.ndarray:
    """IoU of every true with every found box."""
    similarity = np.zeros((len(truth), len(found)))
    for i, a in enumerate(truth.values()):
        for j, b in enumerate(found.values()):
            inner = np.prod(np.maximum(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0))
            areas = np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2])
            similarity[i, j] = inner / (areas - inner)
    return similarity
