"""Pair the fish that two cameras saw at the same time, and compare the cameras' clocks."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from stream_dmr.camera import Calibration
from stream_dmr.fitting.shape.stocks import evenly
from stream_dmr.localization.localize_fish import LocalizeSettings
from stream_dmr.localization.two_views import View, rays_apart, second_from_first
from stream_dmr.messages import LocalizedFish
from stream_dmr.reasons import Reason

MOST_APART_S = 0.25  # between two pictures of a fish, to interpolate between them
MOST_OFFSET_S = 10.0  # of the two cameras' clocks; the range that is searched
_MOST_DRIFT = 0.002  # the range that is searched; 29.97 frames/s that are taken for 30 make 0.001
_FRAMES = 12  # of a track that are compared
_COMPARED = 24  # tracks by which the clocks are compared
_FEWEST = 3  # frames that two tracks must share to be one fish
# Distance of the two cameras' rays to head and tail, over the fish's length; with more they see two
# fish. Chosen on simulated pairs: the same fish have 0.01, others 0.1 and more.
_MOST_RAYS_APART = 0.06
# Reasons why one camera refuses a frame, since it sees no depth, and two cameras need not.
BY_ONE_CAMERA = ("", Reason.TURNED_AWAY, Reason.BENT_TOO_FAR, Reason.POOR_FIT)


class FishSightings(NamedTuple):
    """The frames of a fish that one camera saw, well or not."""

    times_ns: Int[np.ndarray, "T"]
    midlines_px: Float[np.ndarray, "T M 2"]
    centers_px: Float[np.ndarray, "T 2"]
    ious: Float[np.ndarray, "T"]  # of the fits
    length_mm: float

    def is_beside(self, others: Iterable["FishSightings"]) -> bool:
        """True if the fish was seen before or after each of these, so may be the same fish."""
        begin, end = self.times_ns[0], self.times_ns[-1]
        return all(end < other.times_ns[0] or other.times_ns[-1] < begin for other in others)

    def at(self, time_ns: int, calibration: Calibration) -> View | None:
        """The view of the fish at a time, interpolated between the frames around it.

        Its IoU is the lower of the two. None if these frames are too far apart or away.
        """
        before = max(int(np.searchsorted(self.times_ns, time_ns, side="right")) - 1, 0)
        after = min(int(np.searchsorted(self.times_ns, time_ns)), len(self.times_ns) - 1)
        t0, t1 = self.times_ns[before], self.times_ns[after]
        if max(t1 - t0, t0 - time_ns, time_ns - t1) > MOST_APART_S * 1e9:
            return None
        share = 0.0 if t1 == t0 else (time_ns - t0) / (t1 - t0)
        return View(
            midline_px=(1 - share) * self.midlines_px[before] + share * self.midlines_px[after],
            center_px=(1 - share) * self.centers_px[before] + share * self.centers_px[after],
            calibration=calibration,
            iou=float(min(self.ious[before], self.ious[after])),
        )


def tracks_of(fish: Iterable[LocalizedFish], calibration: Calibration) -> dict[int, FishSightings]:
    """The tracks of a run by their ids, of the frames that two cameras may use."""
    seen: dict[int, list[tuple[int, np.ndarray, np.ndarray, float, float]]] = {}
    for frame in fish:
        if frame.reason not in BY_ONE_CAMERA or frame.keypoints_px is None:
            continue
        if frame.midline_mm is not None and frame.length_mm is not None:
            midline_px = calibration.camera.project(frame.midline_mm)
            center_px, iou = frame.keypoints_px[1], frame.iou or 0.0
            values = frame.timestamp_ns, midline_px, center_px, iou, frame.length_mm
            seen.setdefault(frame.track_id, []).append(values)
    tracks = dict[int, FishSightings]()
    for track_id, frames in seen.items():
        *values, lengths_mm = (np.array(of_frames) for of_frames in zip(*frames, strict=True))
        tracks[track_id] = FishSightings(*values, length_mm=float(np.median(lengths_mm)))
    return tracks


def well_fitted(
    tracks: Mapping[int, FishSightings], settings: LocalizeSettings
) -> dict[int, FishSightings]:
    """The frames of good fits, of the tracks that have any."""
    found = dict[int, FishSightings]()
    for track_id, fish in tracks.items():
        chosen = fish.ious >= settings.min_iou
        if chosen.any():
            *values, length_mm = fish
            found[track_id] = FishSightings(*(of[chosen] for of in values), length_mm=length_mm)
    return found


class Clocks(NamedTuple):
    """The second camera's clock by the first's."""

    offset_s: float  # the second minus the first, at `pivot_ns`
    drift: float = 0.0  # what the second gains, s in a second
    pivot_ns: int = 0  # of the first

    def second_ns(self, first_ns: int) -> int:
        gained_ns = self.drift * (first_ns - self.pivot_ns)
        return first_ns + round(self.offset_s * 1e9 + gained_ns)


@dataclass(frozen=True, kw_only=True)
class Pairing:
    """The fish of two runs that are the same."""

    clocks: Clocks
    ids: Mapping[int, Sequence[int]]  # of the second run, by the ids of the first
    apart: float  # of the rays to a fish's ends, over its length: median of all pairs


def pair_up(
    first: Mapping[int, FishSightings],
    second: Mapping[int, FishSightings],
    calibrations: tuple[Calibration, Calibration],
    *,
    frame_s: float,
) -> Pairing:
    """Pair the fish, at the offset and the drift of the clocks at which most rays meet.

    Every offset up to 10 s is tried in steps of half a frame, then finer around the best; then
    every drift, which turns the clocks about the fish that met. If one camera's track broke off and
    continued as another track, both are the other camera's fish.
    """
    some = {fish: first[fish] for fish in evenly([*first], _COMPARED)}

    def best(offsets_s: Iterable[float], drifts: Iterable[float], pivot_ns: int = 0) -> Clocks:
        """The clocks at which most rays meet; of equal ones, the first."""

        def cost(clocks: Clocks) -> float:
            apart = _apart(some, second, calibrations, clocks)
            return float(apart[linear_sum_assignment(apart)].sum())

        tried = (Clocks(*clocks, pivot_ns) for clocks in product(offsets_s, drifts))
        return min(tried, key=cost)

    finer = (frame_s / 4, frame_s / 10, frame_s / 40)
    clocks = best(_around(0.0, frame_s / 2, MOST_OFFSET_S), [0.0])
    for step_s in finer:
        clocks = best(_around(clocks.offset_s, step_s, 4 * step_s), [0.0])
    apart = _apart(first, second, calibrations, clocks)
    middles_ns = np.array([track.times_ns[len(track.times_ns) // 2] for track in first.values()])
    if (meets := (apart < _MOST_RAYS_APART).any(axis=1)).any():
        pivot_ns, middle_ns = (int(np.median(of)) for of in (middles_ns[meets], middles_ns))
        span_s = float(np.abs(middles_ns - pivot_ns).max()) / 1e9
        if _MOST_DRIFT * span_s >= frame_s / 2:
            drifts = _around(0.0, frame_s / 2 / span_s, _MOST_DRIFT)
            clocks = best([clocks.offset_s], drifts, pivot_ns)
            offset_s, drift = (clocks.second_ns(middle_ns) - middle_ns) / 1e9, clocks.drift
            for step_s in finer:
                offsets_s = _around(offset_s, step_s, 4 * step_s)
                drifts = _around(drift, step_s / span_s, 4 * step_s / span_s)
                offset_s, drift, _ = clocks = best(offsets_s, drifts, middle_ns)
            apart = _apart(first, second, calibrations, clocks)
    ids, other_ids = [*first], [*second]
    best_pairs = [*zip(*(axis.tolist() for axis in linear_sum_assignment(apart)), strict=True)]
    meeting = np.argwhere(apart < _MOST_RAYS_APART).tolist()
    found = list[tuple[int, int]]()
    for r, c in [*best_pairs, *sorted(meeting, key=lambda pair: apart[*pair])]:
        parts = [first[ids[row]] for row, column in found if column == c]
        others = [second[other_ids[column]] for row, column in found if row == r]
        are_free = first[ids[r]].is_beside(parts) and second[other_ids[c]].is_beside(others)
        if apart[r, c] < _MOST_RAYS_APART and are_free:
            found.append((r, c))
    return Pairing(
        clocks=clocks,
        ids={ids[r]: [other_ids[c] for row, c in found if row == r] for r, _ in found},
        apart=float(np.median([apart[r, c] for r, c in found])) if found else np.nan,
    )


def _around(middle: float, step: float, reach: float) -> list[float]:
    """Evenly spaced values, the nearest to the middle first."""
    most = int(reach / step + 1e-9)
    return [middle + step * n for n in sorted(range(-most, most + 1), key=abs)]


def _apart(
    first: Mapping[int, FishSightings],
    second: Mapping[int, FishSightings],
    calibrations: tuple[Calibration, Calibration],
    clocks: Clocks,
) -> Float[np.ndarray, "A B"]:
    """Distance between the rays to the ends of each pair of tracks, over the fish's length.

    At most `_MOST_RAYS_APART`, also for tracks that were not in view at the same time.
    """
    R, t = second_from_first(*calibrations)
    center_mm = -R.T @ t
    apart = np.full((len(first), len(second)), _MOST_RAYS_APART)
    others = [*second.values()]
    begins, ends = (np.array([other.times_ns[n] for other in others]) for n in (0, -1))
    for row, track in enumerate(first.values()):
        chosen = evenly(range(len(track.times_ns)), _FRAMES)
        times = np.array([clocks.second_ns(time_ns) for time_ns in track.times_ns[chosen].tolist()])
        ends_px = track.midlines_px[chosen][:, [0, -1]].reshape(-1, 2)
        rays = calibrations[0].camera.back_project(ends_px).reshape(-1, 2, 3)
        for column in np.flatnonzero((begins <= times[-1]) & (ends >= times[0])).tolist():
            seen = {
                n: others[column].at(time_ns, calibrations[1])
                for n, time_ns in enumerate(times.tolist())
            }
            both = {n: view.midline_px[[0, -1]] for n, view in seen.items() if view is not None}
            if len(both) < _FEWEST:
                continue
            other_rays = calibrations[1].camera.back_project(np.concatenate([*both.values()])) @ R
            own_rays = rays[[*both]].reshape(-1, 3)
            distances = rays_apart(own_rays, other_rays, center_mm) / track.length_mm
            apart[row, column] = min(float(np.median(distances)), _MOST_RAYS_APART)
    return apart


def off_plane_mm(
    pairing: Pairing,
    first: Mapping[int, FishSightings],
    second: Mapping[int, FishSightings],
    calibrations: tuple[Calibration, Calibration],
) -> float:
    """How far before (+) or behind the reference plane both cameras see the fish: the median."""
    R, t = second_from_first(*calibrations)
    off_mm = list[float]()
    for track_id, others in pairing.ids.items():
        track = first[track_id]
        for n in evenly(range(len(track.times_ns)), _FRAMES):
            time_ns = pairing.clocks.second_ns(int(track.times_ns[n]))
            views = (second[other].at(time_ns, calibrations[1]) for other in others)
            if (view := next((view for view in views if view is not None), None)) is not None:
                own, other = (
                    calibration.camera.back_project(center_px[None])
                    for calibration, center_px in zip(
                        calibrations, (track.centers_px[n], view.center_px), strict=True
                    )
                )
                sides = np.concatenate([own, -other @ R]).T
                along = np.linalg.lstsq(sides, -R.T @ t)[0][0]
                off_mm.append(1.0 - along / calibrations[0].plane.depth_mm(own)[0])
    return float(np.median(off_mm)) * calibrations[0].plane.distance_mm
