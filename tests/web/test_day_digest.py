"""Digests of days: their size, what they say and sign, and that a run writes each day once."""

import io
import json
import os
import shutil
import threading
import time
import tracemalloc
import zipfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import ConfigError, OutputError, RecordingError, UserError
from stream_dmr.evidence.digest_file import CONTENT, pack, read_digest
from stream_dmr.evidence.own_files import is_made_by
from stream_dmr.evidence.verify_signatures import check_signatures
from stream_dmr.messages import LengthEstimate
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.sources.sensors_settings import utc_ns_of
from stream_dmr.store import fish as fish_module
from stream_dmr.store import ledger
from stream_dmr.store.ledger import Signer, load_public_key, make_key
from stream_dmr.store.length_store import LengthStore
from stream_dmr.store.schema import (
    EVENTS,
    HAULS,
    POSITIONS,
    WATCHED,
    estimate_of,
    read_rows,
    records,
)
from stream_dmr.store.trip import (
    END,
    START,
    Haul,
    KeptPosition,
    haul_values,
    position_values,
    thinned,
)
from stream_dmr.web import day_digest
from stream_dmr.web.day_digest import (
    MAX_BYTES,
    DailyDigests,
    grouped_sums,
    measured_until,
    write_digest,
)
from stream_dmr.web.fleet_page import BoxState, ask_all, load_boxes
from stream_dmr.web.watch_observer import WatchObserver
from tests.support.command import invoke
from tests.support.final_estimates import FACTS, fish
from tests.support.fish_run import measure, request
from tests.support.tiny_clip import draw_mask, write_clip

DAY = date(2026, 11, 25)
DAY_NS = 86_400 * 10**9
BOX = replace(FACTS, utc_zero_ns=0, vessel="Sea Bird")


def noon(day: date) -> int:
    return utc_ns_of(f"{day}T12:00:00Z")


def live(store: LengthStore, day: date, ids: range, *, seed: int = 0) -> None:
    """A day of a box: a watched hour, a haul, positions, an alarm, fish of all lengths."""
    rng, at = np.random.default_rng(seed), noon(day)
    for what, moment in ((START, at), (END, at + 3600 * 10**9)):
        store.append(HAULS, "1", haul_values(what, f"{day.day}", moment, "rule"))
    values = {"first_ns": at, "last_ns": at + 3600 * 10**9, "frames": 36_000, "frames_lost": 0}
    store.append(WATCHED, str(at), values)
    store.note("drift", "the camera seems bumped", timestamp_ns=at)
    for number in range(0, 8640, 1 if len(ids) > 99 else 1000):
        moment = at - DAY_NS // 2 + number * 10 * 10**9
        kept = position(moment, latitude=57.4 + number * 1e-5, longitude=-150.9 + number * 1.3e-5)
        store.append(POSITIONS, str(moment), position_values(kept), is_urgent=False)
    for number, track_id in enumerate(ids):
        first = at + number * 7_123_456_789
        length = float(rng.uniform(300, 1800))
        times = {"first_timestamp_ns": first, "last_timestamp_ns": first + 4_000_000_000}
        code = "HAL" if rng.random() < 0.7 else "COE"
        flags = ["the camera seems bumped"] if number % 3 == 0 else []
        ci95 = length + rng.uniform(5, 40) * np.array([-1, 1])
        one = fish(track_id, length_mm=length, ci95_mm=ci95, species_code=code, **times)
        store.add(one, iou=float(rng.random()), flags=flags)


def position(moment: int, *, is_joined: bool = True, **place: float) -> KeptPosition:
    of = {"latitude": 0.0, "longitude": 0.0} | place
    others = {"utc_ns": moment, "speed_knots": 5.25, "course_deg": 10.0}
    return KeptPosition(timestamp_ns=moment, is_joined=is_joined, **of, **others)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def key(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("keys") / "device"
    make_key(path)
    return path


@pytest.fixture(scope="module")
def busy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a box with 500 fish on one day, and none on the day before."""
    out = tmp_path_factory.mktemp("busy") / "out"
    out.mkdir()
    with closing(LengthStore(out, BOX)) as store:
        live(store, DAY - timedelta(days=1), range(0))
        live(store, DAY, range(1, 501))
    return out


def content_of(path: Path) -> dict[str, Any]:
    content = read_digest(path)
    assert content is not None
    return content


def test_500_fish_leave_room_for_pictures(
    busy: Path, key: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    bare = write_digest(busy, DAY, tmp_path / "bare.zip", Signer(key))
    assert bare < 0.5 * MAX_BYTES
    noise = np.random.default_rng(0).bytes(500)
    names = (f"pictures/{number}.webp" for number in range(1, 501))
    monkeypatch.setattr(day_digest, "_pictures", lambda *_: ((name, noise) for name in names))
    size = write_digest(busy, DAY, tmp_path / "full.zip", Signer(key))
    assert MAX_BYTES - 700 < size <= MAX_BYTES
    full, plain = content_of(tmp_path / "full.zip"), content_of(tmp_path / "bare.zip")
    assert full["fish"] == plain["fish"]
    assert len(full["fish"]) == 501
    with zipfile.ZipFile(tmp_path / "full.zip") as archive:  # any other program opens it
        assert archive.testzip() is None
        assert len(archive.namelist()) > 40


def test_so_many_fish_that_they_are_too_large_are_all_there(
    key: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(day_digest, "MAX_BYTES", 900)
    with closing(LengthStore(tmp_path, BOX)) as store:
        live(store, DAY, range(1, 31))
    said = invoke(f"digest {tmp_path} --day {DAY} --key {key}")
    assert "no fish is left out" in said.err
    assert len(content_of(tmp_path / f"digest-{DAY}.zip")["fish"]) == 31


def test_a_digest_says_what_lengths_db_has(busy: Path, tmp_path: Path):
    write_digest(busy, DAY, tmp_path / "d.zip", Signer(None), problems=["no picture"])
    content = content_of(tmp_path / "d.zip")
    columns, first, *_ = content["fish"]
    row = dict(zip(columns, first, strict=True))
    assert (row["id"], row["utc"], row["haul"]) == (1, f"{DAY}T12:00:02.000Z", "25")
    assert row["low_mm"] < row["length_mm"] < row["high_mm"]
    assert (row["status"], row["species"] in ("HAL", "COE")) == ("measured", True)
    assert content["hours_watched"] == 1.0
    assert [haul["haul"] for haul in content["hauls"]] == ["25"]
    assert content["hauls"][0]["num_fish"] == "500"
    assert content["events"] == [[f"{DAY}T12:00:00.000Z", "drift", "the camera seems bumped"]]
    assert len(content["positions"]) == 288
    assert content["positions"][0] == [f"{DAY}T00:00:00.000Z", "57.40000", "-150.90000", True]
    assert content["box"]["problems"] == ["no picture"]
    assert content["box"]["warnings"][0] == "167 fish: the camera seems bumped"


def test_a_day_without_fish_has_a_digest_and_a_day_without_anything_none(
    busy: Path, tmp_path: Path
):
    write_digest(busy, DAY - timedelta(days=1), tmp_path / "d.zip", Signer(None))
    content = content_of(tmp_path / "d.zip")
    assert (len(content["fish"]), content["hours_watched"]) == (1, 1.0)
    with pytest.raises(OutputError, match="2026-11-24 to 2026-11-25, got 2026-11-26"):
        write_digest(busy, DAY + timedelta(days=1), tmp_path / "d.zip", Signer(None))


def test_verify_finds_any_changed_byte(key: Path, tmp_path: Path):
    with closing(LengthStore(tmp_path, BOX, signer=Signer(key))) as store:
        live(store, DAY, range(1, 4))
    path, public = tmp_path / "d.zip", load_public_key(key.with_name("device.pub"))
    write_digest(tmp_path, DAY, path, Signer(key))
    content, whole = read_digest(path, public), path.read_bytes()
    assert content is not None
    entries = len(read_rows(tmp_path / "lengths.db", EVENTS)) + content["chain"][0][0]
    assert entries > 4
    for place in range(len(whole)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        assert read_digest(path, public) is None, place
    for other in (whole[:-1], whole + b"\0", b"", pack(content, {}, Signer(None))):
        path.write_bytes(other)
        assert read_digest(path, public) is None


def test_verify_as_it_is_typed(busy: Path, key: Path, tmp_path: Path):
    path, public = tmp_path / "d.zip", str(key.with_name("device.pub"))
    day = f"digest {busy} --day {DAY} --out {path}"
    assert invoke(f"{day} --key {key}").code == 0
    said = invoke(f"verify {path} --key {public}")
    assert (said.code, "500 fish" in said.out) == (0, True)
    assert "expected --key FILE.pub" in invoke(f"verify {path}").error
    assert invoke(day).code == 0  # over its own, now without a signature
    said = invoke(f"verify {path} --key {public}")
    assert (said.code, "is not as it was signed" in said.out) == (1, True)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("{out} --day yesterday", "expected a day such as 2026-11-25, got yesterday"),
        ("{out}/none --day 2026-11-25", "found none; check the path"),
        ("{video} --day 2026-11-25", "that does not; measure with --start-utc"),
        ("{out} --day 2026-11-25 --out {other}", "a name that is free"),
        ("{out} --day 2026-11-25 --out {out}/lengths.db", "a file of another name"),
        ("{out} --day 2026-11-25 --key {other}", "expected the private key"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(busy: Path, tmp_path: Path, asked: str, said: str):
    other = tmp_path / "other"
    other.write_text("mine")
    LengthStore(tmp_path, FACTS).close()
    result = invoke(f"digest {asked.format(out=busy, video=tmp_path, other=other)}")
    assert (result.code, said in result.error) == (2, True)
    assert other.read_text() == "mine"


@pytest.mark.parametrize("damage", [b"", b"PK", b"x" * 999, None])
def test_what_is_no_digest_is_refused(damage: bytes | None, tmp_path: Path):
    path = tmp_path / "d.zip"
    if damage is None:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(CONTENT, "{")
    else:
        path.write_bytes(damage)
    with pytest.raises(OutputError, match="expected a digest"):
        read_digest(path)


def zipped(text: str, kind: int, says_bytes: int | None = None) -> bytes:
    """A digest with this content, whose zip says another size of it."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr(zipfile.ZipInfo(CONTENT), text, kind)
    data = bytearray(packed.getvalue())
    if says_bytes is not None:
        for start in (22, data.rfind(b"PK\1\2") + 24):
            data[start : start + 4] = says_bytes.to_bytes(4, "little")
    return bytes(data)


@pytest.mark.parametrize("kind", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_bomb_is_not_unpacked(kind: int, tmp_path: Path):
    path, size = tmp_path / "d.zip", 100_000_000
    path.write_bytes(zipped("0" * size, kind, says_bytes=100))
    tracemalloc.start()
    with pytest.raises(OutputError, match="expected a digest"):
        read_digest(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < size / 10


@pytest.mark.parametrize(
    "text", ["[]", "null", '{"day": 5, "fish": []}', '{"day": "x", "fish": 1}']
)
def test_a_signed_digest_of_other_content_is_refused(text: str, key: Path, tmp_path: Path):
    path = tmp_path / "d.zip"
    data = zipped(text, zipfile.ZIP_STORED)
    signed = data[:-2] + (64).to_bytes(2, "little")  # the length of the comment
    path.write_bytes(signed + Signer(key).sign_bytes(signed))
    said = invoke(f"verify {path} --key {key.with_name('device.pub')}")
    assert (said.code, "expected a digest" in said.error) == (2, True)


def test_pictures_are_small_and_of_the_fish(tmp_path: Path):
    out = measure(tmp_path, start_utc="2026-11-25T06:00:00Z")
    size = write_digest(out, DAY, tmp_path / "d.zip", Signer(None))
    assert size < 10_000
    content = content_of(tmp_path / "d.zip")
    mcap = out / "recording.mcap"
    assert content["recordings"] == [[mcap.name, sha256(mcap.read_bytes()).hexdigest()]]
    with zipfile.ZipFile(tmp_path / "d.zip") as archive:
        assert {*archive.namelist()} == {CONTENT, "pictures/1.webp", "pictures/2.webp"}
        data = np.frombuffer(archive.read("pictures/1.webp"), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (64, 64, 3)
    assert image.std() > 5


def test_a_day_weeks_ago_is_found_without_reading_the_weeks_since(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    began_ns, damaged, opened = noon(DAY) - DAY_NS // 2, {700, 1000}, list[int]()
    for number in range(1, 1001):  # one an hour
        (tmp_path / f"recording-{number:06d}.mcap").touch()

    def opening(paths: list[Path]) -> int:
        opened.append(int(paths[0].stem[-6:]))
        if opened[-1] in damaged:
            raise RecordingError("damaged")
        return opened[-1]

    def frames(number: int, _: object) -> Iterator[SimpleNamespace]:
        return iter([SimpleNamespace(timestamp_ns=began_ns + (number - 500) * DAY_NS // 24)])

    monkeypatch.setattr(day_digest, "open_recordings", opening)
    monkeypatch.setattr(day_digest, "messages_of", frames)
    span = Haul(name="", began_ns=began_ns, ended_ns=began_ns + DAY_NS)
    for broken in (set[int](), {*range(515, 524)}, {500, 750}):
        damaged |= broken
        opened.clear()
        found = [path.stem[-6:] for _, path in day_digest.recordings_of(tmp_path, span)]
        assert found == [f"{n:06d}" for n in range(500, 524) if n not in damaged]
        assert len(opened) < 40


def test_a_digest_takes_the_fish_of_its_day_and_the_last_entry_alone(
    key: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    with closing(LengthStore(tmp_path, BOX, signer=Signer(key))) as store:
        live(store, DAY - timedelta(days=1), range(1, 31))
        live(store, DAY, range(31, 33))
    made, entries = list[int](), list[ledger.ChainEntry]()

    def estimate(row: dict[str, Any]) -> LengthEstimate:
        made.append(row["track_id"])
        return estimate_of(row)

    def read(*args: Any, **options: Any) -> list[ledger.ChainEntry]:
        entries.extend(records(*args, **options))
        return entries

    monkeypatch.setattr(fish_module, "estimate_of", estimate)
    monkeypatch.setattr(ledger, "records", read)
    write_digest(tmp_path, DAY, tmp_path / "d.zip", Signer(None))
    content = content_of(tmp_path / "d.zip")
    assert made == [row[0] for row in content["fish"][1:]] == [31, 32]
    assert [[entry.number, entry.sha256] for entry in entries] == content["chain"]


def test_many_recordings_are_hashed_in_groups(tmp_path: Path):
    paths = [tmp_path / f"recording-{number:06d}.mcap" for number in range(1, 8)]
    for path in paths:
        path.write_text(path.name)
    sums = {path.name: sha256(path.read_bytes()).hexdigest() for path in paths}
    assert grouped_sums(paths, most=7) == [[*one] for one in sums.items()]
    grouped = grouped_sums(paths, most=3)
    assert [group[:2] for group in grouped] == [
        [paths[first].name, paths[last].name] for first, last in ((0, 2), (3, 5), (6, 6))
    ]
    printed = "".join(f"{sums[path.name]}  {path.name}\n" for path in paths[:3])
    assert grouped[0][2] == sha256(printed.encode()).hexdigest()


@given(joined=st.lists(st.booleans(), max_size=60), most=st.integers(1, 20))
def test_thinned_positions_are_few_and_keep_gaps(joined: list[bool], most: int):
    track = [position(moment, is_joined=one) for moment, one in enumerate(joined)]
    kept = thinned(track, most=most)
    times = [one.timestamp_ns for one in kept]
    assert len(kept) <= most
    assert times == sorted(set(times))
    assert times[:1] == [0][: len(track)]
    assert all(replace(one, is_joined=joined[one.timestamp_ns]) in track for one in kept)
    assert len({b - a for a, b in pairwise(times)}) <= 1  # evenly
    for before, after in pairwise(times):
        of = next(one for one in kept if one.timestamp_ns == after)
        assert of.is_joined == all(joined[before + 1 : after + 1])
    if len(track) <= most:
        assert kept == track


class Box:
    """A run on a box that stays off between two of them, without its camera and its chain."""

    def __init__(self, out: Path, folder: Path, key: Path | None = None) -> None:
        out.mkdir(exist_ok=True)
        self.store = LengthStore(out, BOX, signer=Signer(key))
        self.now_ns = 0
        self.digests = DailyDigests(
            folder,
            self.store,
            Signer(key),
            lambda: self.now_ns,
            problems=lambda: ["dirt"],
            on_notice=pytest.fail,
        )

    def write_due(self, now_ns: int) -> None:
        self.now_ns = now_ns
        self.digests.write_due()

    def __enter__(self) -> "Box":
        return self

    def __exit__(self, *_: object) -> None:
        self.digests.close()
        self.store.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "digests"


def taken(folder: Path) -> Iterator[str]:
    """What the program that sends digests ashore finds, and takes away."""
    for path in sorted(folder.glob("*")):
        assert is_made_by("digest")(path)
        yield path.stem.removeprefix("digest-")
        path.unlink()


def test_after_a_week_without_power_each_day_comes_once(tmp_path: Path, folder: Path):
    first, after = DAY - timedelta(days=9), 1
    sent = list[str]()
    for number in range(3):  # days on which it measured
        with Box(tmp_path / "out", folder) as box:
            day = first + timedelta(days=number)
            live(box.store, day, range(after, after + 3))
            box.write_due(noon(day) + 100)
            sent += taken(folder)
            after += 3
    assert sent == [str(first), str(first + timedelta(days=1))]
    for number in range(2):  # a week later, twice
        with Box(tmp_path / "out", folder) as box:
            box.write_due(noon(DAY) + number)
            sent += taken(folder)
    assert sent == [str(first + timedelta(days=number)) for number in range(3)]


def test_a_week_without_a_link_fills_the_folder(tmp_path: Path, folder: Path, key: Path):
    with Box(tmp_path / "out", folder, key) as box:
        for number in range(7):
            day = DAY + timedelta(days=number)
            live(box.store, day, range(2 * number + 1, 2 * number + 3))
            box.write_due(noon(day + timedelta(days=1)))
        public = load_public_key(key.with_name("device.pub"))
        digests = [read_digest(path, public) for path in sorted(folder.iterdir())]
    ids = [row[0] for digest in digests if digest for row in digest["fish"][1:]]
    assert ids == list(range(1, 15))


def test_a_restart_in_the_middle_of_a_day_makes_one_digest_of_it(tmp_path: Path, folder: Path):
    for ids in (range(1, 3), range(3, 5)):
        with Box(tmp_path / "out", folder) as box:
            live(box.store, DAY, ids)
            box.write_due(noon(DAY) + DAY_NS // 2 + 1)  # not all of it may be known yet
            assert list(taken(folder)) == []
    with Box(tmp_path / "out", folder) as box:
        box.write_due(noon(DAY) + DAY_NS)
    content = content_of(folder / f"digest-{DAY}.zip")
    assert [row[0] for row in content["fish"][1:]] == [1, 2, 3, 4]
    assert content["box"]["problems"] == ["dirt"]
    assert content["hours_watched"] == 2.0


def test_a_fish_that_comes_later_is_not_lost(tmp_path: Path, folder: Path):
    with Box(tmp_path / "out", folder) as box:
        for ids in (range(1, 3), range(3, 4)):
            live(box.store, DAY, ids)
            box.write_due(noon(DAY) + DAY_NS)
            assert list(taken(folder)) == [str(DAY)]
        box.write_due(noon(DAY) + 2 * DAY_NS)
        assert list(taken(folder)) == []


def test_a_clock_that_is_set_ends_no_day(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
):
    """It was written again with each fish, since capture times go on from those before."""
    with closing(LengthStore(tmp_path, BOX)) as store:
        until = measured_until(store, is_live=True)
        live(store, datetime.now(UTC).date(), range(1, 3))
        began_ns = time.time_ns()
        monkeypatch.setattr(time, "time_ns", lambda: began_ns + 3 * DAY_NS)
        others = {"problems": tuple, "on_notice": pytest.fail}
        with closing(DailyDigests(folder, store, Signer(None), until, **others)) as digests:
            digests.write_due()
            assert not folder.exists()
            store.frame_passed(frame_index=1, timestamp_ns=time.time_ns())  # as the day ends
            digests.write_due()
            assert len(list(folder.iterdir())) == 1


def test_what_the_disk_refuses_is_tried_again(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
):
    folder.write_text("no folder")
    tried = threading.Event()
    monkeypatch.setattr(day_digest, "_LOOK_S", 0.01)
    with closing(LengthStore(tmp_path, BOX)) as store:
        live(store, DAY - timedelta(days=365), range(1, 2))
        said = list[str]()

        def notice(line: str) -> None:
            said.append(line)
            folder.unlink(missing_ok=True)
            tried.set()

        others = {"problems": tuple, "on_notice": notice}
        with closing(DailyDigests(folder, store, Signer(None), time.time_ns, **others)):
            assert tried.wait(20)
            until_s = time.monotonic() + 20
            while not list(folder.glob("digest-*.zip")) and time.monotonic() < until_s:
                time.sleep(0.01)
        assert list(folder.glob("digest-*.zip"))
    assert "tried again later" in said[0]


def test_only_a_source_that_ended_makes_the_last_day_whole(tmp_path: Path, folder: Path):
    for is_complete, expected in ((False, []), (True, [str(DAY)]), (True, [])):
        with Box(tmp_path / "out", folder) as box:
            if not is_complete:
                live(box.store, DAY, range(1, 3))
            box.now_ns = noon(DAY) + 1
            box.digests.close(is_complete=is_complete)
            assert list(taken(folder)) == expected


class WaitsForDigest(RunObserver):
    """Holds up the second clip until the digest of the first one has its two fish."""

    def __init__(self, path: Path) -> None:
        self._path, self._num_frames = path, 0

    def frame_done(self) -> None:
        self._num_frames += 1
        until_s = time.monotonic() + 20
        while self._num_frames > 3 and time.monotonic() < until_s:
            if self._path.exists() and len(content_of(self._path)["fish"]) == 3:
                return
            time.sleep(0.01)


def test_a_run_over_a_growing_folder_signs_a_digest_of_each_day(
    tmp_path: Path, folder: Path, key: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(day_digest, "_LOOK_S", 0.01)
    clip, first_s = tmp_path / "clip", noon(DAY) // 10**9
    write_clip(clip, fish=[[1, 2]] * 3)
    for index in (4, 5, 6):
        cv2.imwrite(str(clip / "masks" / f"{index:06d}.png"), draw_mask(index - 3, [3, 4]))
    with (clip / "quick.toml").open("a") as config:
        config.write(f"\n[read_frames]\nclips_wait_s = 0\n\n[digest]\nfolder = '{folder}'\n")
    (tmp_path / "clips").mkdir()
    for day in range(2):
        shutil.copy(clip / "video.mp4", file := tmp_path / "clips" / f"{day}.mp4")
        os.utime(file, (first_s + day * 86_400,) * 2)
    path = folder / f"digest-{DAY}.zip"
    asked = request(clip, out := tmp_path / "out", source=str(tmp_path / "clips"), key=key)
    observer = WatchObserver(WaitsForDigest(path))
    measure_source(asked, stop=threading.Event(), observer=observer)
    # No more clips came for the second day, so the run ended by itself.
    last = folder / f"digest-{DAY + timedelta(days=1)}.zip"
    assert sorted(folder.iterdir()) == [path, last]
    assert [row[0] for row in content_of(last)["fish"][1:]] == [3, 4]
    with zipfile.ZipFile(last) as archive:  # with the segments that the end closed
        assert "pictures/3.webp" in archive.namelist()
    public = load_public_key(key.with_name("device.pub"))
    content = read_digest(path, public)
    assert content is not None
    assert [row[0] for row in content["fish"][1:]] == [1, 2]
    assert check_signatures(out, public).changes == []
    with zipfile.ZipFile(path) as archive:  # as far as segments were closed
        assert CONTENT in archive.namelist()


def test_the_fleet_shows_digests(busy: Path, tmp_path: Path):
    today = datetime.now(UTC).date()
    with closing(LengthStore(tmp_path, BOX)) as store:
        live(store, today, range(1, 5))
        live(store, DAY - timedelta(days=400), range(5, 6))
    bird, empty = tmp_path / "bird", tmp_path / "empty"
    for folder in (bird, empty):
        folder.mkdir()
    old = DAY - timedelta(days=400)
    for day in (old, today):
        write_digest(tmp_path, day, bird / f"digest-{day}.zip", Signer(None), problems=["dirt"])
    write_digest(tmp_path, old, tmp_path / "old.zip", Signer(None))
    (tmp_path / "boxes.txt").write_text(f"FV Bird {bird}\n{empty}\n{tmp_path / 'old.zip'}\n")
    boxes = load_boxes([str(tmp_path / "boxes.txt")])
    states = ask_all([BoxState(box=box) for box in boxes])
    assert [state.box.name for state in states] == ["FV Bird", "empty", "old.zip"]
    assert [state.kind for state in states] == ["unhealthy", "silent", "silent"]
    assert states[0].reading is not None
    assert (states[0].reading.num_fish, states[0].reading.fish_per_hour) == (5, 4.0)
    assert states[0].reading.warnings[0] == "2 fish: the camera seems bumped"
    assert [state.error for state in states[1:]] == [
        "no digest has come",
        f"its last digest is of {old}",
    ]
    out = tmp_path / "fleet.html"
    assert invoke(f"fleet {bird} --out {out}").code == 0
    assert "dirt" in out.read_text()
    (bird / f"digest-{today}.zip").write_bytes(b"torn")
    (state,) = ask_all(states[:1])
    assert (state.kind, state.reading) == ("silent", states[0].reading)  # as it said last
    assert "not a zip file" in state.error


def test_the_fleet_checks_signatures_where_it_has_a_key(busy: Path, key: Path, tmp_path: Path):
    path, boxes, out = tmp_path / "digest-1.zip", tmp_path / "boxes", tmp_path / "fleet.html"
    write_digest(busy, DAY, path, Signer(key))
    today = content_of(path) | {"day": str(datetime.now(UTC).date())}
    path.write_bytes(pack(today, {}, Signer(key)))
    boxes.write_text(f"Bird {path} {key}.pub\n")
    other = make_key(tmp_path / "other")
    for signer, line in ((Signer(key), "signature checked"), (Signer(None), "not by its key")):
        path.write_bytes(pack(today, {}, signer))
        assert line in invoke(f"fleet {boxes} --out {out}").out
        assert line in out.read_text()
    assert "signature checked" not in out.read_text()
    path.write_bytes(pack(today, {}, Signer(key)))
    boxes.write_text(f"Bird {path} {other}\n")
    assert "not by its key" in invoke(f"fleet {boxes} --out {out}").out
    boxes.write_text(f"Bird {path}\n")
    assert invoke(f"fleet {boxes} --out {out}").out.count("signature not checked") == 1
    assert out.read_text().count("signature not checked") == 1


def test_a_key_behind_a_status_page_or_that_is_none_is_refused(tmp_path: Path):
    boxes, digests = tmp_path / "boxes", tmp_path / "digests"
    digests.mkdir()
    boxes.write_text("Bird http://10.0.0.7:8480/?token=secret device.pub\n")
    with pytest.raises(ConfigError, match="line 1: expected a key after a digest") as caught:
        load_boxes([str(boxes)])
    assert "secret" not in str(caught.value)
    boxes.write_text(f"Bird {digests} {tmp_path / 'none.pub'}\n")
    with pytest.raises(UserError, match=r"none\.pub"):
        load_boxes([str(boxes)])


def test_the_fleet_bounds_what_digests_say(busy: Path, tmp_path: Path):
    path, today = tmp_path / "digest-1.zip", datetime.now(UTC).date()
    write_digest(busy, DAY, path, Signer(None))
    content = content_of(path)
    content["box"] |= {"is_healthy": False, "problems": ["\ud800" + "x" * 9000]}
    (tmp_path / os.fsdecode(b"digest-\xff.zip")).write_bytes(b"none")
    out, states = tmp_path / "fleet.html", list[BoxState]()
    for day in (today, date(2999, 1, 1)):
        text = json.dumps(content | {"day": str(day)})
        path.write_bytes(zipped(text, zipfile.ZIP_DEFLATED))
        states += ask_all([BoxState(box=box) for box in load_boxes([str(path)])])
    assert len(states[0].alarms[0]) < 400
    assert states[1].error == "its last digest is of 2999-01-01"  # and is not healthy for ever
    for box in (path, tmp_path):
        assert invoke(f"fleet {box} --out {out}").code == 0
    assert "expected a digest" in out.read_text()
