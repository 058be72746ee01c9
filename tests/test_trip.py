"""A simulated trip from `run` to the map, the report, the review and each export, in Chromium."""

import json
import shutil
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from stream_dmr.evidence.verify_folder import verify
from stream_dmr.simulation.write_scene import write_scene
from stream_dmr.store.fish import read_runs
from stream_dmr.store.verdicts import read_verdicts
from stream_dmr.web.open_reports import open_folders
from stream_dmr.web.review_queue import ReviewQueue, ReviewServer
from tests.support.browser import Tab
from tests.support.command import invoke, rows
from tests.support.small_classifier import crops_of, train_classifier
from tests.support.trip import CODES, NAMES, START_UTC, Trip, make_trip, small_scene
from tests.web.test_keyboard import WAIT

pytestmark = pytest.mark.slow  # each part has tests of its own

_CONFIG = f"""
[zones]
landed = [[0, 0], [640, 0], [640, 190], [0, 190]]
dropped = [[0, 290], [640, 290], [640, 480], [0, 480]]

[hauls]
pause_min = 10

[sensors]
start_utc = "{START_UTC}"
"""
_EXPORTS = (
    {"--fish": "csv", "--hauls": None, "--viame": None, "--masks": None, "--agency": "wcpfc"},
    {"--fish": "parquet", "--agency": "rdbes"},
)


@dataclass(frozen=True, kw_only=True)
class Measured:
    trip: Trip
    out: Path
    exported: Path
    report: Path
    printed: str


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Measured:
    folder = tmp_path_factory.mktemp("trip")
    trip = make_trip(folder)
    config = folder / "config.toml"
    config.write_text(f'[species]\nmodel = "{_classifier(folder / "learnt")}"\n{_CONFIG}')
    given = {"source": "video.mp4", "masks": "masks", "calibration": "calibration.yaml"}
    given |= {"nmea": "track.nmea", "config": "config.toml", "out": "out"}
    options = {f"--{name}": str(folder / value) for name, value in given.items()}
    done = invoke("run", options | {"--vessel": "Sea Bird", "--trip": "26-11"})
    assert done.code == 0, done.err
    out, exported, report = folder / "out", folder / "exported", folder / "report.html"
    for asked in _EXPORTS:
        one = invoke("export", {"--out": str(exported), **asked, str(out): None})
        assert one.code == 0, one.err
    assert invoke("report", {str(out): None, "--out": str(report)}).code == 0
    return Measured(trip=trip, out=out, exported=exported, report=report, printed=done.out)


def _classifier(folder: Path) -> Path:
    """Trained on other fish of the two species."""
    write_scene(folder, small_scene(num_fish=10, num_frames=50, seed=1), species=NAMES)
    names, pictures = NAMES.split(","), defaultdict[str, list[np.ndarray]](list)
    for crop in crops_of(folder):
        assert crop.image is not None
        pictures[CODES[names[(crop.track_id - 1) % 2]]].append(crop.image)
    return train_classifier(folder / "species.onnx", pictures)


def test_the_run_counts_species_and_fates(measured: Measured):
    assert "species: 3 HAL, 3 COE" in measured.printed
    assert "fate: 4 landed, 2 dropped" in measured.printed
    assert verify(measured.out)[0] == []
    (facts,) = read_runs(measured.out / "lengths.db").values()
    model = measured.trip.folder / "learnt" / "species.onnx"
    assert facts.species_model_sha256 == sha256(model.read_bytes()).hexdigest()
    for folder in (measured.out, measured.exported):
        assert facts.species_model_sha256 in (folder / "provenance.json").read_text()
    assert invoke("verify", {str(measured.exported): None}).code == 0


def test_the_table_of_fish_has_the_truth(measured: Measured):
    table = rows(measured.exported / "fish.csv")
    assert len(table) == len(measured.trip.fish)
    for row, true in zip(table, measured.trip.fish, strict=True):
        assert row["track_id"] == str(true.track_id)
        assert row["length_type"] == "ForkLength"
        found = (row["haul"], row["species_code"], row["fate"], row["vessel"], row["trip"])
        assert found == (true.haul, true.species_code, true.fate, "Sea Bird", "26-11")
        assert int(row["time_utc_ns"]) == pytest.approx(true.utc_ns, abs=1)
        place = (float(row["latitude"]), float(row["longitude"]))
        assert place == pytest.approx(true.place, abs=1e-5)  # a metre
        assert float(row["speed_knots"]) == pytest.approx(5.0)
        assert float(row["ci95_low_mm"]) < true.length_mm < float(row["ci95_high_mm"])
        assert float(row["length_mm"]) == pytest.approx(true.length_mm, rel=0.04)
    parquet = pq.read_table(measured.exported / "fish.parquet").to_pylist()
    for name in ("haul", "species_code", "fate", "time_utc"):
        assert [one[name] for one in parquet] == [row[name] for row in table]


def test_hauls_and_agency_tables_have_the_truth(measured: Measured):
    fish = measured.trip.fish
    hauls = rows(measured.exported / "hauls.csv")
    assert [(h["haul"], h["num_fish"], h["num_measured"]) for h in hauls] == [
        (number, "2", "2") for number in "123"
    ]
    for haul in hauls:
        fates = [one.fate for one in fish if one.haul == haul["haul"]]
        for fate in ("landed", "dropped", "cut off"):
            assert haul[f"num_{fate.replace(' ', '_')}"] == str(fates.count(fate))
    assert [haul["began_utc"][:16] for haul in hauls] == [
        f"2026-11-22T0{6 + k}:00" for k in range(3)
    ]
    wcpfc = rows(measured.exported / "wcpfc.csv")
    assert [(r["set_number"], r["species_code"], r["comments"]) for r in wcpfc] == [
        (one.haul, one.species_code, f"fate by zones: {one.fate}") for one in fish
    ]
    for row, one in zip(wcpfc, fish, strict=True):
        degrees = int(row["latitude"][:2]) + float(row["latitude"][2:-1]) / 60
        assert degrees == pytest.approx(one.place[0], abs=2e-5)
        assert row["longitude"].endswith("W")
    rdbes = rows(measured.exported / "rdbes.csv")
    for row, one in zip(rdbes, fish, strict=True):
        assert (row["FOstationNumber"], row["SAspeciesCodeFAO"]) == (one.haul, one.species_code)
        assert float(row["FOlongitude"]) == pytest.approx(one.place[1], abs=2e-5)
        assert float(row["BVvalueMeasured"]) == pytest.approx(one.length_mm, rel=0.04)


def test_tracks_and_masks_have_each_fish_in_its_frames(measured: Measured):
    lines = (measured.exported / "tracks.viame.csv").read_text().splitlines()
    tracks = [line.split(",") for line in lines if not line.startswith("#")]
    coco = json.loads((measured.exported / "masks.json").read_text())
    for true in measured.trip.fish:
        of_fish = [cells for cells in tracks if cells[0] == str(true.track_id)]
        masks = [one for one in coco["annotations"] if one["track_id"] == true.track_id]
        assert len(of_fish) == len(masks) > 10
        assert {cells[9] for cells in of_fish} == {true.species_code}
        (category,) = {one["category_id"] for one in masks}
        names = {one["id"]: one["name"] for one in coco["categories"]}
        assert names[category] == true.species_code
    assert "# metadata,Fps: 15,fps: 15" in lines


@pytest.fixture(params=[1400, 390])
def width(request: pytest.FixtureRequest) -> int:
    return request.param


@pytest.fixture
def report(measured: Measured, width: int) -> Iterator[Tab]:
    tab = Tab(measured.report.as_uri(), width=width, height=900)
    yield tab
    tab.close()


def test_the_report_shows_hauls_species_fates_and_where(
    measured: Measured, report: Tab, tmp_path: Path
):
    seen = report.run(
        WAIT
        + """
        const trip = document.getElementById("trip");
        const texts = (from) => [...from.querySelectorAll("td")].map((one) => one.textContent);
        document.querySelector(".row").click();
        await until(() => document.querySelectorAll(".views svg").length === 3);
        return {
          heading: trip.querySelector("h2").textContent,
          hauls: [...trip.querySelectorAll("tr")].slice(1).map(texts),
          dots: [...trip.querySelectorAll("circle")].map((one) =>
            [Number(one.getAttribute("cx")), one.getAttribute("fill"), one.textContent]),
          track: trip.querySelectorAll("polyline").length,
          summary: document.getElementById("summary").textContent,
          list: [...document.querySelectorAll(".row")].map((one) => one.innerText),
          detail: document.getElementById("detail").innerText,
          photographs: [...document.querySelectorAll(".row img")].map((one) => one.src),
        };
        """
    )
    fish = measured.trip.fish
    assert seen["heading"] == ("Sea Bird, trip 26-11, hauls 1, 2, 3: 2026-11-22 06:00 to 08:00 UTC")
    for number, cells in enumerate(seen["hauls"], start=1):
        of_haul = [one for one in fish if one.haul == str(number)]
        assert (cells[0], cells[3], cells[4], cells[5]) == (str(number), "100 %", "2", "2")
        assert cells[7] == "1 HAL, 1 COE"
        assert sorted(cells[8].split(", ")) == sorted(
            {f"{[o.fate for o in of_haul].count(one.fate)} {one.fate}" for one in of_haul}
        )
    assert len(seen["hauls"]) == 3
    assert "3 HAL, 3 COEspecies4 landed, 2 droppedfate" in seen["summary"]
    assert seen["track"] == 1
    xs, colours, titles = zip(*seen["dots"], strict=True)
    assert sorted(xs) == list(xs)  # the vessel goes east
    assert [colours.index(colour) for colour in colours] == [0, 0, 2, 2, 4, 4]
    for title, one in zip(titles, fish, strict=True):
        assert title.startswith(f"fish {one.track_id}, ")
        assert title.endswith(f"cm, {one.species_code}, {one.fate}")
    for text, one in zip(seen["list"], fish, strict=False):
        assert f"haul {one.haul}" in text
        assert one.fate in text
    assert "57.4000° N 150.9000° W, 5.0 kn" in seen["detail"]
    assert "2026-11-22T06:00:00" in seen["detail"]
    assert all(address.startswith("data:image/webp") for address in seen["photographs"])
    assert report.cut() == []
    assert report.asked() == []
    report.picture(tmp_path / "report.png")
    assert (tmp_path / "report.png").stat().st_size > 20_000


def test_the_trip_is_reviewed_by_the_keyboard(measured: Measured, width: int, tmp_path: Path):
    out = Path(shutil.copytree(measured.out, tmp_path / "out"))
    reports, _ = open_folders([out])
    server = ReviewServer(ReviewQueue(reports, reviewer="Ada"), title="trip")
    tab = Tab(server.address, width=width, height=900)
    try:
        frames = tab.run(
            WAIT
            + """
            document.querySelector("#trip details").open = true;
            const frames = [];
            for (let id = 1; id <= DATA.fish.length; id += 1) {
              if (state.chosen !== id) choose(id);
              await until(() => player.fish?.id === id && player.clip?.isDone);
              frames.push(player.clip.frames.map((one) => one.image !== null));
              key("a");
              await until(() => DATA.fish[id - 1].verdict === "accept");
            }
            return frames;
            """
        )
        assert tab.cut() == []
        assert all(url.startswith(server.address.split("?")[0]) for url in tab.asked())
        tab.picture(tmp_path / "review.png")
    finally:
        tab.close()
        server.close()
    assert len(frames) == 6
    assert all(all(pictures) and len(pictures) > 16 for pictures in frames)
    decided = [(one.track_id, one.kind) for one in read_verdicts(out / "lengths.db")]
    assert decided == [(number, "accept") for number in range(1, 7)]
    assert verify(out)[0] == []
