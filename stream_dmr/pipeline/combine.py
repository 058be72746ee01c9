"""Combine two runs of the same fish by two cameras: pair their fish and compare their clocks.

The first camera's recording is replayed from its fits on. A fish that the second camera saw at the
same moment is placed by both cameras, any other fish by the first camera alone.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from stream_dmr.camera import Calibration
from stream_dmr.errors import UserError
from stream_dmr.fitting.shape.stocks import evenly
from stream_dmr.fitting.two_masks import CommonMesh, Sight, TwoMaskFitter
from stream_dmr.localization.localize_fish import LocalizeSettings, localize, mask_std_ratio
from stream_dmr.localization.two_views import (
    View,
    agreed,
    place_between,
    rays_apart,
    second_from_first,
)
from stream_dmr.messages import FishCrop, FittedMesh, FittedShape, LocalizedFish
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.pipeline.session import Setup
from stream_dmr.reasons import Reason
from stream_dmr.recording.header import RunHeader, SecondCamera
from stream_dmr.recording.reading import Recording, decoded_messages, messages_of, open_recordings
from stream_dmr.recording.topics import SECOND_TOPICS, TOPICS, Topics

_MOST_APART_S = 0.25  # between two pictures of a fish, to interpolate between them
_MOST_OFFSET_S = 10.0  # of the two cameras' clocks; the range that is searched
_MOST_DRIFT = 0.002  # the range that is searched; 29.97 frames/s that are taken for 30 make 0.001
_FRAMES = 12  # of a track that are compared
_COMPARED = 24  # tracks by which the clocks are compared
_FEWEST = 3  # frames that two tracks must share to be one fish
# Distance of the two cameras' rays to head and tail, over the fish's length; with more they see two
# fish. Chosen on simulated pairs: the same fish have 0.01, others 0.1 and more.
_MOST_RAYS_APART = 0.06
# Reasons why one camera refuses a frame, since it sees no depth, and two cameras need not.
_BY_ONE_CAMERA = ("", Reason.TURNED_AWAY, Reason.BENT_TOO_FAR, Reason.POOR_FIT)
# IoU of the common mesh with both masks that makes up for a poor fit by one camera, and for fits
# that contradict each other. Chosen on simulated pairs: such lengths are right to 2.5 % (rms).
_GOOD_IOU = 0.88
# Residuals of both pictures, in their stds; with more they show two fish, or a camera was moved.
_MOST_MISFIT = 4.0
_LEAST_APART_DEG = 3  # between the cameras, seen from the fish; less hardly shows depth
# Distance of the rays over the length: usual on simulated pairs, and large enough for a warning.
_RAYS_USUAL, _RAYS_WARN = 0.01, 0.03
# Distance of the fish from the reference plane, over `plane_std_mm`. The rays of a camera that was
# turned or moved sideways still meet, but elsewhere: after one degree 6 stds away, with lengths 3 %
# off. Five simulated pairs with the right calibrations, 8 to 60 degrees apart: 0.4 at most.
_PLANE_WARN = 3.0


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
        if max(t1 - t0, t0 - time_ns, time_ns - t1) > _MOST_APART_S * 1e9:
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
        if frame.reason not in _BY_ONE_CAMERA or frame.keypoints_px is None:
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


class RecordedFits:
    """The crops and fits of a recording, read along with the time and then forgotten."""

    def __init__(self, recording: Recording, of: Topics) -> None:
        self._messages = decoded_messages(recording, [FishCrop, FittedMesh], of=of)
        self._crops: dict[tuple[int, int], FishCrop] = {}
        self._fits: dict[int, list[tuple[FishCrop, FittedShape]]] = {}
        self._read_ns = -1  # time of the last fit that was read

    def nearest(self, track_id: int, time_ns: int) -> tuple[FishCrop, FittedShape] | None:
        """The fit of a fish that is nearest to a time; times must not fall by much.

        None if there is none nearby: removed to free disk space, say.
        """
        reach_ns = round(_MOST_APART_S * 1e9)
        while self._read_ns <= time_ns + reach_ns and (read := next(self._messages, None)):
            message, _ = read
            if isinstance(message, FishCrop):
                self._crops[message.frame_index, message.track_id] = message
            elif isinstance(message, FittedMesh):
                self._read_ns = message.timestamp_ns
                crop = self._crops.pop((message.frame_index, message.track_id), None)
                if crop is not None and message.shape is not None:
                    fits = self._fits.setdefault(message.track_id, [])
                    fits.append((crop, message.shape))
        since_ns = time_ns - 4 * reach_ns
        self._fits = {
            track: lately
            for track, fits in self._fits.items()
            if (lately := [fit for fit in fits if fit[0].timestamp_ns > since_ns])
        }
        near = self._fits.get(track_id, [])
        return min(near, key=lambda fit: abs(fit[0].timestamp_ns - time_ns), default=None)


class CommonMeshes:
    """Fits a mesh to the masks that two runs recorded of a fish."""

    def __init__(self, fitter: TwoMaskFitter, first: RecordedFits, second: RecordedFits) -> None:
        self._fitter, self._first, self._second = fitter, first, second

    def mesh(self, fish: FittedMesh, other: int, second: View, time_ns: int) -> CommonMesh | None:
        """The mesh at the time of the first camera's fit; None without masks.

        `other`, `second`, `time_ns`: the fish's id and its view by the second camera, and the time
        there.
        """
        own = self._first.nearest(fish.track_id, fish.timestamp_ns)
        seen = self._second.nearest(other, time_ns)
        if own is None or seen is None:
            return None
        centers_px = np.stack([second.center_px, seen[1].keypoints_px[1]])
        rays = second.calibration.camera.back_project(centers_px)
        return self._fitter.fit(Sight(*own, np.zeros(3)), Sight(*seen, rays[0] - rays[1]))


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
    clocks = best(_around(0.0, frame_s / 2, _MOST_OFFSET_S), [0.0])
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


def _off_plane_mm(
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


@dataclass(frozen=True, kw_only=True)
class SecondRun:
    """The run of the other camera of two."""

    camera: SecondCamera
    recording: Recording  # with its messages
    topics: Topics  # of its messages there
    node: "LocalizeByTwo | None"  # None if fish are not placed again


def open_second(
    first: Recording, second: Path | None, setup: Setup, observer: RunObserver, *, places_fish: bool
) -> SecondRun | None:
    """The run to combine with the first, or combined with it before; None for a single camera."""
    camera = first.header.second
    if second is not None:
        recording, topics = open_recordings([second]), TOPICS
        header = recording.header
    elif camera is not None:
        recording, topics, header = first, SECOND_TOPICS, camera.header
    else:
        return None
    node = None
    if places_fish:
        node = _localize_by_two(first, recording, topics, header, setup, observer)
        offset_ns = round(node.pairing.clocks.offset_s * 1e9)
        ids = {other: first for first, others in node.pairing.ids.items() for other in others}
        camera = SecondCamera(header=header, offset_ns=offset_ns, ids=ids)
    assert camera is not None
    return SecondRun(camera=camera, recording=recording, topics=topics, node=node)


def _localize_by_two(
    first: Recording,
    second: Recording,
    topics: Topics,
    header: RunHeader,
    setup: Setup,
    observer: RunObserver,
) -> "LocalizeByTwo":
    """The node that places the fish of two runs. Raises UserError if they saw no fish together.

    `topics`: of the other run's messages in `second`, with its `header`. Fish of the first run are
    placed by its fits, since a recording that was combined before has them as two cameras placed
    them.
    """
    calibration, other = setup.calibration, header.calibration
    if calibration is None or other is None:
        raise UserError(
            "expected two runs with --calibration, of the same reference plane; found one without"
        )
    R, t = second_from_first(calibration, other)
    base_mm = float(np.linalg.norm(R.T @ t))  # from camera to camera
    apart_deg = float(np.degrees(np.arctan2(base_mm, calibration.plane.distance_mm)))
    if apart_deg < _LEAST_APART_DEG:
        raise UserError(
            f"expected two cameras at least {_LEAST_APART_DEG} degrees apart, as seen from the "
            f"fish, got {apart_deg:.1f} degrees"
        )
    alone = (
        localize(mesh, settings=setup.config.localize, calibration=calibration)
        for mesh in messages_of(first, FittedMesh)
    )
    messages = decoded_messages(second, [LocalizedFish], of=topics)
    seen = (message for message, _ in messages if isinstance(message, LocalizedFish))
    tracks, others = tracks_of(alone, calibration), tracks_of(seen, other)
    steps_ns = np.concatenate([[], *(np.diff(track.times_ns) for track in tracks.values())])
    good, other_good = (well_fitted(run, setup.config.localize) for run in (tracks, others))
    pairing = None
    if len(steps_ns) and others:
        frame_s = float(np.median(steps_ns)) / 1e9
        pairing = pair_up(good, other_good, (calibration, other), frame_s=frame_s)
    if pairing is None or not pairing.ids:
        raise UserError(
            f"expected fish that both cameras saw within {_MOST_OFFSET_S:g} s; found none among "
            f"{len(tracks)} and {len(others)} with good frames. Are both calibrations of the same "
            "reference plane, with its zero and its axes?"
        )
    drift = f"{pairing.clocks.drift:+.2%}"
    gains = "" if drift.endswith("0.00%") else f" and gains {drift}"
    observer.notice(
        f"{len(pairing.ids)} of {len(tracks)} fish were seen by both cameras; the second clock is "
        f"{pairing.clocks.offset_s:+.2f} s off{gains}, and the rays to a fish's ends pass "
        f"{pairing.apart:.1%} of its length apart"
    )
    if pairing.apart > _RAYS_WARN:
        observer.warn(
            f"the rays to a fish's ends pass {pairing.apart:.1%} of its length apart, usually "
            f"{_RAYS_USUAL:.1%}: lengths may be further off than their intervals say; has a camera "
            "been moved since its calibration, or are the calibrations of different planes?"
        )
    off_mm = _off_plane_mm(pairing, good, other_good, (calibration, other))
    if abs(off_mm) > _PLANE_WARN * setup.config.localize.plane_std_mm:
        observer.warn(
            f"the two cameras see the fish {abs(off_mm):.0f} mm "
            f"{'before' if off_mm > 0 else 'behind'} the reference plane: unless they do hang "
            f"there, lengths are {abs(off_mm) / calibration.plane.distance_mm:.0%} off; has a "
            "camera been moved since its calibration, or is one that of another camera?"
        )
    settings, common = setup.config.fit_mesh, None
    if settings.scans_sizes:  # the paper's solver and blend are left as in the paper
        fitter = TwoMaskFitter(
            setup.template,
            setup.candidates,
            settings,
            second_joints=header.template.joints,
            second_from_first=(R, t),
        )
        common = CommonMeshes(fitter, RecordedFits(first, TOPICS), RecordedFits(second, topics))
    return LocalizeByTwo(setup.config.localize, calibration, others, other, pairing, common)


@dataclass(eq=False)
class LocalizeByTwo:
    """A node in the place of Localize: places fish by two cameras if both saw them.

    Of such a fish only the frames that both cameras saw count.
    """

    settings: LocalizeSettings
    calibration: Calibration
    second: Mapping[int, FishSightings]
    second_calibration: Calibration
    pairing: Pairing
    common: CommonMeshes | None = None

    def __post_init__(self) -> None:
        # Frames that the second camera fitted poorly are tried where the others don't suffice.
        self._seconds = well_fitted(self.second, self.settings), self.second

    def step(self, mesh: FittedMesh, /) -> Sequence[LocalizedFish]:
        alone = localize(mesh, settings=self.settings, calibration=self.calibration)
        others = self.pairing.ids.get(mesh.track_id, ())
        if not others or alone.reason not in _BY_ONE_CAMERA or alone.midline_mm is None:
            return [alone]
        time_ns = self.pairing.clocks.second_ns(mesh.timestamp_ns)
        placed = list[LocalizedFish]()
        for second in self._seconds:
            for other in others:
                fish = second.get(other)
                view = fish and fish.at(time_ns, self.second_calibration)
                if view is not None:
                    placed.append(self._place(mesh, alone, other, view, time_ns))
                    if placed[-1].accepted:
                        return [placed[-1]]
        unseen = replace(alone, accepted=False, reason=alone.reason or Reason.SEEN_BY_ONE)
        return [placed[0] if placed else unseen]

    def _place(
        self, mesh: FittedMesh, alone: LocalizedFish, other: int, second: View, time_ns: int
    ) -> LocalizedFish:
        """The fish by both cameras, of which the second saw it as its fish `other` at `time_ns`."""
        assert alone.keypoints_px is not None, "a placed fish was fitted"
        assert alone.keypoints_mm is not None, "a placed fish was fitted"
        assert alone.midline_mm is not None, "a placed fish was fitted"
        first = View(
            midline_px=self.calibration.camera.project(alone.midline_mm),
            center_px=alone.keypoints_px[1],
            calibration=self.calibration,
            iou=alone.iou or 0.0,
        )
        placed = place_between((first, second), alone.midline_mm)
        if placed.misfit > _MOST_MISFIT:  # a camera may take the head for the tail
            turned = second._replace(midline_px=second.midline_px[::-1])
            placed = min(
                placed,
                place_between((first, turned), alone.midline_mm),
                key=lambda placement: placement.misfit,
            )
        common = self.common and self.common.mesh(mesh, other, second, time_ns)
        if common is not None:
            placed = agreed(placed, common.midline_mm, common.iou)
        line = placed.midline_mm
        part = np.linalg.norm(alone.midline_mm - alone.keypoints_mm[1], axis=1).argmin()
        chord_mm = float(np.linalg.norm(line[0] - line[-1]))
        reason = ""
        if common is None or common.iou < _GOOD_IOU:
            if alone.reason == str(Reason.POOR_FIT):
                reason = Reason.POOR_FIT
            elif second.iou < self.settings.min_iou:
                reason = Reason.SEEN_BY_ONE
            elif placed.misfit > _MOST_MISFIT:
                reason = Reason.CAMERAS_DISAGREE
        if not np.isfinite(placed.length_std_mm):
            reason = Reason.CAMERAS_DISAGREE
        return replace(
            alone,
            keypoints_mm=line[[0, part, -1]],
            midline_mm=line,
            bending_ratio=placed.length_mm / chord_mm,
            length_mm=placed.length_mm,
            length_std_mm=placed.length_std_mm,
            shared_std_ratio=mask_std_ratio(mesh.quality),
            accepted=not reason,
            reason=reason,
        )

    def close(self) -> Sequence[LocalizedFish]:
        return []
