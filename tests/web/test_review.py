"""Reviewing: verdicts come in by the page, are checked, and change no measurement."""

import json
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from stream_dmr.camera import crop_from_frame
from stream_dmr.errors import OutputError, UserError
from stream_dmr.evidence.verify_folder import verify
from stream_dmr.messages import FishCrop, FittedMesh
from stream_dmr.recording.codec import decode
from stream_dmr.store.edits import corrected_fish, corrected_length
from stream_dmr.store.fish import Fish, read_stored_fish
from stream_dmr.store.verdicts import read_verdicts
from stream_dmr.web import report_page
from stream_dmr.web.open_reports import open_report
from stream_dmr.web.report_page import RunReport, render_page
from stream_dmr.web.review_queue import ReviewQueue, ReviewServer
from tests.support.browser import Tab
from tests.support.command import rows


@pytest.fixture
def report(out: Path) -> RunReport:
    return open_report(out)


@pytest.fixture
def judge(report: RunReport) -> ReviewQueue:
    return ReviewQueue([report], reviewer="Ada")


def test_a_page_makes_each_row_once_and_tells_of_a_run_once(
    judge: ReviewQueue, monkeypatch: pytest.MonkeyPatch
):
    made, told, row = list[int](), list[object](), report_page.summary_row

    def counting(fish: Fish, of_report: RunReport) -> dict[str, Any]:
        made.append(fish.estimate.track_id)
        return row(fish, of_report)

    def telling(facts: Any) -> dict[str, Any]:
        told.append(facts)
        return asdict(facts)

    monkeypatch.setattr(report_page, "summary_row", counting)
    monkeypatch.setattr(report_page, "asdict", telling)
    judge.page("x")
    assert len(made) == len({*made}) > 1
    assert len(told) == 1


def submit(judge: ReviewQueue, **said: Any) -> dict[str, Any]:
    return judge.record(json.dumps(said).encode())["rows"][0]


def ends(report: RunReport, track_id: int) -> tuple[int, FittedMesh, list[list[float]]]:
    """The best frame of a fish, its fit, and its head and tail in pixels of the crop."""
    view = report.drawn(track_id).views[0].recorded
    crop, fit = decode(FishCrop, view.crop), decode(FittedMesh, view.fit)
    assert fit.shape is not None
    pixels = crop_from_frame(
        fit.shape.keypoints_px, crop_camera=crop.crop_camera, frame_camera=crop.frame_camera
    )
    return fit.frame_index, fit, pixels[[0, 2]].tolist()


def test_points_left_where_they_are_give_the_length_of_their_frame(
    judge: ReviewQueue, report: RunReport
):
    frame_index, fit, (head, tail) = ends(report, 1)
    row = submit(judge, track_id=1, kind="correct", frame_index=frame_index, head=head, tail=tail)
    of_frame = report.drawn(1).views[0].recorded.row.fish
    assert fit.shape is not None
    assert row["corrected_length_mm"] == pytest.approx(of_frame.length_mm, rel=1e-6)
    assert row["length_from"] == "review"


def test_a_tail_further_out_is_a_longer_fish(judge: ReviewQueue, report: RunReport, out: Path):
    before = rows(out / "lengths.csv")
    frame_index, _, (head, tail) = ends(report, 1)
    further = (np.array(tail) + 0.1 * (np.array(tail) - np.array(head))).tolist()
    row = submit(
        judge, track_id=1, kind="correct", frame_index=frame_index, head=head, tail=further
    )
    of_frame = report.drawn(1).views[0].recorded.row.fish.length_mm
    assert of_frame is not None
    assert row["corrected_length_mm"] == pytest.approx(1.1 * of_frame, rel=0.03)
    assert row["length_mm"] == pytest.approx(float(before[0]["length_mm"]), abs=1e-6)
    assert rows(out / "lengths.csv") == before
    assert verify(out)[0] == []


def test_two_corrected_frames_are_put_together_as_a_run_does(judge: ReviewQueue, report: RunReport):
    frames = {}
    row: dict[str, Any] = {}
    for view in report.drawn(1).views[:2]:
        crop = decode(FishCrop, view.recorded.crop)
        fit = decode(FittedMesh, view.recorded.fit)
        assert fit.shape is not None
        points = fit.shape.keypoints_px[[0, 2]]
        head, tail = crop_from_frame(
            points, crop_camera=crop.crop_camera, frame_camera=crop.frame_camera
        ).tolist()
        frames[fit.frame_index] = corrected_fish(report.recording, fit, points)
        said = {"frame_index": fit.frame_index, "head": head, "tail": tail}
        row = submit(judge, track_id=1, kind="correct", **said)
    together = corrected_length(report.recording, frames)
    assert row["corrected_length_mm"] == pytest.approx(together.length_mm, rel=1e-6)
    assert together.frames_used == 2
    submit(judge, track_id=1, kind="withdraw")
    assert judge.reviewed_rows()[0]["corrected_length_mm"] is None


def test_every_verdict_is_kept_with_its_reviewer(judge: ReviewQueue, out: Path):
    submit(judge, track_id=1, kind="reject", reason=" a glove ")
    submit(judge, track_id=1, kind="species", species="Gadus morhua")
    row = submit(judge, track_id=2, kind="duplicate", duplicate_of=1)
    assert (row["verdict"], row["duplicate_of"], row["reviewer"]) == ("duplicate", 1, "Ada")
    assert [v.kind for v in read_verdicts(out / "lengths.db")] == ["reject", "species", "duplicate"]
    one = read_stored_fish(out / "lengths.db")[0]
    assert (one.review.decision, one.review.reason) == ("reject", "a glove")
    assert one.review.species == "Gadus morhua"
    assert {row["track_id"] for row in judge.reviewed_rows()} == {1, 2}


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b'{"track_id": 1}',
        b'{"track_id": "1", "kind": "accept"}',
        b'{"track_id": 9, "kind": "accept"}',
        b'{"track_id": 1, "kind": "accept", "length_mm": 5}',
        b'{"track_id": 1, "kind": "reject"}',
        b'{"track_id": 1, "kind": "correct"}',
        b'{"track_id": 1, "kind": "correct", "frame_index": 99, "head": [1, 2], "tail": [3, 4]}',
        b'{"track_id": 1, "kind": "correct", "frame_index": 1, "head": [1, NaN], "tail": [3, 4]}',
    ],
)
def test_what_is_no_verdict_is_refused_and_not_kept(judge: ReviewQueue, out: Path, content: bytes):
    with pytest.raises(UserError):
        judge.record(content)
    assert read_verdicts(out / "lengths.db") == []


def test_head_and_tail_on_one_spot_give_no_length(judge: ReviewQueue, report: RunReport):
    _, fit, _ = ends(report, 1)
    assert fit.shape is not None
    with pytest.raises(UserError, match="give no length"):
        corrected_fish(report.recording, fit, fit.shape.keypoints_px[[2, 0]])  # the wrong way round


def serve(report: RunReport, *, reviewer: str, port: int = 0) -> ReviewServer:
    return ReviewServer(ReviewQueue([report], reviewer=reviewer), title="out", port=port)


@pytest.fixture
def server(report: RunReport) -> Iterator[ReviewServer]:
    served = serve(report, reviewer="Ada <Byron>")
    yield served
    served.close()


def post(server: ReviewServer, content: bytes, **headers: str) -> int:
    address, token = server.address.split("?token=")
    known = {"Content-Type": "application/json", "Authorization": f"Bearer {token}"}
    request = urllib.request.Request(
        f"{address}verdict", data=content, headers=known | headers, method="POST"
    )
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        with error:
            return error.code


def test_only_who_has_the_token_may_judge(server: ReviewServer, out: Path):
    good = b'{"track_id": 1, "kind": "accept"}'
    assert post(server, good, Authorization="Bearer wrong") == 401
    assert post(server, good, **{"Content-Type": "text/plain"}) == 404  # a form of another site
    assert post(server, good + b" " * 70000) == 400
    assert post(server, b"{}") == 400
    with pytest.raises(urllib.error.HTTPError, match="401"):
        urllib.request.urlopen(server.address.split("?")[0], timeout=10)
    assert read_verdicts(out / "lengths.db") == []
    assert post(server, good) == 200
    assert len(read_verdicts(out / "lengths.db")) == 1


def test_two_reviews_in_one_browser_keep_their_cookies(server: ReviewServer, report: RunReport):
    other = serve(report, reviewer="Bob")
    try:
        cookies = [first_cookie(one.address) for one in (server, other)]
        for one in (server, other):
            address = one.address.split("?")[0] + "reviewed.json"
            request = urllib.request.Request(address, headers={"Cookie": "; ".join(cookies)})
            with urllib.request.urlopen(request, timeout=10) as answer:
                assert answer.status == 200
    finally:
        other.close()


def first_cookie(address: str) -> str:
    url = urlsplit(address)
    connection = HTTPConnection(url.netloc, timeout=10)
    connection.request("GET", f"/?{url.query}")
    with closing(connection):
        return str(connection.getresponse().headers["Set-Cookie"]).split(";")[0]


def test_a_recording_alone_takes_no_verdicts(out: Path):
    with pytest.raises(UserError, match=r"with its lengths\.db"):
        ReviewQueue([open_report(out / "recording.mcap")], reviewer="Ada")


def test_a_port_in_use_is_refused(server: ReviewServer, report: RunReport):
    port = int(server.address.split(":")[2].split("/")[0])
    with pytest.raises(OutputError, match="another --port"):
        serve(report, reviewer="Ada", port=port)


HELPERS = """
let open = 0;
const fetched = window.fetch;
const answered = async (...what) => {
  const answer = await fetched(...what);
  await answer.clone().text();
  return answer;
};
window.fetch = (...what) => { open += 1; return answered(...what).finally(() => { open -= 1; }); };
window.settled = async () => {
  do await new Promise((done) => setTimeout(done, 100)); while (open);
  await new Promise((done) => setTimeout(done, 100));  // for what is done with the answer
};
window.press = async (id) => {
  document.getElementById(id).click();
  await settled();
};
window.fill = (id, value) => { document.getElementById(id).value = value; };
window.where = (name) => {
  const point = document.querySelector(`.views svg [data-name="${name}"]`);
  const { x, y, width, height } = point.getBoundingClientRect();
  return [x + width / 2, y + height / 2, point.cx.baseVal.value, point.cy.baseVal.value];
};
"""


@pytest.fixture
def tab(server: ReviewServer) -> Iterator[Tab]:
    opened = Tab(server.address)
    opened.run(HELPERS)
    yield opened
    opened.close()


def test_a_reviewer_clicks_through_it(tab: Tab, out: Path):
    shown = tab.run(
        """
        choose(1);
        await settled();
        await press('do-reject');
        const refusal = document.getElementById('message').textContent;
        fill('reason', 'a <b>glove</b>');
        await press('do-reject');
        choose(1);
        await settled();
        fill('species-name', 'Gadus morhua');
        await press('do-species');
        choose(2);
        await settled();
        fill('duplicate-of', '1');
        await press('do-duplicate');
        return { refusal, row: document.querySelector('[data-id="1"]').innerText };
        """
    )
    assert "reason" in shown["refusal"]
    assert "a <b>glove</b>" in shown["row"]
    verdicts = read_verdicts(out / "lengths.db")
    said = [(verdict.track_id, verdict.kind) for verdict in verdicts]
    assert said == [(1, "reject"), (1, "species"), (2, "duplicate")]
    assert {verdict.reviewer for verdict in verdicts} == {"Ada <Byron>"}


@pytest.mark.parametrize("by_finger", [pytest.param(False, marks=pytest.mark.slow), True])
def test_points_are_dragged_and_stay_where_they_were_put(tab: Tab, out: Path, by_finger: bool):
    tab.run(
        "choose(1); await settled(); "
        "document.querySelector('.views').scrollIntoView({ block: 'center' }); return 0"
    )
    x, y, *_ = tab.run("return where('tail')")
    # A finger comes down beside the point, and the point keeps that distance.
    path = [(x + 5 * by_finger, y + step + 5 * by_finger) for step in (0, 4, 9, 12)]
    if by_finger:
        tab.send("Emulation.setTouchEmulationEnabled", enabled=True)
        tab.touch("touchStart", path[0])
        for place in path[1:]:
            tab.touch("touchMove", place)
        tab.touch("touchEnd")
    else:
        tab.mouse("mousePressed", *path[0])
        for place in path[1:]:
            tab.mouse("mouseMoved", *place)
        tab.mouse("mouseReleased", *path[-1])
        tab.mouse("mouseMoved", x + 50, y + 50, is_down=False)
    after = tab.run("return where('tail')")
    assert after[:2] == pytest.approx([x, y + 12], abs=0.5)
    saved = tab.run("await press('do-correct'); return where('tail')")
    assert saved[2:] == pytest.approx(after[2:], abs=1)
    (verdict,) = read_verdicts(out / "lengths.db")
    (measured, *_) = read_stored_fish(out / "lengths.db")
    assert measured.estimate.length_mm is not None
    assert measured.length_mm == verdict.length_mm
    assert verdict.length_mm is not None
    assert abs(verdict.length_mm / measured.estimate.length_mm - 1) > 0.02


def test_another_reviewers_verdicts_come_in(tab: Tab, report: RunReport, server: ReviewServer):
    other = serve(report, reviewer="Bob")
    try:
        assert post(other, b'{"track_id": 2, "kind": "reject", "reason": "a glove"}') == 200
        assert post(other, b'{"track_id": 2, "kind": "species", "species": "Gadus morhua"}') == 200
    finally:
        other.close()
    row = tab.run(
        """await refresh();
        return document.querySelector('[data-id="2"]').innerText"""
    )
    assert "a glove" in row
    assert "Gadus morhua" in row


def test_a_verdict_that_nobody_takes_is_said_to_be_lost(tab: Tab, server: ReviewServer, out: Path):
    tab.run("choose(1); await settled(); return 0")
    server.close()
    said = "return document.getElementById('message').textContent"
    assert "Not saved" in tab.run(f"await press('do-accept'); {said}")
    assert read_verdicts(out / "lengths.db") == []


def test_a_corrected_length_has_its_own_interval(tab: Tab, judge: ReviewQueue, report: RunReport):
    frame_index, _, (head, tail) = ends(report, 1)
    further = (np.array(tail) + 0.2 * (np.array(tail) - np.array(head))).tolist()
    row = submit(
        judge, track_id=1, kind="correct", frame_index=frame_index, head=head, tail=further
    )
    mm, std = row["corrected_length_mm"], row["corrected_length_std_mm"]
    shown = tab.run("await refresh(); return document.querySelector('[data-id=\"1\"]').innerText")
    assert f"{(mm - 1.96 * std) / 10:.1f} to {(mm + 1.96 * std) / 10:.1f}" in shown


def test_moved_points_are_in_the_report(judge: ReviewQueue, report: RunReport, out: Path):
    frame_index, _, (head, tail) = ends(report, 1)
    further = (np.array(tail) + 0.1 * (np.array(tail) - np.array(head))).tolist()
    submit(judge, track_id=1, kind="correct", frame_index=frame_index, head=head, tail=further)
    view = judge.detail(0, 1)["views"][0]
    assert view["moved"]
    shown = [view["keypoints"][0], view["keypoints"][2]]
    assert shown == [pytest.approx(head, abs=0.01), pytest.approx(further, abs=0.01)]
    text = render_page([open_report(out)], title="out")
    assert f'"keypoints":{json.dumps(view["keypoints"], separators=(",", ":"))}' in text
    submit(judge, track_id=1, kind="withdraw")
    assert not judge.detail(0, 1)["views"][0]["moved"]


def test_a_key_that_is_held_judges_one_fish(tab: Tab, out: Path):
    tab.run("choose(1); await settled();")
    for is_held in (False, *[True] * 5):
        tab.send("Input.dispatchKeyEvent", type="keyDown", key="a", text="a", autoRepeat=is_held)
        tab.run("await settled();")
    assert [(v.kind, v.track_id) for v in read_verdicts(out / "lengths.db")] == [("accept", 1)]


def test_the_small_picture_of_a_fish_that_was_split_is_its_new_one(tab: Tab):
    def asked() -> int:
        return len([url for url in tab.asked() if "thumbnail?" in url and "fish=1" in url])

    tab.run("choose(1); await press('do-accept'); choose(1); await settled();")
    before = asked()
    assert before == 1
    tab.run("await send({ kind: 'split', frame_index: 3 }); await settled();")
    assert asked() == before + 1
