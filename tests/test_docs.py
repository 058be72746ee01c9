"""The generated parts of the guide are up to date, and its links lead somewhere."""

import re
import subprocess
from contextlib import closing
from dataclasses import fields
from pathlib import Path

import pytest

from stream_dmr.export.fish_table import FISH_TABLE
from stream_dmr.store.run_tables import FRAMES_COLUMNS, LENGTHS_COLUMNS
from stream_dmr.store.schema import open_for_writing
from stream_dmr.store.verdicts import Verdict
from tests.support.pages import pages
from tests.support.plan import Plan, direct

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
PAGES += sorted((ROOT / "docs").rglob("*.md"))
LINK = re.compile(r"\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ +(.*)$", re.MULTILINE)


@pytest.mark.parametrize(
    ("path", "text"), [pytest.param(*page, id=page[0].name) for page in pages()]
)
def test_generated_part_of_a_page_is_up_to_date(path, text):
    assert path.exists(), f"{path} is missing: run `make docs`"
    assert path.read_text(encoding="utf-8") == text, f"{path.name} is out of date: run `make docs`"


def test_page_of_the_files_names_every_table_and_column(tmp_path):
    with closing(open_for_writing(tmp_path / "lengths.db")) as database:
        in_database = database.execute(
            "SELECT name FROM sqlite_master WHERE type = 'table' UNION "
            "SELECT c.name FROM sqlite_master AS t JOIN pragma_table_info(t.name) AS c"
        ).fetchall()
    columns = {*LENGTHS_COLUMNS, *FRAMES_COLUMNS, *FISH_TABLE, *(name for (name,) in in_database)}
    columns |= {field.name for field in fields(Verdict)}
    page = (ROOT / "docs" / "files.md").read_text(encoding="utf-8")
    assert not columns - set(re.findall(r"`(\w+)`", page))


def test_plan_leaves_out_what_a_chain_implies():
    plan = Plan(packages=dict.fromkeys("abc", ""), imports={("a", "b"), ("b", "c"), ("a", "c")})
    assert direct(plan) == {("a", "b"), ("b", "c")}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_of_a_page_lead_to_files_and_headings(page):
    broken = [
        link
        for link in LINK.findall(without_code(page.read_text(encoding="utf-8")))
        if not link.startswith(("http://", "https://")) and not leads_somewhere(page, link)
    ]
    assert not broken


def leads_somewhere(page: Path, link: str) -> bool:
    name, _, anchor = link.partition("#")
    target = (page.parent / name).resolve() if name else page
    if not target.exists() or not target.is_relative_to(ROOT):
        return False
    return not anchor or anchor in anchors(target)


def anchors(page: Path) -> set[str]:
    """GitHub's anchors of a page's headings."""
    headings = HEADING.findall(without_code(page.read_text(encoding="utf-8")))
    kept = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {heading.strip().replace(" ", "-") for heading in kept}


def without_code(text: str) -> str:
    return re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)


def test_every_page_of_the_guide_is_linked_from_its_index():
    for index in (ROOT / "docs" / "README.md", ROOT / "docs" / "research" / "README.md"):
        linked = {(index.parent / link).resolve() for link in LINK.findall(index.read_text())}
        assert set(index.parent.glob("*.md")) - {index} <= linked


def test_every_picture_of_the_guide_is_shown():
    shown = {
        (page.parent / link).resolve() for page in PAGES for link in LINK.findall(page.read_text())
    }
    pictures = subprocess.run(
        ["git", "ls-files", "docs/images"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert {ROOT / name for name in pictures.stdout.split()} <= shown


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if page.parent.name == "research" and page.name != "README.md"],
    ids=lambda page: page.stem,
)
def test_a_page_of_research_says_when_how_and_what_was_decided(page):
    text = page.read_text(encoding="utf-8")
    assert text.startswith("# ")
    assert text.splitlines()[0].endswith("?"), "one question a page"
    assert re.search(r"20\d\d-\d\d-\d\d", text), "when?"
    assert re.search(r"python -m|make \w|stream-dmr |scripts?\b|[Ll]ooked up|Command then", text), (
        "how?"
    )
    assert "ecided" in text, "and then?"
