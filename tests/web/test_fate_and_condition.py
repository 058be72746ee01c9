"""Fate, condition and species by a reviewer: from the keyboard to the exported table."""

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from stream_dmr.errors import UserError
from stream_dmr.evidence.verify_folder import verify
from stream_dmr.lengths.fate import CONDITIONS, FATES
from stream_dmr.store.verdicts import (
    NOT_REVIEWED,
    Verdict,
    check_verdict,
    read_verdicts,
    reviews_of,
    verdict_line,
)
from stream_dmr.web.open_reports import open_report
from stream_dmr.web.review_queue import ReviewQueue, ReviewServer
from tests.support.browser import Tab
from tests.support.command import invoke, rows


@pytest.fixture
def server(out: Path) -> Iterator[ReviewServer]:
    with closing(
        ReviewServer(ReviewQueue([open_report(out)], reviewer="Ada"), title="out", port=0)
    ) as server:
        yield server


def type_after(tab: Tab, key: str, text: str) -> None:
    """Press a key, type into the field that it leads to, and Enter."""
    tab.send("Input.dispatchKeyEvent", type="keyDown", key=key, text=key)
    tab.send("Input.insertText", text=text)
    enter = {"key": "Enter", "code": "Enter", "windowsVirtualKeyCode": 13, "text": "\r"}
    tab.send("Input.dispatchKeyEvent", type="keyDown", **enter)
    tab.run(
        "const said = document.getElementById('message');"
        "for (let i = 0; i < 200 && said.textContent === ''; i++)"
        " await new Promise((done) => setTimeout(done, 20)); said.textContent = ''"
    )


def test_a_reviewer_types_fate_condition_and_species(
    server: ReviewServer, out: Path, tmp_path: Path
):
    tab = Tab(server.address)
    try:
        tab.run(
            "choose(1);"
            "while (!(chosenFish()?.detail && document.getElementById('fate-name')))"
            " await new Promise((done) => setTimeout(done, 20))"
        )
        type_after(tab, "f", "dropped")
        type_after(tab, "c", "a2")
        type_after(tab, "s", "swordfish")
        shown = tab.run("return document.getElementById('detail').innerText")
    finally:
        tab.close()
    assert "alive, injured or distressed" in shown
    assert [
        (v.kind, v.fate, v.condition, v.species) for v in read_verdicts(out / "lengths.db")
    ] == [
        ("fate", "dropped", None, ""),
        ("condition", None, "A2", ""),
        ("species", None, None, "Xiphias gladius"),
    ]
    assert invoke("export", {str(out): None, "--fish": "csv", "--out": str(tmp_path)}).code == 0
    first, second = rows(tmp_path / "fish.csv")
    assert (first["fate"], first["condition"]) == ("dropped", "A2")
    assert "fate_share" not in first  # nobody but the reviewer said it
    assert (first["species"], first["species_code"]) == ("Xiphias gladius", "SWO")
    assert (second["fate"], second["condition"], second["species_code"]) == ("", "", "")
    assert verify(out)[0] == []
    with closing(sqlite3.connect(out / "lengths.db")) as database, database:
        database.execute("UPDATE verdicts SET condition = 'D' WHERE kind = 'condition'")
    assert verify(out)[0] != []


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ({"kind": "fate", "fate": "eaten"}, "a fate of landed, dropped, cut off, unknown"),
        ({"kind": "fate"}, "a fate of"),
        ({"kind": "condition", "condition": "A9"}, "a condition of A0, A1"),
    ],
)
def test_other_words_are_refused(said: dict[str, Any], expected: str):
    with pytest.raises(UserError, match=expected):
        check_verdict(Verdict(track_id=1, reviewer="Ada", **said), {1}, {})


def test_the_last_verdict_holds_until_it_is_withdrawn():
    ada = {"track_id": 1, "reviewer": "Ada"}
    said = [Verdict(kind="fate", fate=fate, **ada) for fate in FATES]  # type: ignore[arg-type]
    said += [Verdict(kind="condition", condition=one, **ada) for one in CONDITIONS]  # type: ignore[arg-type]
    review = reviews_of(said)[1]
    assert (review.fate, review.condition) == ("unknown", "U")
    gone = reviews_of([*said, Verdict(kind="withdraw", **ada)])[1]  # type: ignore[arg-type]
    assert (gone.fate, gone.condition) == (NOT_REVIEWED.fate, None)


def test_older_verdicts_keep_their_checksums():
    line = json.loads(verdict_line(Verdict(track_id=1, kind="accept", reviewer="Ada")))
    assert not {"fate", "condition"} & line.keys()
