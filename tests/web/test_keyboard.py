"""A review by the keyboard and the mouse in a real browser."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from stream_dmr.evidence.verify_folder import verify
from stream_dmr.store.fish import read_stored_fish
from stream_dmr.store.verdicts import read_verdicts
from stream_dmr.web.open_reports import open_folders
from stream_dmr.web.review_queue import ReviewQueue, ReviewServer, species_choices
from tests.support.browser import Tab

WAIT = """
const until = async (what) => {
  for (let k = 0; k < 600 && !what(); k += 1) await new Promise((done) => setTimeout(done, 20));
  if (!what()) throw new Error(`waited in vain for ${what}: ${message().textContent}`);
};
const key = (name) => document.activeElement.dispatchEvent(
  new KeyboardEvent("keydown", { key: name, bubbles: true, cancelable: true }));
const message = () => document.getElementById("message") ?? { textContent: "" };
"""
FIRST_OPEN = WAIT + "choose(1); await until(() => player.clip?.isDone && player.fish.id === 1);\n"


@pytest.fixture
def server(out: Path, tmp_path: Path) -> Iterator[ReviewServer]:
    other = Path(shutil.copytree(out, tmp_path / "other"))  # several folders are one review
    reports, _ = open_folders([out, other], max_drawn=0)
    served = ReviewServer(ReviewQueue(reports, reviewer="Ada"), title="two")
    yield served
    served.close()


@pytest.fixture(params=[pytest.param(1400, marks=pytest.mark.slow), 390])
def tab(server: ReviewServer, request: pytest.FixtureRequest) -> Iterator[Tab]:
    opened = Tab(server.address, width=request.param, height=900)
    yield opened
    opened.close()


def kinds(out: Path) -> list[tuple[int, str]]:
    return [(one.track_id, one.kind) for one in read_verdicts(out / "lengths.db")]


def test_four_fish_of_two_runs_by_the_keyboard(tab: Tab, out: Path):
    state = tab.run(
        FIRST_OPEN
        + """
        const frames = player.clip.frames.map((one) => [one.frame, one.image !== null]);
        key("a");
        await until(() => state.chosen === 2 && document.getElementById("species-name"));
        const said = [message().textContent];
        key("s");
        document.activeElement.value = "cod";
        key("Enter");
        await until(() => chosenFish().species !== DATA.template && chosenFish().reviewer);
        said.push(message().textContent, document.getElementById("do-undo").textContent);
        send({ kind: "split", frame_index: 99 });
        await until(() => message().className === "bad");
        key("u");
        said.push(message().textContent);
        key("r");
        document.activeElement.value = "not a fish";
        key("Enter");
        await until(() => state.chosen === 1000000001 && document.getElementById("do-accept"));
        key("a");
        await until(() => state.chosen === 1000000002);
        choose(1);
        key("u");
        await until(() => state.chosen === 1000000001 && chosenFish().verdict === null);
        said.push(message().textContent);
        const row = document.querySelector('[data-id="1"]').textContent;
        return { said, row, frames, left: document.getElementById("progress").textContent };
        """
    )
    assert state["frames"] == [[number, True] for number in range(1, 7)]
    assert "2 of 4 without a decision" in state["left"]
    species = "Fish 2 of out: species Gadus morhua"
    assert state["said"] == [
        "Fish 1 of out: accepted. ",
        f"{species}.",
        f"Undo {species} u",
        f"Nothing was saved, so nothing is taken back. Once more takes back: {species}.",
        "Fish 1 of other: accepted, taken back.",
    ]
    assert "accepted" in state["row"]
    assert kinds(out) == [(1, "accept"), (2, "species"), (2, "reject")]
    assert read_verdicts(out / "lengths.db")[1].species == "Gadus morhua"
    assert kinds(out.parent / "other") == [(1, "accept"), (1, "undo")]


def test_a_missed_fish_is_drawn_measured_and_split(tab: Tab, out: Path):
    tab.run(
        FIRST_OPEN
        + """
        key("b");
        showFrame(0);
        CLIP_CANVAS.scrollIntoView({ block: "center" });
        """
    )
    for at in (0, 4):
        left, top, width, height = tab.run(
            f"showFrame({at}); const b = CLIP_CANVAS.getBoundingClientRect();"
            "return [b.left, b.top, b.width, b.height]"
        )
        places = [
            (left + x / 160 * width, top + y / 120 * height)
            for x, y in ((8, 18), (30, 60), (52, 104))
        ]
        tab.mouse("mousePressed", *places[0])
        for place in places[1:]:
            tab.mouse("mouseMoved", *place)
        tab.mouse("mouseReleased", *places[-1])
    made = tab.run(
        WAIT
        + """
        const asked = [];
        window.confirm = (text) => asked.push(text);
        key("Enter");
        await until(() => chosenFish().track_id === 3);
        await until(() => player.clip?.isDone && player.fish.track_id === 3);
        const seen = [chosenFish().frames_seen, document.querySelectorAll(".views svg").length];
        showFrame(3);
        key("x");
        await until(() => DATA.fish.some((one) => one.track_id === 4 && one.run === 0));
        return [asked.length, ...seen];
        """
    )
    assert made == [1, 5, 3]
    fish = {one.estimate.track_id: one for one in read_stored_fish(out / "lengths.db")}
    assert [fish[track_id].origin for track_id in (1, 2, 3, 4)] == ["run", "run", "split", "split"]
    assert [fish[track_id].estimate.frames_seen for track_id in (3, 4)] == [3, 2]
    assert verify(out)[0] == []


def press(tab: Tab, key: str, text: str) -> None:
    codes = {"key": key, "windowsVirtualKeyCode": ord(text)}
    tab.send("Input.dispatchKeyEvent", type="keyDown", text=text, **codes)
    tab.send("Input.dispatchKeyEvent", type="keyUp", **codes)


def test_space_and_enter_do_what_the_part_in_focus_is_for(tab: Tab):
    tab.run(FIRST_OPEN)
    tab.run("document.getElementById('goes-on').focus()")
    press(tab, " ", " ")
    assert tab.run("return document.getElementById('goes-on').checked") is False
    tab.run("document.querySelector('#head button:nth-child(3)').focus()")
    press(tab, "Enter", "\r")
    assert tab.run("return document.activeElement.textContent") == "Length \u2191"
    tab.run("click('do-add')(); document.getElementById('do-cancel').focus()")
    press(tab, "Enter", "\r")
    assert tab.run("return [isDrawing(), document.getElementById('message').textContent]") == [
        False,
        "",
    ]


def test_a_key_pressed_twice_while_a_verdict_is_saved_decides_once(tab: Tab, out: Path):
    left = tab.run(
        FIRST_OPEN
        + """
        const answer = window.fetch;
        window.fetch = async (...asked) => {
          await new Promise((done) => setTimeout(done, asked[0] === "verdict" ? 300 : 0));
          return answer(...asked);
        };
        key("a");
        key("a");
        const said = message().textContent;
        await until(() => state.chosen !== 1);
        await new Promise((done) => setTimeout(done, 900));
        return [said, state.chosen];
        """
    )
    assert left == ["Saving ...", 2]
    assert kinds(out) == [(1, "accept")]


def test_every_field_has_a_name(tab: Tab):
    assert (
        tab.run(
            WAIT
            + """
        choose(1);
        await until(() => document.getElementById("do-accept"));
        const unnamed = (one) => one.labels.length === 0 && !one.getAttribute("aria-label");
        return [...document.querySelectorAll("input, select")].filter(unnamed).map((one) => one.id);
        """
        )
        == []
    )


def test_nothing_is_cut_and_clip_and_verdicts_are_in_sight_together(tab: Tab):
    assert tab.run(
        WAIT
        + """
        document.querySelector(".row").click();
        await until(() => player.clip?.isDone);
        await new Promise((done) => setTimeout(done, 300));
        click("do-add")();
        click("do-measure")();
        const said = document.getElementById("message");
        const tools = document.getElementById("verdicts").getBoundingClientRect();
        return said.textContent.startsWith("Draw a box")
          && CLIP_CANVAS.getBoundingClientRect().top >= 0 && tools.bottom <= innerHeight
          && said.getBoundingClientRect().bottom <= innerHeight;
        """
    )
    assert tab.cut() == []


def test_species_of_an_own_list_stand_by_their_code(tmp_path: Path):
    own = tmp_path / "own.csv"
    own.write_text("code,scientific_name,english_name\nQQQ,Piscis novus,New fish\n")
    choices = {one["code"]: one["value"] for one in species_choices(str(own))}
    assert (choices["QQQ"], choices["COD"]) == ("QQQ", "Gadus morhua")
    assert "QQQ" not in {one["code"] for one in species_choices(str(tmp_path / "gone.csv"))}
