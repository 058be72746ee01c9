"""`import --viame`: what was corrected in DIVE is what `review` would have made of it."""

import json
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from stream_dmr.errors import UserError
from stream_dmr.evidence.verify_folder import verify
from stream_dmr.store.fish import Fish, read_stored_fish
from stream_dmr.store.verdicts import next_track_id, read_verdicts
from stream_dmr.web.corrected_tracks import import_tracks
from stream_dmr.web.open_reports import open_report
from stream_dmr.web.review_queue import ReviewQueue
from tests.support.command import Outcome, invoke
from tests.web.test_edits import submit

Rows = list[list[str]]  # cells: track, time, frame from 0, box, ...
Facts = dict[int, tuple[object, ...]]  # by fish


def exported(out: Path) -> Path:
    folder = out.parent / "exported"
    done = invoke(f"export {out} --viame --overwrite", {"--out": str(folder)})
    assert done.code == 0, done.err
    return folder / "tracks.viame.csv"


def take(out: Path, path: Path) -> Outcome:
    return invoke(f"import {out}", {"--viame": str(path), "--reviewer": "Ada"})


def corrected(out: Path, change: Callable[[Rows], Iterable[list[str]]]) -> Path:
    """The export with other rows, its boxes in whole pixels as DIVE writes them."""
    lines = exported(out).read_text().splitlines()
    rows = [line.split(",") for line in lines[2:]]
    for row in rows:
        row[3:7] = [str(round(float(cell))) for cell in row[3:7]]
    path = out.parent / "corrected.viame.csv"
    path.write_text("\n".join([*lines[:2], *(",".join(row) for row in change(rows))]) + "\n")
    return path


def numbered(rows: Rows, number: Callable[[int, int], int]) -> Rows:
    """With other track numbers, by track and frame from 1."""
    return [[str(number(int(row[0]), int(row[2]) + 1)), *row[1:]] for row in rows]


def facts(fish: Iterable[Fish]) -> Facts:
    return {
        one.estimate.track_id: (
            *(one.length_mm, one.estimate.frames_seen, one.estimate.status, one.origin),
            *(one.counts, one.species_code, one.review.species),
        )
        for one in fish
    }


def fish_of(out: Path) -> Facts:
    return facts(read_stored_fish(out / "lengths.db"))


def reviewed(measured: Path, folder: Path, *said: dict[str, object]) -> Facts:
    """What `review` makes of it."""
    out = Path(shutil.copytree(measured, folder / "reviewed"))
    queue = ReviewQueue([open_report(out)], reviewer="Ada")
    for one in said:
        queue.record(json.dumps({**one, "sure": True}).encode())
    queue.close()
    return fish_of(out)


def drawn(rows: Rows) -> list[dict[str, object]]:
    names = ("x0", "y0", "x1", "y1")
    return [
        {"frame_index": int(row[2]) + 1, "timestamp_ns": str(int(row[2]) * 10**8)}
        | dict(zip(names, map(float, row[3:7]), strict=True))
        for row in rows
    ]


def test_a_round_trip_writes_nothing(out: Path):
    before = {path: path.read_bytes() for path in out.iterdir()}
    for path in (exported(out), corrected(out, lambda rows: rows)):
        done = take(out, path)
        assert (done.code, done.err) == (0, "")
        assert "nothing differs" in done.out
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def test_a_round_trip_after_a_review_writes_nothing(out: Path):
    queue = ReviewQueue([open_report(out)], reviewer="Ada")
    submit(queue, "split", 2, frame_index=5)
    submit(queue, "species", 1, species="cod")
    submit(queue, "reject", 3, reason="a glove")
    frame = queue.detail(0, 1)["views"][0]
    head, _, tail = frame["keypoints"]
    moved = [head[0] + 3, head[1]]
    submit(queue, "correct", 1, frame_index=frame["frame"], head=moved, tail=tail)
    queue.close()
    known = read_verdicts(out / "lengths.db")
    assert "nothing differs" in take(out, corrected(out, lambda rows: rows)).out
    assert read_verdicts(out / "lengths.db") == known


def halves(track: int, frame: int) -> int:
    return 9 if track == 2 and frame > 4 else track


def halves_of_both(rows: Rows) -> Rows:
    """The beginning of fish 1 and the end of fish 2 are one fish; the rest is gone."""
    begins = [row for row in rows if row[0] == "1" and row[2] < "2"]
    ends = [row for row in rows if row[0] == "2" and row[2] > "2"]
    return numbered(begins + ends, lambda *_: 8)


NAMES = {"1": ["Gadus morhua"], "2": ["fish"]}
SPLIT = {"kind": "split", "track_id": 2, "frame_index": 5}


def glove(rows: Rows) -> Rows:
    """Fish 2 ends after frame 4, without its frame 3; fish 1 is gone."""
    return [row for row in rows if row[0] == "2" and row[2] in "13"]


def cod(rows: Rows) -> Rows:
    return [[*row[:9], "Gadus morhua" if row[0] == "1" else "fish", *row[10:]] for row in rows]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda rows: numbered(rows, lambda track, _: track + 70), []),
        pytest.param(
            lambda rows: numbered(rows, lambda t, frame: 9 if (t, frame > 4) == (2, True) else t),
            [SPLIT],
            marks=pytest.mark.slow,
        ),
        (
            lambda rows: numbered(
                [
                    row
                    for row in rows
                    if (row[0] == "1" and row[2] in "01") or (row[0] == "2" and row[2] > "2")
                ],
                lambda *_: 8,
            ),
            [
                {"kind": "split", "track_id": 1, "frame_index": 3},
                {"kind": "reject", "track_id": 3, "reason": "not in corrected.viame.csv"},
                {"kind": "split", "track_id": 2, "frame_index": 4},
                {"kind": "reject", "track_id": 2, "reason": "not in corrected.viame.csv"},
                {"kind": "merge", "track_id": 4, "other_fish": 1},
            ],
        ),
        pytest.param(
            glove,
            [
                {"kind": "reject", "track_id": 1, "reason": "not in corrected.viame.csv"},
                {"kind": "split", "track_id": 2, "frame_index": 3},
                {"kind": "split", "track_id": 3, "frame_index": 4},
                {"kind": "reject", "track_id": 3, "reason": "not in corrected.viame.csv"},
                {"kind": "split", "track_id": 4, "frame_index": 5},
                {"kind": "reject", "track_id": 5, "reason": "not in corrected.viame.csv"},
                {"kind": "merge", "track_id": 4, "other_fish": 2},
            ],
            marks=pytest.mark.slow,
        ),
        (
            cod,
            [{"kind": "species", "track_id": 1, "species": "Gadus morhua"}],
        ),
    ],
    ids=["other numbers", "split", "split and merged", "deleted", "species"],
)
def test_tracks_become_what_a_review_would_have_made(
    measured: Path,
    out: Path,
    change: Callable[[Rows], Rows],
    said: list[dict[str, object]],
):
    path = corrected(out, change)
    done = take(out, path)
    assert done.code == 0, done.err
    assert fish_of(out) == reviewed(measured, out.parent, *said)
    assert len(read_verdicts(out / "lengths.db")) == len(done.out.splitlines()) - 1 == len(said)
    assert verify(out)[0] == []
    assert "nothing differs" in take(out, path).out


def test_drawn_and_moved_boxes_are_measured_as_a_review_does(measured: Path, out: Path):
    """A third fish is drawn in two frames, the box of fish 1 moved in its third one."""
    made = [
        ["9", "", str(frame), "8", "18", "52", "104", "1", "-1", "cod", "1"] for frame in (1, 2)
    ]

    def change(rows: Rows) -> Rows:
        for row in rows:
            if row[0] == "1" and row[2] == "2":
                row[3:7] = ["6", *row[4:6], "110"]
        return [*rows, *made]

    path = corrected(out, change)
    moved = [line.split(",") for line in path.read_text().splitlines()[2:]]
    moved = [row for row in moved if row[0] == "1" and row[2] == "2"]
    done = take(out, path)
    assert done.code == 0, done.err
    said = [
        {"kind": "split", "track_id": 1, "frame_index": 3},
        {"kind": "split", "track_id": 3, "frame_index": 4},
        {"kind": "reject", "track_id": 3, "reason": "not in corrected.viame.csv"},
        {"kind": "add", "boxes": drawn(made)},
        {"kind": "add", "boxes": drawn(moved)},
        {"kind": "merge", "track_id": 4, "other_fish": 1},
        {"kind": "merge", "track_id": 6, "other_fish": 1},
        {"kind": "species", "track_id": 5, "species": "cod"},
    ]
    expected = reviewed(measured, out.parent, *said)
    assert fish_of(out) == expected
    assert expected[1][1] == 5
    assert verify(out)[0] == []
    assert "nothing differs" in take(out, path).out


def test_a_fish_drawn_over_another_is_taken_and_said(out: Path):
    box = ["9", "", "2", "8", "18", "52", "104", "1", "-1"]
    done = take(out, corrected(out, lambda rows: [*rows, box]))
    assert done.code == 0
    assert "of their area. Is it another fish?" in done.err
    assert fish_of(out)[3][:2] == (None, 1)
    queue = ReviewQueue([open_report(out)], reviewer="Ada")
    submit(queue, "split", 1, frame_index=3)  # as fish 4
    queue.close()
    assert take(out, corrected(out, cod)).code == 0
    assert next_track_id(out / "lengths.db") == 5


def test_moved_ends_are_a_correction(out: Path):
    def change(rows: Rows) -> Rows:
        for row in rows:
            if row[:1] == ["1"] and row[2] == "2":
                (k,) = (k for k, cell in enumerate(row) if cell.startswith("(kp) head"))
                x, y = map(float, row[k].split()[2:])
                row[k] = f"(kp) head {x:.0f} {y - 4:.0f}"
        return rows

    path = corrected(out, change)
    before = fish_of(out)[1][0]
    done = take(out, path)
    assert done.code == 0, done.err
    (verdict,) = read_verdicts(out / "lengths.db")
    assert (verdict.kind, verdict.track_id, verdict.frame_index) == ("correct", 1, 3)
    assert fish_of(out)[1][0] == verdict.length_mm != before
    assert verify(out)[0] == []
    assert "nothing differs" in take(out, path).out


def outline(rows: Rows) -> Rows:
    rows[0] = [cell if not cell.startswith("(poly)") else "(poly) 1 1 9 1 9 9" for cell in rows[0]]
    return rows


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda rows: [], "none of its boxes"),
        (lambda rows: numbered(rows, lambda track, _: 7), "one box per fish and frame"),
        (lambda rows: [*rows, ["9", "", "77", *rows[0][3:]]], "got frame 77"),
        (
            lambda rows: [*rows, ["9", "", "0", "500", "5", "600", "50", "1", "-1"]],
            "inside the picture",
        ),
        (
            lambda rows: [[*rows[0][:9], "cod", "1"], [*rows[1][:9], "ling", "1"], *rows[2:]],
            "cod and ling",
        ),
        (lambda rows: [[*row[:9], "x" * 201, "1"] for row in rows], "200 characters"),
        (outline, "which is no verdict"),
        (lambda rows: [["a"]], "expected VIAME's track"),
    ],
)
def test_what_is_no_verdict_is_refused_and_nothing_is_written(
    out: Path, change: Callable[[Rows], Rows], why: str
):
    """Although fish 2 is split as well."""
    before = {path: path.read_bytes() for path in out.iterdir()}
    done = take(
        out,
        corrected(
            out, lambda rows: change(numbered(rows, lambda t, f: t if f < 5 or t == 1 else 8))
        ),
    )
    assert done.code == 2
    assert why in done.error
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def test_fish_that_were_rejected_or_named_since_are_refused(out: Path):
    path = exported(out)
    queue = ReviewQueue([open_report(out)], reviewer="Bo")
    submit(queue, "species", 2, species="cod")
    assert "in the place of cod, got none" in take(out, path).error
    submit(queue, "reject", 2, reason="a glove")
    assert "got the box of fish 2, which a reviewer rejected" in take(out, path).error
    queue.close()
    assert len(read_verdicts(out / "lengths.db")) == 2


@pytest.mark.parametrize("part", ["--track 2", "--time 0:0.35"])
def test_an_export_of_a_part_is_refused_also_after_dive(out: Path, part: str):
    """DIVE writes a metadata line of its own, and keeps the attributes of tracks."""
    done = invoke(f"export {out} --viame {part}", {"--out": str(out.parent / "part")})
    assert done.code == 0, done.err
    path = out.parent / "part" / "tracks.viame.csv"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for line in lines if not line.startswith("# metadata")))
    done = take(out, path)
    assert done.code == 2
    assert "expected tracks of the whole run" in done.error
    assert read_verdicts(out / "lengths.db") == []


def test_a_recording_alone_takes_no_corrections(out: Path):
    path = exported(out)
    report = open_report(out / "recording.mcap")
    with pytest.raises(UserError, match="a recording alone"):
        import_tracks(report, path, reviewer="Ada")
