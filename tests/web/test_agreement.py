"""Agreement of readings: known answers, and what no pair of readers can exceed."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.errors import UserError
from stream_dmr.evidence.verify_folder import verify
from stream_dmr.store.batch_folder import VIDEO_COLUMNS, VIDEOS
from stream_dmr.store.fish import read_stored_fish
from stream_dmr.store.verdicts import read_verdicts
from stream_dmr.web.agreement import agreements, cohens_kappa, length_agreement
from stream_dmr.web.open_reports import open_report, run_folders
from stream_dmr.web.review_queue import AuditSample, ReviewQueue, measured_numbers, sampled
from tests.support.command import invoke

labels = st.sampled_from(["accept", "reject", "duplicate"])


def test_kappa_of_a_known_table():
    # 20 both yes, 5 yes and no, 10 no and yes, 15 both no: p_o = 0.7, p_e = 0.5
    first = ["yes"] * 25 + ["no"] * 25
    second = ["yes"] * 20 + ["no"] * 5 + ["yes"] * 10 + ["no"] * 15
    assert cohens_kappa(first, second) == pytest.approx(0.4)
    assert cohens_kappa(["yes"] * 3, ["yes"] * 3) is None
    assert cohens_kappa([], []) is None


@given(st.lists(st.tuples(labels, labels), min_size=1))
def test_kappa_is_symmetric_and_one_for_equal_readers(pairs: list[tuple[str, str]]):
    first, second = [a for a, _ in pairs], [b for _, b in pairs]
    kappa = cohens_kappa(first, second)
    assert kappa == cohens_kappa(second, first)
    assert kappa is None or kappa <= 1
    if len(set(first)) > 1:
        assert cohens_kappa(first, first) == pytest.approx(1)


def test_limits_of_agreement_of_known_differences():
    found = length_agreement([1.0, 2.0, 3.0])
    assert found.mean_mm == pytest.approx(2)
    assert found.limits_mm == pytest.approx((2 - 1.96, 2 + 1.96))
    assert length_agreement([5.0]).limits_mm is None
    assert length_agreement([]).mean_mm is None


def submit(queue: ReviewQueue, kind: str, track_id: int, **said: Any) -> None:
    queue.record(json.dumps({"kind": kind, "track_id": track_id, **said}).encode())


def test_a_blind_reader_sees_no_verdicts_and_changes_no_result(out: Path):
    with pytest.raises(UserError, match="expected verdicts to compare"):
        agreements([out])
    first = ReviewQueue([open_report(out)], reviewer="Ada")
    submit(first, "accept", 1)
    submit(first, "split", 2, frame_index=4)
    submit(first, "reject", 2, reason="glove")
    reviewed = [(f.estimate.track_id, f.review.decision) for f in fish_of(out)]
    second = ReviewQueue([open_report(out, as_measured=True)], reviewer="Grace", blind=True)
    assert "glove" not in second.page("x")
    assert {row["verdict"] for row in second.reviewed_rows() if "verdict" in row} == {None}
    frame = second.detail(0, 1)["views"][0]
    head, _, tail = frame["keypoints"]
    submit(second, "accept", 1)
    submit(second, "correct", 1, frame_index=frame["frame"], head=head, tail=tail)
    submit(second, "accept", 2)
    submit(second, "species", 2, species="Gadus morhua")
    with pytest.raises(UserError, match="blind"):
        submit(second, "split", 1, frame_index=3)
    rows = {row["track_id"]: row for row in second.reviewed_rows() if "verdict" in row}
    assert rows[2]["verdict"] == "accept"
    assert [(f.estimate.track_id, f.review.decision) for f in fish_of(out)] == reviewed
    pairs = {(pair.first, pair.second): pair for pair in agreements([out])}
    readers = pairs["review", "Grace"]
    assert (readers.decisions.count, readers.decisions.same) == (2, 1)
    assert readers.decisions.kappa == pytest.approx(0)
    assert (readers.species.count, readers.lengths.count) == (0, 0)
    assert pairs["measurement", "Grace"].lengths.count == 1
    printed = invoke("agreement", {str(out): None}).out
    assert "review and Grace" in printed
    assert "1 of 2 the same" in printed
    assert verify(out)[0] == []
    assert len(read_verdicts(out / "lengths.db")) == 7


def fish_of(out: Path) -> list[Any]:
    return read_stored_fish(out / "lengths.db")


def test_a_species_is_the_same_by_its_code_and_by_its_name(out: Path):
    submit(ReviewQueue([open_report(out)], reviewer="Ada"), "species", 1, species="COD")
    blind = ReviewQueue([open_report(out, as_measured=True)], reviewer="Grace", blind=True)
    submit(blind, "species", 1, species="Gadus morhua")
    pairs = {(pair.first, pair.second): pair for pair in agreements([out])}
    assert (pairs["review", "Grace"].species.count, pairs["review", "Grace"].species.same) == (1, 1)


def test_a_blind_reader_called_review_is_not_taken_for_the_review(out: Path):
    submit(ReviewQueue([open_report(out)], reviewer="Ada"), "accept", 1)
    blind = ReviewQueue([open_report(out, as_measured=True)], reviewer="review", blind=True)
    submit(blind, "reject", 1, reason="glove")
    decisions = {(pair.first, pair.second): pair.decisions for pair in agreements([out])}
    assert decisions["review", "review (blind)"].count == 1


def test_folders_that_come_twice_and_batches_without_results_are_refused(out: Path, tmp_path: Path):
    batch = tmp_path / "batch"
    batch.mkdir()
    (batch / VIDEOS).write_text(",".join(VIDEO_COLUMNS))
    for command in ("review", "agreement"):
        twice = invoke(command, {str(out): None, str(out / ".." / "out"): None})
        assert "expected each folder once" in twice.error
        assert "expected videos that are done" in invoke(command, {str(batch): None}).error


def test_equal_seeds_draw_equal_fish(out: Path):
    queue = ReviewQueue([open_report(out)] * 2, reviewer="Ada", sample=AuditSample(size=2, seed=3))
    text = queue.page("x")
    again = ReviewQueue([open_report(out)] * 2, reviewer="Bo", sample=AuditSample(size=2, seed=3))
    everything = {*(numbers := measured_numbers(queue.placed))}
    assert numbers == [1, 2, 1_000_000_001, 1_000_000_002]
    drawn = sampled(numbers, AuditSample(size=2, seed=3))
    assert len(drawn) == 2
    assert drawn < everything == sampled(numbers, AuditSample(size=99))
    for page in (text, again.page("x")):
        assert {number for number in everything if f'"id":{number},' in page} == drawn
    assert run_folders([out]) == [out]


def test_a_sample_is_the_same_in_whatever_order_the_folders_are_given(out: Path, tmp_path: Path):
    folders = [out, Path(shutil.copytree(out, tmp_path / "another"))]
    drawn: list[set[str]] = []
    for paths in (folders, folders[::-1]):
        reports = [open_report(path) for path in paths]
        sample = AuditSample(size=1, seed=3)
        queue = ReviewQueue(reports, reviewer="Ada", sample=sample)
        (number,) = sampled(measured_numbers(queue.placed), sample)
        drawn.append({f"{paths[number // 10**9]} {number % 10**9}"})
    assert drawn[0] == drawn[1]
    page = {str(folders[0]): None, str(folders[1]): None}
    refused = invoke("report", page)
    assert "--out: expected the page to write" in refused.error
    assert "4 fish" in invoke("report", page | {"--out": str(tmp_path / "both.html")}).out
