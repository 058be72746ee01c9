"""The report: one file that opens offline and says of every fish what its recording says."""

import re
import shutil
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from stream_dmr.errors import OutputError, SourceError
from stream_dmr.messages import FittedMesh, LocalizedFish
from stream_dmr.pipeline.measure_source import measure_source
from stream_dmr.recording.reading import decoded_messages, open_recordings
from stream_dmr.store.edits import ReviewedMessages
from stream_dmr.store.verdicts import Verdict, add_verdict
from stream_dmr.web import open_reports
from stream_dmr.web.open_reports import open_report, write_report
from stream_dmr.web.review_queue import ReviewQueue
from stream_dmr.web.views import draw_views, read_tracks
from tests.support.browser import Tab, evaluate
from tests.support.command import invoke, rows
from tests.support.fish_run import measure, request
from tests.support.small_disk import file_size_limit
from tests.support.tiny_clip import write_clip


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return measure(tmp_path_factory.mktemp("report"), vessel="<b>Sea</b> & Bird", haul="3")


@pytest.fixture(scope="module")
def page(out: Path) -> Path:
    target = out.parent / "report.html"
    outcome = invoke("report", {str(out): None, "--out": str(target)})
    assert outcome.code == 0, outcome.err
    return target


def test_the_best_views_are_the_best_of_all(out: Path):
    recording = open_recordings([out])
    tracks = read_tracks(ReviewedMessages(recording), max_views=2)
    ious: dict[int, list[float]] = {}
    for fish, _ in decoded_messages(recording, [LocalizedFish]):
        assert isinstance(fish, LocalizedFish)
        assert fish.iou is not None
        ious.setdefault(fish.track_id, []).append(fish.iou)
    assert ious.keys() == tracks.keys()
    for track_id, track in tracks.items():
        assert len(track.rows) == len(ious[track_id])
        best = [view.row.fish.iou for view in track.views]
        if all(row.estimate.is_frame_used for row in track.rows):
            assert best == sorted(ious[track_id], reverse=True)[:2]


def test_outlines_lie_on_the_mask_and_on_the_mesh(out: Path):
    recording = open_recordings([out])
    tracks = read_tracks(ReviewedMessages(recording))
    album = draw_views(tracks, recording)
    fits = {
        (fit.track_id, fit.frame_index): fit
        for fit, _ in decoded_messages(recording, [FittedMesh])
        if isinstance(fit, FittedMesh)
    }
    for track_id, shots in album.items():
        for shot in shots:
            size, frame = shot.crop_camera.width, shot.recorded.row.fish.frame_index
            drawn = [np.zeros((size, size), np.uint8) for _ in range(2)]
            for image, lines in zip(drawn, (shot.outlines.mask, shot.outlines.mesh), strict=True):
                for line in lines:
                    cv2.fillPoly(image, [np.round(line).astype(np.int32)], 1)
            mask, mesh = (image > 0 for image in drawn)
            iou = (mask & mesh).sum() / (mask | mesh).sum()
            shape = fits[track_id, frame].shape
            assert shape is not None
            assert iou == pytest.approx(shape.iou, abs=0.06)


def test_pictures_come_from_the_clip_and_without_it_from_the_mask(out: Path, tmp_path: Path):
    recording = open_recordings([out])
    tracks = read_tracks(ReviewedMessages(recording))
    seen = draw_views(tracks, recording)[1][0].picture
    clip = out.parent / "clip" / "video.mp4"
    assert draw_views(tracks, recording, str(clip))[1][0].picture == seen
    image = cv2.imdecode(np.frombuffer(seen, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image.max() > 150  # the light ground of the clip; a mask alone is darker
    other = tmp_path / "other.mp4"
    size = (160, 120)
    writer = cv2.VideoWriter(str(other), cv2.VideoWriter_fourcc(*"mp4v"), 10, size)
    for _ in range(9):
        writer.write(np.full((120, 160, 3), 9, np.uint8))
    writer.release()
    with pytest.raises(SourceError, match="not the recorded one"):
        draw_views(tracks, recording, str(other))
    with pytest.raises(SourceError, match="not the recorded one"):
        open_report(out, source=str(other), max_drawn=0)  # of a review
    shutil.move(clip, tmp_path / "moved.mp4")
    try:
        masked = draw_views(tracks, recording)[1][0].picture
    finally:
        shutil.move(tmp_path / "moved.mp4", clip)
    image = cv2.imdecode(np.frombuffer(masked, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image.max() < 150


def test_the_page_needs_nothing_from_elsewhere(page: Path):
    text = page.read_text(encoding="utf-8")
    own = re.sub(r"<script>/\*\*\n\* plotly.*?</script>", "", text, count=1, flags=re.DOTALL)
    assert len(text) - len(own) > 1_000_000  # that was plotly
    assert not re.search(r'(?:src|href)="(?!data:)[^"]', own)
    assert "fetch(" not in own
    assert "http" not in own.replace("http://www.w3.org/2000/svg", "")


def test_what_the_browser_shows_is_what_was_measured(out: Path, page: Path):
    shown = evaluate(
        page,
        """
        const cells = () => [...document.querySelectorAll('.row')].map((row) => row.innerText);
        const before = cells();
        choose(2);
        const panel = document.getElementById('detail');
        const solid = panel.querySelector('.mesh-plot');
        while (!solid.data) await new Promise((done) => setTimeout(done, 50));
        const text = panel.innerText;
        const number = (query) => panel.querySelectorAll(query).length;
        const shapes = ['.views svg', '.views .mask', '.views .mesh', '.views .point'].map(number);
        const plots = panel.querySelectorAll('.js-plotly-plot').length;
        const frames = panel.querySelector('.plot').data;
        const histogram = document.getElementById('histogram').data;
        document.getElementById('longest').value = 0;
        show();
        return { before, text, shapes, plots, none: state.shown.length,
          points: frames[2].x.length + frames[3].x.length,
          faces: solid.data[0].i.length,
          corners: solid.data[0].x.length,
          bars: histogram[0].y.reduce((sum, n) => sum + n, 0) };
        """,
    )
    lengths = rows(out / "lengths.csv")
    assert len(shown["before"]) == len(lengths) == 2
    for text, row in zip(shown["before"], lengths, strict=True):
        assert f"{float(row['length_mm']) / 10:.1f} cm" in text
        assert f"{row['frames_used']} of {row['frames_seen']}" in text
    assert "<b>Sea</b> & Bird, 3" in shown["text"]
    assert shown["shapes"][0] == 3
    assert min(shown["shapes"][1:3]) >= 3
    assert shown["shapes"][3] == 9
    assert shown["plots"] == 2
    assert shown["points"] == int(lengths[1]["frames_seen"])
    assert shown["bars"] == 2
    template = open_recordings([out]).header.template
    assert (shown["faces"], shown["corners"]) == (len(template.faces), len(template.rest_vertices))
    assert shown["none"] == 0


def test_time_begins_at_the_first_frame_and_not_at_the_first_fish(tmp_path: Path):
    write_clip(tmp_path / "clip", fish=[[], [], [], [1], [1], [1]])
    measure_source(request(tmp_path / "clip", tmp_path / "out"), stop=threading.Event())
    write_report([open_report(tmp_path / "out")], tmp_path / "page.html", title="out")
    times = evaluate(
        tmp_path / "page.html",
        """
        const plot = document.getElementById('time');
        while (!plot.data) await new Promise((done) => setTimeout(done, 50));
        return [plot.data[1].x, plot.layout.xaxis.title.text];
        """,
    )
    assert times == [[pytest.approx(0.3)], "s from the first frame"]


def test_filters_sorting_and_verdicts(out: Path, tmp_path: Path):
    copied = Path(shutil.copytree(out, tmp_path / "out"))
    for verdict in (
        Verdict(track_id=1, kind="reject", reason="a glove", reviewer="Ada"),
        Verdict(track_id=2, kind="correct", frame_index=3, length_mm=777.0, reviewer="Ada"),
    ):
        add_verdict(copied / "lengths.db", verdict)
    target = tmp_path / "report.html"
    write_report([open_report(copied)], target, title="copied")
    shown = evaluate(
        target,
        """
        const rows = () => [...document.querySelectorAll('.row')];
        const ids = () => rows().map((row) => Number(row.dataset.id));
        const set = (id, value) => {
          document.getElementById(id).value = value;
          show();
          return ids();
        };
        const result = {};
        result.rejected = set('verdict', 'reject');
        result.corrected = set('verdict', 'corrected');
        set('verdict', '');
        result.glove = set('search', 'glove');
        set('search', '');
        state.column = 1; state.descending = true; show();
        result.backwards = ids();
        result.second = document.querySelector('[data-id="2"]').innerText;
        result.counted = document.getElementById('summary').innerText;
        const facts = (fish) => factList(fish).innerText;
        const surer = { ...DATA.fish[1], corrected_length_std_mm: 10 };
        result.facts = [facts(DATA.fish[1]), facts(surer)];
        return result;
        """,
    )
    assert (shown["rejected"], shown["glove"], shown["corrected"]) == ([1], [1], [2])
    assert shown["backwards"] == [2, 1]
    assert "77.7 cm" in shown["second"]
    assert "measured" in shown["second"]
    assert "1\nwith a length, not rejected" in shown["counted"]
    assert "standard deviation" not in shown["counted"]  # one fish has none
    without, with_interval = shown["facts"]
    assert "77.7 cm, 95 %" not in without
    assert "77.7 cm, 95 % interval 75.7 to 79.7 cm" in with_interval


@pytest.mark.parametrize("width", [1024, 700, 390])
def test_long_names_and_narrow_windows_cut_nothing(page: Path, width: int):
    tab = Tab(page.absolute().as_uri(), width=width, height=900)
    try:
        tab.run(
            """
            const name = 'x'.repeat(300);
            for (const one of document.querySelectorAll('h1, h2')) one.textContent = name;
            document.getElementById('notes').append(element('li', { textContent: name }));
            """
        )
        assert tab.cut() == []
        assert tab.run(
            """
            const reason = 'a glove of somebody '.repeat(9);
            Object.assign(DATA.fish[0], {
              verdict: 'reject', verdict_reason: reason, video: 'x'.repeat(15) });
            show();
            const row = document.querySelector('.row');
            const [, number] = row.children;
            if (number.scrollWidth > number.clientWidth) return false;
            return row.querySelector('img').offsetTop >= 0 && row.lastChild.title.includes(reason);
            """
        )
    finally:
        tab.close()


def test_the_open_fish_is_still_open_after_a_reload(page: Path):
    tab = Tab(page.absolute().as_uri())
    try:
        address = tab.run("choose(2); return location.href")
    finally:
        tab.close()
    assert evaluate(page, "return state.chosen") is None
    tab = Tab(address)
    try:
        assert tab.run("return state.chosen") == 2
    finally:
        tab.close()


def test_every_fish_is_on_paper(page: Path):
    tab = Tab(page.absolute().as_uri(), width=718, height=1000)
    try:
        tab.run(
            "const fish = (_, k) => ({ ...DATA.fish[0], id: k + 1 });"
            "DATA.fish = Array.from({ length: 60 }, fish); show();"
        )
        on_screen = "return document.querySelectorAll('.row').length"
        assert tab.run(on_screen) < 30
        tab.send("Emulation.setEmulatedMedia", media="print")
        rows, hidden_px = tab.run(
            """
            dispatchEvent(new Event('beforeprint'));
            const table = document.getElementById('table');
            const rows = document.querySelectorAll('.row').length;
            return [rows, table.scrollHeight - table.clientHeight];
            """
        )
        assert (rows, hidden_px) == (60, 0)
        tab.send("Emulation.setEmulatedMedia", media="")
        assert tab.run(f"dispatchEvent(new Event('afterprint')); {on_screen}") < 30
    finally:
        tab.close()


def test_thousands_of_fish_are_few_rows(page: Path):
    shown = evaluate(
        page,
        """
        const one = DATA.fish[0];
        const fish = (_, k) => ({ ...one, id: k + 1, length_mm: 500 + k });
        DATA.fish = Array.from({ length: 2000 }, fish);
        show();
        const most = document.querySelectorAll('.row').length;
        document.getElementById('table').scrollTop = 1000 * ROW_PX;
        drawRows(choose);
        return { most, middle: document.querySelector('.row').dataset.id };
        """,
    )
    assert shown["most"] < 30
    assert 990 < int(shown["middle"]) <= 1001


def test_a_full_disk_leaves_the_report_that_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    page = tmp_path / "report.html"
    page.write_text("before")
    monkeypatch.setattr(open_reports, "render_page", lambda *_, **__: "x" * 1000)
    with file_size_limit(100), pytest.raises(OutputError, match="too large"):
        open_reports.write_report([], page, title="")
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [(page.name, "before")]


def test_a_large_report_has_the_pictures_of_its_last_fish(out: Path, tmp_path: Path):
    other = Path(shutil.copytree(out, tmp_path / "other"))
    reports, _ = open_reports.open_folders([out, other], max_drawn=3)
    drawn = [[bool(report.drawn(k).views) for k in (1, 2)] for report in reports]
    assert drawn == [[False, True], [True, True]]
    page = tmp_path / "report.html"
    write_report(reports, page, title="two")
    assert "the first 1 of 4 fish are here without their frames and pictures" in page.read_text()
    shown = evaluate(
        page,
        """
        const seen = [];
        for (const fish of DATA.fish.slice(0, 2)) {
          state.chosen = fish.id;
          await drawDetail(fish);
          seen.push(document.querySelectorAll('.views svg').length);
        }
        return [DATA.fish.length, ...seen];
        """,
    )
    assert shown == [4, 0, 3]


def test_a_review_reads_no_fish_before_it_is_opened(out: Path, monkeypatch: pytest.MonkeyPatch):
    queue = ReviewQueue([open_report(out, max_drawn=0)], reviewer="Ada")
    with monkeypatch.context() as patched:
        patched.delattr(ReviewedMessages, "decoded")
        assert "Choose a fish" in queue.page("x")
    assert len(queue.detail(0, 1)["views"]) == 3
    assert queue.thumbnail(0, 1)
