"""Combine two runs of the same fish by two cameras.

The first camera's recording is replayed from its fits on. A fish that the second camera saw at the
same moment is placed by both cameras, any other fish by the first camera alone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stream_dmr.camera import Calibration
from stream_dmr.errors import UserError
from stream_dmr.fitting.two_masks import CommonMesh, Sight, TwoMaskFitter
from stream_dmr.localization.localize_fish import LocalizeSettings, localize, mask_std_ratio
from stream_dmr.localization.two_views import View, agreed, place_between, second_from_first
from stream_dmr.messages import FishCrop, FittedMesh, FittedShape, LocalizedFish
from stream_dmr.pipeline.pair_fish import (
    BY_ONE_CAMERA,
    MOST_APART_S,
    MOST_OFFSET_S,
    FishSightings,
    Pairing,
    off_plane_mm,
    pair_up,
    tracks_of,
    well_fitted,
)
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.pipeline.session import Setup
from stream_dmr.reasons import Reason
from stream_dmr.recording.header import RunHeader, SecondCamera
from stream_dmr.recording.reading import Recording, decoded_messages, messages_of, open_recordings
from stream_dmr.recording.topics import SECOND_TOPICS, TOPICS, Topics

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
        reach_ns = round(MOST_APART_S * 1e9)
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
            f"expected fish that both cameras saw within {MOST_OFFSET_S:g} s; found none among "
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
    off_mm = off_plane_mm(pairing, good, other_good, (calibration, other))
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
        if not others or alone.reason not in BY_ONE_CAMERA or alone.midline_mm is None:
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
