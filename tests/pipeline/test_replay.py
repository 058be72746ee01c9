"""Replay of recordings: to the last bit, from any stage, also of what is damaged."""

import dataclasses
import shutil
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import MCAP0_MAGIC

from stream_dmr.calibration.calibration_file import load_calibration, save_calibration
from stream_dmr.errors import RecordingError
from stream_dmr.files import FolderLock
from stream_dmr.messages import FittedMesh, Frame, LengthEstimate, LocalizedFish
from stream_dmr.pipeline.comparator import differences
from stream_dmr.pipeline.config import parse_config
from stream_dmr.recording.codec import decode
from stream_dmr.recording.reading import decoded_messages, open_recordings
from stream_dmr.recording.selection import Selection
from stream_dmr.recording.topics import TOPICS
from tests.support.command import invoke, rows
from tests.support.tiny_clip import HEIGHT, WIDTH, calibration, write_clip

COMING_AND_GOING = [[1], [1, 2], [1, 2], [1, 2], [2, 3], [3], [3], []]
NUM_FISH = 11  # in all frames together
STAGES = ("crop", "fit", "localize", "smooth")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str | None]]:
    """The folder of a run, and the options that it was run with."""
    options = write_clip(tmp_path_factory.mktemp("replay") / "clip", fish=COMING_AND_GOING)
    outcome = invoke("run", options)
    assert outcome.code == 0, outcome.err
    return Path(str(options["--out"])), options


@pytest.fixture(scope="module")
def rrd(run):
    """Read once, which takes seconds."""
    return open_recordings([run[0] / "recording.rrd"])


def as_run(options, first):
    """What --from crop needs to be told again."""
    keys = ("--source", "--boxes", "--masks") if first == "crop" else ()
    return {"--from": first} | {key: options[key] for key in keys if key in options}


def contents(path: Path) -> list[tuple[type, bytes]]:
    return list(open_recordings([path]).payloads(TOPICS))


@pytest.mark.parametrize(
    ("first", "name"),
    # An .rrd, read by a process of its own, holds the same, see below: one stage tells.
    [
        *((first, "recording.mcap") for first in STAGES),
        pytest.param("crop", "recording.rrd", marks=pytest.mark.slow),
    ],
)
def test_recomputed_is_what_was_recorded(run, first, name):
    folder, options = run
    outcome = invoke(f"replay {folder / name}", as_run(options, first) | {"--check": None})
    assert outcome.code == 0, outcome.out + outcome.err
    lengths = NUM_FISH + 3  # running ones and final ones
    expected = {"crop": 3 * NUM_FISH, "fit": 2 * NUM_FISH, "localize": NUM_FISH, "smooth": 0}
    assert f"check: {expected[first] + lengths} messages" in outcome.out


def test_both_kinds_of_recording_hold_the_same(run, rrd):
    mcap = open_recordings([run[0] / "recording.mcap"])
    assert mcap.header.attachments() == rrd.header.attachments()
    assert by_kind(mcap.payloads(TOPICS)) == by_kind(rrd.payloads(TOPICS))


def test_a_replay_s_recording_is_the_one_replayed_but_for_what_cannot_be(run, tmp_path):
    folder, _ = run
    outcome = invoke(f"replay {folder}", {"--from": "fit", "--out": str(tmp_path / "again")})
    assert outcome.code == 0, outcome.err
    assert rows(tmp_path / "again" / "lengths.csv") == rows(folder / "lengths.csv")
    assert rows(tmp_path / "again" / "frames.csv") == rows(folder / "frames.csv")
    first, second = (open_recordings([out]) for out in (folder, tmp_path / "again"))
    for kind in TOPICS:
        pairs = zip(first.payloads([kind]), second.payloads([kind]), strict=True)
        for (_, a), (_, b) in pairs:
            assert not list(differences(decode(kind, a), decode(kind, b)))


def test_a_changed_setting_changes_what_follows_it_and_nothing_else(run, tmp_path):
    folder, options = run
    text = Path(str(options["--config"])).read_text()
    changed = tmp_path / "changed.toml"
    changed.write_text(f"{text}\n[smooth_length]\ncommon_std_ratio = 0.05\n")
    outcome = invoke(
        f"replay {folder}", {"--from": "fit", "--config": str(changed), "--check": None}
    )
    assert outcome.code == 1
    assert "fields differ, in LengthEstimate" in outcome.out
    assert "length_std_mm: recorded" in outcome.out
    assert "FittedMesh" not in outcome.out


@pytest.mark.parametrize(
    ("first", "setting"),
    [
        ("smooth", "[localize]\nmin_iou = 0.5"),
        ("smooth", "[fit_mesh]\nmin_mask_px = 11"),
        ("localize", "[fit_mesh]\nmin_mask_px = 11"),
        ("fit", '[species]\nmodel = "other.onnx"'),
        ("fit", "[crop_fish]\nmargin = 0.2"),
    ],
)
def test_a_setting_of_an_earlier_stage_stays_as_recorded(run, tmp_path, first, setting):
    config, out = tmp_path / "mine.toml", tmp_path / "out"
    config.write_text(setting)
    given = {"--from": first, "--config": str(config), "--out": str(out)}
    outcome = invoke(f"replay {run[0]}", given)
    assert outcome.code == 0
    table, key = setting.split(" = ")[0].split("\n")
    assert f"stay as they were recorded: {table} {key}" in outcome.err
    before, after = (
        parse_config(open_recordings([folder]).header.config_toml, where="")
        for folder in (run[0], out)
    )
    name = table.strip("[]")
    assert getattr(getattr(after, name), key) == getattr(getattr(before, name), key)


def test_what_a_replay_records_makes_what_it_wrote(run, tmp_path):
    """Left-out settings of earlier stages are the recorded ones, not the defaults."""
    config, out = tmp_path / "mine.toml", tmp_path / "out"
    config.write_text("[smooth_length]\ncommon_std_ratio = 0.05\n")
    given = {"--from": "smooth", "--config": str(config), "--out": str(out)}
    assert invoke(f"replay {run[0]}", given).code == 0
    before, after = (
        parse_config(open_recordings([folder]).header.config_toml, where="")
        for folder in (run[0], out)
    )
    for table in ("crop_fish", "fit_mesh", "localize"):
        assert getattr(after, table) == getattr(before, table)
    assert after.smooth_length.common_std_ratio == 0.05
    for first in ("fit", "localize", "smooth"):
        outcome = invoke(f"replay {out}", {"--from": first, "--check": None})
        assert outcome.code == 0, outcome.out + outcome.err


def test_a_new_calibration_needs_no_new_fit(run, tmp_path):
    """A plane twice as far makes every fish twice as long."""
    folder, options = run
    recorded = load_calibration(Path(str(options["--calibration"])))
    plane = recorded.plane
    moved = tmp_path / "calibration.yaml"
    doubled = dataclasses.replace(plane, translation_mm=2 * plane.translation_mm)
    save_calibration(moved, dataclasses.replace(recorded, plane=doubled))
    out = tmp_path / "out"
    given = {"--from": "localize", "--calibration": str(moved), "--out": str(out)}
    assert invoke(f"replay {folder}", given).code == 0
    for old, new in zip(rows(folder / "frames.csv"), rows(out / "frames.csv"), strict=True):
        if old["length_mm"]:
            assert float(new["length_mm"]) == pytest.approx(2 * float(old["length_mm"]), rel=1e-4)


@pytest.mark.parametrize("first", ["crop", "fit", "localize"])
def test_a_calibration_of_other_pictures_is_refused(run, tmp_path, first):
    other, out = tmp_path / "other.yaml", tmp_path / "out"
    save_calibration(other, calibration(2 * WIDTH, HEIGHT))
    given = {"--from": first, "--calibration": str(other), "--out": str(out)}
    outcome = invoke(f"replay {run[0]}", given)
    assert outcome.code == 2
    assert f"got {WIDTH}x{HEIGHT}" in outcome.error
    assert not out.exists()


def test_one_fish_alone_is_as_in_company(run):
    folder, _ = run
    outcome = invoke(f"replay {folder}", {"--track": "2", "--check": None})
    assert outcome.code == 0, outcome.out + outcome.err
    assert "check: 13 messages" in outcome.out  # 4 frames of 3 stages, and a final length


def test_a_part_in_time_is_read_alone(run, rrd):
    whole = open_recordings([run[0]])
    times = [decode(LocalizedFish, p).timestamp_ns for _, p in whole.payloads([LocalizedFish])]
    low, high = times[3], times[8]
    for recording in (whole, rrd):
        selection = recording.payloads([LocalizedFish], Selection(time_ns=(low, high)))
        found = [decode(LocalizedFish, p).timestamp_ns for _, p in selection]
        assert found == [t for t in times if low <= t < high]


def test_a_fish_is_read_by_the_index(run):
    """Only the time in which it was seen is read, and the other fish of that time are left out."""
    recording = open_recordings([run[0]])
    selection = Selection(tracks=frozenset({3}))
    frames = [
        decode(Frame, payload).frame_index for _, payload in recording.payloads([Frame], selection)
    ]
    assert frames == [5, 6, 7, 8]  # it ended after the last
    kinds = (FittedMesh, LengthEstimate)
    read = [message for message, _ in decoded_messages(recording, kinds, selection)]
    assert read
    assert all(message.track_id == 3 for message in read)
    everything = [message for message, _ in decoded_messages(recording, kinds)]
    assert len(read) == sum(message.track_id == 3 for message in everything)


def test_segments_are_read_as_one(run, tmp_path):
    folder, _ = run
    for number in (1, 2):
        shutil.copy(folder / "recording.mcap", tmp_path / f"seg-{number}.mcap")
    assert contents(tmp_path) == 2 * contents(folder / "recording.mcap")


def test_segments_are_read_in_order_however_they_are_given(tmp_path):
    for name in ("seg-2.mcap", "seg-10.mcap"):
        (tmp_path / name).write_bytes(b"no recording")
    with pytest.raises(RecordingError, match=r"seg-2\.mcap"):  # the first that is opened
        open_recordings([tmp_path / "seg-10.mcap", tmp_path / "seg-2.mcap"])


@pytest.mark.parametrize("again", ["recording.rrd", "recording.mcap", "."])
def test_no_frame_is_read_twice(run, again):
    folder, _ = run
    with pytest.raises(RecordingError, match="expected each recording once"):
        open_recordings([folder / "recording.mcap", folder / again])


class TestDamage:
    @given(seed=st.integers(0, 2**32))
    def test_a_flipped_byte_is_found(self, run, tmp_path_factory, seed):
        _check_flip(run[0] / "recording.mcap", tmp_path_factory.mktemp("flip"), seed)

    def test_a_record_of_another_kind_is_found(self, run, tmp_path):
        """A few bytes among many, which random flips seldom meet."""
        whole = run[0] / "recording.mcap"
        data, at, kinds = whole.read_bytes(), len(MCAP0_MAGIC), dict[int, int]()
        while at < len(data) - len(MCAP0_MAGIC):
            kinds.setdefault(data[at], at)
            at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")  # opcode, length, content
        assert len(kinds) > 10
        for place in kinds.values():
            for bit in range(8):
                flipped = bytearray(data)
                flipped[place] ^= 1 << bit
                _check_damaged(whole, tmp_path, flipped)

    @given(seed=st.integers(0, 2**32))
    def test_a_flipped_byte_is_found_or_not_read_by_a_read_of_a_part(
        self, run, tmp_path_factory, seed
    ):
        path = tmp_path_factory.mktemp("flip") / "recording.mcap"
        path.write_bytes(_flipped(run[0] / path.name, seed))
        selection = Selection(tracks=frozenset({2}))
        with suppress(RecordingError):
            recording = open_recordings([path])
            found = list(recording.payloads(TOPICS, selection))
            assert recording.warnings or found == list(
                open_recordings([run[0]]).payloads(TOPICS, selection)
            )

    @given(share=st.floats(0.0, 0.999))
    def test_what_is_whole_of_a_torn_file_is_used(self, run, tmp_path_factory, share):
        _check_truncation(run[0] / "recording.mcap", tmp_path_factory.mktemp("torn"), share)

    @pytest.mark.slow
    def test_a_thousand_flips_and_two_hundred_truncations(self, run, tmp_path):
        rng = np.random.default_rng(0)
        for seed in rng.integers(0, 2**32, 1000):
            _check_flip(run[0] / "recording.mcap", tmp_path, int(seed))
        for seed in rng.integers(0, 2**32, 100):  # a process each
            _check_flip(run[0] / "recording.rrd", tmp_path, int(seed))
        for share in rng.random(200):
            _check_truncation(run[0] / "recording.mcap", tmp_path, float(share))
        for share in rng.random(50):
            _check_truncation(run[0] / "recording.rrd", tmp_path, float(share))

    @pytest.mark.slow
    def test_a_folder_with_an_rrd_alone_is_read_beside_the_run_that_writes_it(self, run, tmp_path):
        original = (run[0] / "recording.rrd").read_bytes()
        (tmp_path / "recording.rrd").write_bytes(original[: len(original) // 2])
        lock = FolderLock(tmp_path)
        try:
            recording = open_recordings([tmp_path])
        finally:
            lock.release()
        assert "still being written" in recording.warnings[0]
        whole = by_kind(contents(run[0] / "recording.rrd"))
        found = by_kind(recording.payloads(TOPICS))
        assert found
        for kind, payloads in found.items():
            assert payloads == whole[kind][: len(payloads)]

    def test_replay_says_what_is_lost(self, run, tmp_path):
        original = (run[0] / "recording.mcap").read_bytes()
        torn = tmp_path / "recording.mcap.part"
        torn.write_bytes(original[: -len(original) // 3])
        outcome = invoke(f"replay {torn}")
        assert outcome.code == 0, outcome.err
        assert "torn" in outcome.err


def _flipped(whole: Path, seed: int) -> bytes:
    rng = np.random.default_rng(seed)
    data = bytearray(whole.read_bytes())
    data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    return data


def _check_flip(whole: Path, scratch: Path, seed: int) -> None:
    _check_damaged(whole, scratch, _flipped(whole, seed))


def _check_damaged(whole: Path, scratch: Path, data: bytes) -> None:
    """Every flip in a .mcap is reported; in an .rrd, no message changes unnoticed."""
    path = scratch / whole.name
    path.write_bytes(data)
    found = []
    with suppress(RecordingError):
        recording = open_recordings([path])
        found += recording.payloads(TOPICS)
        assert whole.suffix == ".rrd" or recording.warnings
    original = contents(whole.with_suffix(".mcap"))
    if whole.suffix == ".mcap":
        assert found == original[: len(found)]
    else:  # it holds the same, kind by kind: between kinds the order is another
        assert by_kind(found) in ({}, by_kind(original))


def by_kind(messages: Iterable[tuple[type, bytes]]) -> dict[type, list[bytes]]:
    kinds: dict[type, list[bytes]] = {}
    for kind, payload in messages:
        kinds.setdefault(kind, []).append(payload)
    return kinds


def _check_truncation(whole: Path, scratch: Path, share: float) -> None:
    """Opening says that the file is torn, and what is read of each kind is its beginning."""
    original = whole.read_bytes()
    path = scratch / whole.name
    path.write_bytes(original[: int(share * len(original))])
    try:
        recording = open_recordings([path])
        found = by_kind(recording.payloads(TOPICS))
    except RecordingError:
        return  # not even the header was whole
    if whole.suffix == ".mcap":
        assert "torn" in recording.warnings[0]
    complete = by_kind(contents(whole.with_suffix(".mcap")))  # it holds the same
    for kind, payloads in found.items():
        assert payloads == complete[kind][: len(payloads)]
    # Without a warning, only Rerun's own index is missing.
    assert recording.warnings or found == complete


class TestDifferences:
    def test_names_the_field_and_both_values(self, run):
        _, payload = next(open_recordings([run[0]]).payloads([FittedMesh]))
        mesh = decode(FittedMesh, payload)
        assert mesh.shape is not None
        assert mesh.report is not None
        keypoints = mesh.shape.keypoints.copy()
        keypoints[1, 2] = np.nextafter(keypoints[1, 2], np.inf)
        other = dataclasses.replace(
            mesh,
            shape=dataclasses.replace(mesh.shape, keypoints=keypoints, iou=0.5),
            report=dataclasses.replace(mesh.report, elapsed_ns=1),
        )
        found = {item.field: item for item in differences(mesh, other)}
        assert set(found) == {"shape.keypoints", "shape.iou"}
        assert found["shape.keypoints"].recorded.startswith("[1][2]")
        assert "1 of 9 differ" in found["shape.keypoints"].computed
        assert found["shape.iou"].computed == "0.5"

    def test_equal_bits_are_equal(self, run):
        for kind in (FittedMesh, LengthEstimate):
            for _, payload in open_recordings([run[0]]).payloads([kind]):
                assert not list(differences(decode(kind, payload), decode(kind, payload)))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"--from": "smooth", "--template": "cod"}, "--from fit"),
        ({"--from": "localize", "--template": "cod"}, "--from fit"),
        ({"--from": "smooth", "--calibration": "other.yaml"}, "--from localize"),
        ({"--source": "video.mp4"}, "--from crop"),
        ({"--from": "localize", "--boxes": "boxes.txt"}, "--from crop"),
        ({"--from": "smooth", "--masks": "masks"}, "--from crop"),
        ({"--check": None, "--time": "0:1"}, "--time"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(run, options, said):
    outcome = invoke(f"replay {run[0]}", options)
    assert outcome.code == 2
    assert said in outcome.error


def test_other_files_are_refused_by_name(tmp_path):
    for name in ("a.mcap", "a.rrd"):
        path = tmp_path / name
        path.write_bytes(b"not a recording at all")
        outcome = invoke(f"replay {path}")
        assert outcome.code == 2
        assert name in outcome.error
    assert invoke(f"replay {tmp_path / 'none.mcap'}").code == 2


@pytest.mark.parametrize("command", ["replay", "export", "report", "convert"])
def test_what_is_no_recording_is_not_called_a_damaged_one(run, tmp_path, command):
    options = {} if command == "replay" else {"--out": str(tmp_path / "out.rrd")}
    options |= {"--tables": "csv"} if command == "export" else {}
    for path in (run[1]["--source"], run[0] / "lengths.csv", run[0] / "lengths.db"):
        outcome = invoke(f"{command} {path}", options)
        assert outcome.code == 2
        assert outcome.error.startswith(f"{path}: expected a recording")
        assert "damage" not in outcome.error
