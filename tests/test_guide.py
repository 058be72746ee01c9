"""Commands, Python and settings of README and guide run as they stand, on the bundled scene.

Each page has a folder of its own, in which its blocks run in their order. The video is the first
seconds of the bundled scene.
"""

import re
import shlex
import shutil
from collections.abc import Callable
from glob import glob
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.core import TyperGroup
from typer.main import get_command

import stream_dmr as sd
from stream_dmr.cli.main import app
from stream_dmr.pipeline.config import load_config
from stream_dmr.simulation import simulate
from tests.support.board_views import LENS, BoardRenderer, BoardView, pose, varied_poses
from tests.support.command import invoke
from tests.support.nmea import straight_way
from tests.support.vulkan import DRIVERS
from tests.template.test_outline_template import write_views

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
NUM_FRAMES = 26
PROGRAM = ".venv/bin/stream-dmr "
# What a block of commands begins with; other indented blocks are settings, output and drawings.
PROGRAMS = (".venv/bin/", "git ", "journalctl ", "make ", "openssl ", "pip ", "sqlite3 ", "sudo ")

# Words of a command, and why no test runs it.
NOT_RUN = {
    "sudo ": "changes the machine: packages, users, services",
    "journalctl ": "a service of the machine",
    "git clone": "a network",
    "pip ": "a network; tests/test_packaging.py installs the wheel",
    "make ": "the environment of this test is made by it; make demo is tests/cli/test_demo.py",
    "sqlite3 ": "a program of Debian, not of this project",
    "rtsp://": "a camera; tests/sources/test_live.py has one",
    "http://": "a running box; tests/web/test_haul_button.py has one",
    "verify digest-": "a day of a box; tests/web/test_day_digest.py has some",
    "fleet boxes.txt": "running boxes, and no end; tests/web/test_fleet.py has some",
    "agreement ": "verdicts of two people; tests/web/test_agreement.py has them",
    "review ": "serves until it is stopped; tests/web/test_review.py",
    "import ": "tracks that were corrected in DIVE; tests/web/test_corrected_tracks.py has some",
    "view runs/demo": "a window",
    "view haul  ": "a window",
    "view haul --web": "serves until it is stopped",
    "view haul --source": "a window",
    "--lens camchain.yaml": "a calibration by Kalibr; tests/calibration/test_lens_file.py has one",
    "charuco:8x6": "another board under the same names; tests/calibration/test_charuco.py",
    "train ": "trains for most of an hour, or needs real pictures; tests/training/",
    "benchmarks.": "pictures and networks outside the repository",
}
SLOW = {  # pages whose blocks measure several videos
    *("README", "batch", "calibration", "measure", "replay", "report", "signatures", "templates"),
    *("trip", "two-cameras", "view"),
}
CODES = {"--ends 120,300,980,310": 1}  # `check` says by its exit code that a length is wrong


def commands_of(page: Path) -> list[str]:
    """The lines of commands of a page, continued lines and quotations joined."""
    found, lines = list[str](), iter(page.read_text().splitlines())
    for line in lines:
        if not re.match(r" {4,}", line) or not line.strip().startswith(PROGRAMS):
            continue
        command = line.strip()
        while command.endswith("\\") or command.count('"') % 2:
            command = command.removesuffix("\\").rstrip() + " " + next(lines).strip()
        found.append(command)
    return found


def python_of(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


def settings_of(page: Path) -> list[str]:
    """The blocks of a page that are tables of config.toml, without their indentation."""
    blocks = re.findall(r"(?:^ {4}.*\n)+", page.read_text(), re.MULTILINE)
    texts = [re.sub(r"^ {4}", "", block, flags=re.MULTILINE) for block in blocks]
    return [text for text in texts if re.match(r"\[\w+\]\n", text)]


def is_run(command: str) -> bool:
    return not any(words in command for words in NOT_RUN)


def video(path: Path, *, after: int = 0) -> None:
    """Frames of the bundled scene; the first ones show three fish."""
    shown = cv2.VideoCapture(str(sd.DEMO_SCENE / "video.mp4"))
    size = (int(shown.get(cv2.CAP_PROP_FRAME_WIDTH)), int(shown.get(cv2.CAP_PROP_FRAME_HEIGHT)))
    codec = cv2.VideoWriter_fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(path), codec, shown.get(cv2.CAP_PROP_FPS), size)
    for index in range(after + NUM_FRAMES):
        _, picture = shown.read()
        if index >= after:
            writer.write(picture)
    writer.release()


def other_run(folder: Path) -> None:
    """The results of the rest of the bundled scene."""
    film = folder.with_suffix(".mp4")
    video(film, after=NUM_FRAMES)
    sd.measure(film, calibration=sd.DEMO_SCENE / "calibration.yaml", out=folder)


def video_frame(path: Path, index: int) -> None:
    shown = cv2.VideoCapture(str(sd.DEMO_SCENE / "video.mp4"))
    for _ in range(index):
        _, picture = shown.read()
    cv2.imwrite(str(path), picture)


def pictures(folder: Path) -> None:
    """Two frames with fish."""
    folder.mkdir()
    for index in (12, 30):
        video_frame(folder / f"{index}.png", index)


def boards(folder: Path) -> None:
    folder.mkdir()
    renderer = BoardRenderer(LENS)
    for index, held in enumerate(varied_poses(6)):
        save(folder / f"{index}.jpg", renderer.render(held, BoardView(seed=index)))


def board(path: Path) -> None:
    """The board in the reference plane."""
    save(path, BoardRenderer(LENS).render(pose(tilt_deg=(10, -15, 5))))


def save(path: Path, picture: np.ndarray) -> None:
    """In the size of the video."""
    cv2.imwrite(str(path), cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC))


def season(path: Path) -> None:
    columns = "video,calibration,boxes,masks,vessel,trip,haul\n"
    path.write_text(f"{columns}haul.mp4,calibration.yaml,,,Anna,7,1\n")


def two_cameras(folder: Path) -> None:
    """Videos and calibrations of the left and the right camera."""
    scene = folder / "scene"
    simulate(scene, num_fish=2, num_frames=24, preset="clean", seed=21, second_deg=35.0)
    for place, side in ((scene, "left"), (scene / "second", "right")):
        shutil.copy(place / "video.mp4", folder / f"{side}.mp4")
        shutil.copy(place / "calibration.yaml", folder / f"{side}.yaml")


# What pages take for given, by the names that it gives to it.
MAKERS: dict[str, Callable[[Path], object]] = {
    "board": boards,
    "photos": boards,
    "plane.jpg": board,
    "check.png": board,
    "picture.jpg": lambda path: video_frame(path, 12),
    "pictures": pictures,
    "calibration.yaml": lambda path: shutil.copy(sd.DEMO_SCENE / "calibration.yaml", path),
    "new.yaml": lambda path: shutil.copy(sd.DEMO_SCENE / "calibration.yaml", path),
    "haul.mp4": video,
    "clip.mp4": video,
    "haul-3.mp4": video,
    "haul-2": other_run,
    "left.mp4": lambda path: two_cameras(path.parent),
    "season.csv": season,
    "longline.onnx": lambda path: shutil.copy(ROOT / "stream_dmr/networks/weights/fish.onnx", path),
    "track.nmea": lambda path: path.write_text(straight_way(30)),
    "side.png": lambda path: write_views(path.parent, "cod"),
}
# A name that ends with / is a folder of results, a TOML file has the settings of its page.
GIVEN: dict[str, list[str]] = {
    "README": ["haul.mp4", "board", "plane.jpg"],
    "batch": ["haul.mp4", "calibration.yaml", "season.csv", "config.toml"],
    "calibration": ["photos", "plane.jpg", "check.png", "picture.jpg", "pictures"],
    "fate": ["other-zones.toml", "haul/"],
    "files": ["haul/"],
    "install": ["runs/demo/"],
    "measure": ["haul.mp4", "calibration.yaml", "pictures"],
    "python": ["haul/"],
    "replay": ["haul/", "new.yaml", "mine.toml"],
    "report": ["haul/", "haul.mp4"],
    "signatures": ["haul.mp4"],
    "species": ["longline.onnx"],
    "templates": ["runs/vessel/", "haul-1/", "haul-2", "haul-3.mp4", "side.png"],
    "trip": ["clip.mp4", "track.nmea", "config.toml"],
    "two-cameras": ["left.mp4"],
    "view": ["haul/", "haul.mp4"],
}


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the Python of the README has run: haul.mp4, its calibration, haul/."""
    folder = tmp_path_factory.mktemp("guide")
    for name in ("haul.mp4", "calibration.yaml"):
        MAKERS[name](folder / name)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        (measure,) = python_of(ROOT / "README.md")
        exec(measure, {})
    return folder


def give(page: Path, folder: Path, measured: Path) -> None:
    """Put into a folder what a page takes for given."""
    (folder / "recordings").symlink_to(ROOT / "recordings")
    for name in GIVEN.get(page.stem, []):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        if name.endswith("/"):
            shutil.copytree(measured / "haul", folder / name)
        elif name.endswith(".toml"):
            (folder / name).write_text("".join(settings_of(page)))
        else:
            MAKERS[name](folder / name)


def run_command(command: str) -> None:
    """Run a line of `stream-dmr` or of Python as a shell does, in this process."""
    program, *words = shlex.split(command, comments=True)
    arguments = [part for word in words for part in (sorted(glob(word)) or [word])]
    if program.endswith("python"):
        assert arguments[0] == "-c", command
        exec(arguments[1], {})
        return
    outcome = invoke(" ".join(arguments))
    expected = next((code for words, code in CODES.items() if words in command), 0)
    assert outcome.code == expected, f"{command}\n{outcome.out}\n{outcome.err}"


def runnable(page: Path) -> list[str]:
    return [command for command in commands_of(page) if is_run(command)]


def pages_with(blocks: Callable[[Path], list[str]]) -> list[Any]:
    """The pages that have such blocks, as parameters of a test."""
    slow = SLOW if blocks is runnable else ()
    return [
        pytest.param(page, id=page.stem, marks=[pytest.mark.slow] if page.stem in slow else [])
        for page in PAGES
        if blocks(page)
    ]


@pytest.mark.parametrize("page", pages_with(runnable))
def test_commands_of_a_page_run_as_they_stand(
    page: Path, tmp_path: Path, measured: Path, monkeypatch: pytest.MonkeyPatch
):
    give(page, tmp_path, measured)
    monkeypatch.chdir(tmp_path)
    for command in runnable(page):
        if "--screenshot" not in command or DRIVERS:
            run_command(command)


@pytest.mark.parametrize("page", pages_with(commands_of))
def test_commands_of_a_page_are_those_of_the_program(page: Path):
    """Also those that are not run."""
    program = get_command(app)
    assert isinstance(program, TyperGroup)
    for command in commands_of(page):
        if command.startswith(PROGRAM):
            name, *arguments = shlex.split(command.removeprefix(PROGRAM), comments=True)
            program.commands[name].make_context(name, arguments)  # raises for an unknown option


@pytest.mark.parametrize("page", pages_with(python_of))
def test_python_of_a_page_runs_as_it_stands(
    page: Path,
    tmp_path: Path,
    measured: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    blocks = python_of(page)
    (measure,) = python_of(ROOT / "README.md")
    known: dict[str, object] = {}
    if measure.splitlines()[:4] == blocks[0].splitlines()[:4]:  # which `measured` has run
        known, blocks = {"sd": sd, "run": sd.Run(measured / "haul")}, blocks[1:]
    if blocks:
        give(page, tmp_path, measured)
    monkeypatch.chdir(tmp_path)
    for block in blocks:
        exec(block, known)
        assert bool(capsys.readouterr().out.strip()) == ("print(" in block)


@pytest.mark.parametrize("page", pages_with(settings_of))
def test_settings_of_a_page_are_those_of_the_program(page: Path, tmp_path: Path):
    for number, text in enumerate(settings_of(page)):
        path = tmp_path / f"{number}.toml"
        path.write_text(text)
        load_config(path)


def test_what_is_not_run_is_on_a_page():
    commands = [command for page in PAGES for command in commands_of(page)]
    assert len(commands) > 80
    assert [words for words in NOT_RUN if not any(words in one for one in commands)] == []
