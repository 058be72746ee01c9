"""Two runs of the same fish become one: paired by time and place, placed by both cameras."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

import stream_dmr as sd
from stream_dmr.calibration.calibration_file import load_calibration, save_calibration
from stream_dmr.camera import ReferencePlane
from stream_dmr.errors import UserError
from stream_dmr.geometry import box_iou
from stream_dmr.localization.localize_fish import LocalizeSettings
from stream_dmr.localization.two_views import second_from_first
from stream_dmr.messages import FishCrop, FittedMesh, LocalizedFish
from stream_dmr.pipeline.combine import LocalizeByTwo
from stream_dmr.pipeline.pair_fish import FishSightings, pair_up, tracks_of
from stream_dmr.pipeline.replay_recording import replay
from stream_dmr.pipeline.run_options import ReplayOptions
from stream_dmr.reasons import Reason
from stream_dmr.recording.reading import decoded_messages, messages_of, open_recordings
from stream_dmr.recording.topics import SECOND_TOPICS
from stream_dmr.recording.view_geometry import MeshRebuilder, place_fit
from stream_dmr.simulation import SECOND, simulate
from stream_dmr.simulation.rail_scene import FPS, second_camera
from tests.localization.test_two_views import FIRST
from tests.support.command import invoke, rows
from tests.support.fish_run import measure

FRAME_S = 1 / FPS


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Three fish, seen by two cameras 35 degrees apart, each run by itself."""
    folder = tmp_path_factory.mktemp("two")
    simulate(folder, num_fish=3, num_frames=30, preset="realistic", seed=21, second_deg=35.0)
    for place in (folder, folder / SECOND):
        sd.measure(
            place / "video.mp4",
            out=place / "run",
            calibration=place / "calibration.yaml",
            masks=place / "masks",
            template=folder / "species.ply",
        )
    return folder


@pytest.fixture(scope="module")
def combined(scene):
    result = invoke(f"combine {scene / 'run'} {scene / SECOND / 'run'} --out {scene / 'both'}")
    assert result.code == 0, result.err
    return result


def errors(scene, run):
    true = {row["track_id"]: float(row["length_mm"]) for row in rows(scene / "truth.csv")}
    return [
        float(row["length_mm"]) / true[row["track_id"]] - 1
        for row in rows(scene / run / "lengths.csv")
        if row["length_mm"]
    ]


def test_fish_that_both_see_are_within_two_percent(scene, combined):
    """Clocks that are in step to a few milliseconds leave the third fish its few frames."""
    assert "3 of 3 fish were seen by both cameras" in combined.err
    single, both = errors(scene, "run"), errors(scene, "both")
    changed = [new for old, new in zip(single, both, strict=True) if old != new]
    assert len(changed) == 3
    assert np.abs(changed).max() < 0.02


def test_the_recording_holds_the_fish_where_both_see_them(scene, combined):
    recording = open_recordings([scene / "both"])
    fish = [one for one in messages_of(recording, LocalizedFish) if one.accepted]
    assert len(fish) > 20
    for one in fish:
        steps = np.linalg.norm(np.diff(one.midline_mm, axis=0), axis=1)
        assert steps.sum() == pytest.approx(one.length_mm)
    checked = invoke(f"replay {scene / 'both'} --from smooth --check")
    assert checked.code == 0, checked.out
    single = [one for one in messages_of(open_recordings([scene / "run"]), LocalizedFish)]
    again = [one for one in messages_of(recording, LocalizedFish)]
    assert [(one.frame_index, one.track_id) for one in single] == [
        (one.frame_index, one.track_id) for one in again
    ]
    assert {one.reason for one in again} <= {"", *map(str, Reason)}


@pytest.mark.parametrize(
    ("stage", "name"),
    [
        ("localize", "recording.mcap"),
        pytest.param("localize", "recording.rrd", marks=pytest.mark.slow),
        pytest.param("smooth", "recording.mcap", marks=pytest.mark.slow),
        pytest.param("smooth", "recording.rrd", marks=pytest.mark.slow),
    ],
)
def test_a_replay_gives_the_same_lengths(scene, combined, stage, name, tmp_path):
    replayed = invoke(f"replay {scene / 'both' / name} --from {stage} --out {tmp_path}")
    assert replayed.code == 0, replayed.err
    for table in ("lengths.csv", "frames.csv"):
        assert (tmp_path / table).read_bytes() == (scene / "both" / table).read_bytes()
    again = open_recordings([tmp_path])
    assert seconds(again) == seconds(open_recordings([scene / "both"]))


@pytest.mark.parametrize("stage", ["crop", "fit"])
def test_a_replay_from_what_only_one_camera_knows_is_refused(scene, combined, stage):
    result = invoke(f"replay {scene / 'both'} --from {stage}")
    assert result.code == 2
    assert "combine" in result.error


def seconds(recording):
    return of_kinds(recording, of=SECOND_TOPICS)


def of_kinds(recording, **of):
    """Encodings by type: an .rrd merges the types in another order."""
    return {kind: [data for _, data in recording.payloads([kind], **of)] for kind in SECOND_TOPICS}


def test_the_recording_holds_both_runs(scene, combined):
    both, second = (open_recordings([scene / one]) for one in ("both", f"{SECOND}/run"))
    assert seconds(both) == of_kinds(second)
    assert both.header.second is not None
    assert both.header.second.header.attachments() == second.header.attachments()


def test_the_view_has_both_pictures_and_the_meshes(scene, combined):
    chunks = RrdReader(str(scene / "both" / "recording.rrd")).stream()
    drawn = {str(chunk.entity_path) for chunk in chunks if not chunk.is_static}
    cameras = {f"/scene/{one}/{part}" for one in ("camera", "second/camera") for part in VIEWED}
    assert cameras | {"/scene/fish/1/mesh", "/scene/second/camera/fish/1/outline"} <= drawn


VIEWED = ("frame", "masks")


def test_the_common_mesh_is_where_the_second_camera_sees_the_fish(scene, combined):
    """The first camera's mesh, bent along the midline of both, fills the second one's box."""
    both = open_recordings([scene / "both"])
    second = both.header.second
    first = both.header.calibration
    R, t = second_from_first(first, second.header.calibration)
    crops = {
        (one.frame_index, second.ids.get(one.track_id)): one.bbox_xyxy_px
        for one, _ in decoded_messages(both, [FishCrop], of=SECOND_TOPICS)
    }
    fits = {(one.frame_index, one.track_id): one for one in messages_of(both, FittedMesh)}
    meshes = MeshRebuilder(both.header.template, both.header.candidates)
    overlaps = []
    for fish in messages_of(both, LocalizedFish):
        key = fish.frame_index, fish.track_id
        if fish.accepted and key in crops:
            vertices, _, _ = place_fit(meshes.with_vertices(fits[key]).shape, fish)
            pixels = second.header.calibration.camera.project(vertices @ R.T + t)
            box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
            overlaps.append(box_iou(box, crops[key]))
    assert len(overlaps) > 10
    assert np.median(overlaps) > 0.8


def test_a_head_that_one_camera_takes_for_the_tail_changes_no_length(scene, combined):
    first, second = (open_recordings([scene / one / "run"]) for one in ("", SECOND))
    first_calibration, other = first.header.calibration, second.header.calibration
    tracks, others = (
        tracks_of(messages_of(one, LocalizedFish), one.header.calibration)
        for one in (first, second)
    )
    pairing = pair_up(tracks, others, (first_calibration, other), frame_s=FRAME_S)
    turned = {
        track_id: one._replace(midlines_px=one.midlines_px[:, ::-1])
        for track_id, one in others.items()
    }
    nodes = [
        LocalizeByTwo(LocalizeSettings(), first_calibration, sightings, other, pairing)
        for sightings in (others, turned)
    ]
    num_accepted = 0
    for mesh in messages_of(first, FittedMesh):
        (straight,), (swapped,) = (node.step(mesh) for node in nodes)
        if straight.accepted:
            num_accepted += 1
            assert swapped.accepted
            assert swapped.length_mm == pytest.approx(straight.length_mm, rel=1e-3)
    assert num_accepted > 20


def test_a_poor_fit_by_one_camera_counts_where_a_mesh_fits_both_masks(scene, combined, tmp_path):
    """By a limit that many of these good fits fail; the mesh is held to a limit of its own."""
    limit = 0.945
    config = f"[localize]\nmin_iou = {limit}\n[recording]\nrrd = false\n"
    (tmp_path / "config.toml").write_text(config)
    request = ReplayOptions(
        recordings=[scene / "run"],
        first="localize",
        second=scene / SECOND / "run",
        config=tmp_path / "config.toml",
        out=tmp_path / "both",
    )
    replay(request, stop=threading.Event())
    fish = [*messages_of(open_recordings([tmp_path / "both"]), LocalizedFish)]
    poor = [one for one in fish if one.iou is not None and one.iou < limit and one.accepted]
    assert len(poor) > 2
    true = {row["track_id"]: float(row["length_mm"]) for row in rows(scene / "truth.csv")}
    off = [one.length_mm / true[str(one.track_id)] - 1 for one in poor]
    assert np.abs(off).max() < 0.06
    assert np.abs(np.mean(off)) < 0.015


def test_runs_that_share_no_fish_or_no_calibration_are_refused(scene, tmp_path):
    result = invoke(f"combine {scene / 'run'} {scene / 'run'} --out {tmp_path / 'same'}")
    assert "two cameras at least 3 degrees apart" in result.error
    bare = measure(tmp_path, calibration=None)
    request = ReplayOptions(
        recordings=[scene / "run"],
        first="localize",
        second=bare,
        out=tmp_path / "both",
    )
    with pytest.raises(UserError, match="with --calibration"):
        replay(request, stop=threading.Event())


def test_a_camera_that_was_turned_sideways_is_said(scene, combined, tmp_path):
    """The rays still meet, but some way before the plane: lengths are 3 % short."""
    assert "reference plane" not in combined.err
    right = load_calibration(scene / SECOND / "calibration.yaml")
    turn = Rotation.from_rotvec([0.0, np.radians(1.0), 0.0]).as_matrix()
    plane = ReferencePlane(
        rotation=turn @ right.plane.rotation, translation_mm=turn @ right.plane.translation_mm
    )
    save_calibration(tmp_path / "turned.yaml", replace(right, plane=plane))
    options = f"--calibration {tmp_path / 'turned.yaml'} --from localize --out {tmp_path / 'run'}"
    assert invoke(f"replay {scene / SECOND / 'run'} {options}").code == 0
    result = invoke(f"combine {scene / 'run'} {tmp_path / 'run'} --out {tmp_path / 'both'}")
    assert result.code == 0, result.err
    assert "mm before the reference plane" in result.err


def tracks(rng, degrees, offset_s):
    """Six fish that swim about; both cameras see the first four, and each one more."""
    second = second_camera(FIRST, degrees=degrees)
    R, t = second_from_first(FIRST, second)
    first_tracks, second_tracks = {}, {}
    for fish in range(1, 7):
        times_s = rng.uniform(0, 8) + np.arange(14) * FRAME_S
        place = rng.uniform([-500, -300, 4600], [500, 300, 5300])
        speed = rng.uniform(-300, 300, 3)
        upright = np.linspace(-350, 350, 9)[:, None] * [0.1, 1.0, 0.05]

        def midline(time_s, place=place, speed=speed, upright=upright, begin=times_s[0]):
            return place + speed * (time_s - begin) + upright

        views = ((FIRST, np.eye(3), np.zeros(3), 0.0, first_tracks, 5),)
        views += ((second, R, t, 0.4 * FRAME_S, second_tracks, 6),)
        for camera, turn, shift, late_s, found, leaves_out in views:
            if fish == leaves_out:
                continue
            moments = times_s + late_s
            lines = [midline(moment) @ turn.T + shift for moment in moments]
            clock_s = moments + (offset_s if found is second_tracks else 0.0)
            found[fish if found is first_tracks else fish + 10] = FishSightings(
                times_ns=np.round(clock_s * 1e9).astype(np.int64),
                midlines_px=np.stack([camera.camera.project(line) for line in lines]),
                centers_px=np.stack([camera.camera.project(line)[4] for line in lines]),
                ious=np.full(len(lines), 0.95),
                length_mm=700.0,
            )
    return first_tracks, second_tracks, (FIRST, second)


@pytest.mark.parametrize("offset_s", [pytest.param(0.0, marks=pytest.mark.slow), -7.77])
def test_fish_are_paired_and_the_clocks_difference_is_found(offset_s):
    first, second, calibrations = tracks(np.random.default_rng(4), 35.0, offset_s)
    pairing = pair_up(first, second, calibrations, frame_s=FRAME_S)
    assert pairing.ids == {fish: [fish + 10] for fish in (1, 2, 3, 4)}
    assert pairing.clocks.offset_s == pytest.approx(offset_s, abs=0.02)
    assert pairing.apart < 0.005


def test_the_drift_of_a_clock_is_found():
    """As of a film of 29.97 frames/s that was read as one of 30: half a second in ten minutes."""
    first, second, calibrations = tracks(np.random.default_rng(4), 35.0, 0.0)
    early, late = dict[int, FishSightings](), dict[int, FishSightings]()
    for again in range(3):
        began_ns = again * 120 * 10**9
        for fish, one in first.items():
            early[100 * again + fish] = one._replace(times_ns=one.times_ns + began_ns)
        for fish, one in second.items():
            times_ns = np.rint((one.times_ns + began_ns) * 1.001).astype(np.int64)
            late[100 * again + fish] = one._replace(times_ns=times_ns)
    pairing = pair_up(early, late, calibrations, frame_s=FRAME_S)
    assert pairing.ids == {
        fish: [fish + 10] for again in range(3) for fish in range(100 * again + 1, 100 * again + 5)
    }
    assert pairing.clocks.drift == pytest.approx(0.001, abs=2e-5)
    assert pairing.apart < 0.005


def test_tracks_that_broke_off_are_parts_of_the_other_cameras_fish():
    first, second, calibrations = tracks(np.random.default_rng(4), 35.0, 0.0)
    for found, whole, rest in ((first, 1, 7), (second, 12, 17)):
        one = found[whole]
        parts = [FishSightings(*(x[s] for x in one[:4]), 700.0) for s in np.s_[:7, 7:]]
        found[whole], found[rest] = parts
    pairing = pair_up(first, second, calibrations, frame_s=FRAME_S)
    ids = {fish: sorted(others) for fish, others in pairing.ids.items()}
    assert ids == {1: [11], 7: [11], 2: [12, 17], 3: [13], 4: [14]}


def test_runs_share_no_fish_if_one_camera_has_no_good_fit():
    first, second, calibrations = tracks(np.random.default_rng(4), 35.0, 0.0)
    assert pair_up({}, second, calibrations, frame_s=FRAME_S).ids == {}
    assert pair_up(first, {}, calibrations, frame_s=FRAME_S).ids == {}
