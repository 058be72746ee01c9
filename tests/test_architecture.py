"""What DESIGN promises of the structure: who may import whom, and that the stages fit together."""

import ast
import inspect
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from nodes.crop_fish import CropFish
from nodes.fit_mesh import FitMesh
from nodes.localize import Localize
from nodes.read_frames import ReadFrames
from nodes.smooth_length import SmoothLength
from stream_dmr.pipeline import Node

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted([*(ROOT / "stream_dmr").rglob("*.py"), *(ROOT / "nodes").rglob("*.py")])
NODES = [CropFish, FitMesh, Localize, SmoothLength]
# Who assembles and shows a run; everything else is the library, and knows no nodes.
ASSEMBLY = [
    "stream_dmr.run",
    "stream_dmr.run_inputs",
    "stream_dmr.scout",
    "stream_dmr.display",
    "stream_dmr.cli",
    "stream_dmr.demo",
    "stream_dmr.replay.replay",
]
# From the ground floor up; a module imports from its own floor and those below.
FLOORS = [
    ["stream_dmr", "stream_dmr.errors", "stream_dmr.settings", "stream_dmr.geometry"],
    ["stream_dmr.camera"],
    ["stream_dmr.messages"],
    ["*"],  # the rooms of the library
    ["stream_dmr.config", "stream_dmr.pipeline"],
    ["nodes"],
    [f"stream_dmr.watch.{name}" for name in ("state", "metrics", "picture", "server", "watch")],
    ["stream_dmr.run_inputs"],
    ["stream_dmr.run_outputs"],
    ["stream_dmr.run", *(f"stream_dmr.report.{name}" for name in ("gathered", "page", "report"))],
    ["stream_dmr.scout"],
    ["stream_dmr.batch.dataset", "stream_dmr.batch.job"],
    [f"stream_dmr.batch.{name}" for name in ("worker", "local", "ray_engine")],
    ["stream_dmr.batch.pieces", "stream_dmr.batch.stitch"],
    ["stream_dmr.batch.video"],
    ["stream_dmr.batch.batch"],
    [f"stream_dmr.review.{name}" for name in ("corrected", "judge", "server")],
    ["stream_dmr.replay.replay"],
    ["stream_dmr.display"],
    [
        f"stream_dmr.cli_{name}"
        for name in ("run", "replay", "evaluate", "train", "learn", "export", "report", "batch")
    ],
    ["stream_dmr.cli"],
    ["stream_dmr.demo"],
]
WHO_KNOWS = {
    "av": ["stream_dmr.recording"],
    "mcap": ["stream_dmr.recording"],
    "rerun": ["stream_dmr.recording"],
    "foxglove": ["stream_dmr.recording"],
    "google": ["stream_dmr.recording"],  # protobuf
    "torch": [
        "stream_dmr.segmentation",
        "stream_dmr.fitting",
        *(
            f"stream_dmr.{name}"
            for name in ("template", "skinning", "silhouette", "losses", "body")
        ),
    ],
    "prometheus_client": ["stream_dmr.watch"],
    "sqlite3": [
        *("stream_dmr.store", "stream_dmr.store_rows", "stream_dmr.store_schema"),
        *("stream_dmr.results", "stream_dmr.verdicts"),
    ],
    "filterpy": ["stream_dmr.length_filter", "stream_dmr.segmentation"],
    "onnxruntime": ["stream_dmr.segmentation"],
    "ray": ["stream_dmr.batch.ray_engine"],
    "nodes": [*ASSEMBLY, "nodes"],
    "typer": [
        *("stream_dmr.cli", "stream_dmr.cli_calibrate", "stream_dmr.cli_export"),
        *("stream_dmr.cli_evaluate", "stream_dmr.cli_support", "stream_dmr.cli_train"),
        *("stream_dmr.cli_replay", "stream_dmr.cli_view", "stream_dmr.demo"),
        *("stream_dmr.cli_recover", "stream_dmr.cli_learn"),
        *("stream_dmr.cli_report", "stream_dmr.cli_batch", "stream_dmr.cli_run"),
    ],
}


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {module_of(path) for path in FILES}


@cache
def imports(path: Path, *, top_only: bool = False) -> list[str]:
    """The modules that a file imports; `from package import module` as the module."""
    return list(_imports(path, top_only=top_only))


def _imports(path: Path, *, top_only: bool) -> Iterator[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in tree.body if top_only else ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute here"
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            yield from names & MODULES or {str(node.module)}


def is_inside(module: str, rooms: list[str]) -> bool:
    return any(module == room or module.startswith(f"{room}.") for room in rooms)


def floor_of(module: str) -> int:
    for floor, rooms in enumerate(FLOORS):
        if module in rooms or ("nodes" in rooms and is_inside(module, ["nodes"])):
            return floor
    return FLOORS.index(["*"])


@pytest.mark.parametrize("library", WHO_KNOWS)
def test_only_its_rooms_know_a_library(library: str):
    strangers = {
        module_of(path)
        for path in FILES
        for name in imports(path)
        if is_inside(name, [library]) and not is_inside(module_of(path), WHO_KNOWS[library])
    }
    assert not strangers


def test_imports_point_downwards():
    upwards = [
        (module_of(path), name)
        for path in FILES
        for name in imports(path)
        if is_inside(name, ["stream_dmr", "nodes"]) and floor_of(name) > floor_of(module_of(path))
    ]
    assert not upwards


def test_imports_have_no_cycles():
    graph = {module_of(path): set(imports(path, top_only=True)) for path in FILES}
    while leaves := [module for module, needs in graph.items() if not needs & graph.keys()]:
        for module in leaves:
            del graph[module]
    assert not graph


def test_each_node_takes_what_the_one_before_gives():
    gives = get_args(get_type_hints(inspect.unwrap(ReadFrames.__iter__))["return"])
    for node in NODES:
        step = inspect.unwrap(node.step)
        (takes, given) = (get_type_hints(step)[name] for name in (first_parameter(step), "return"))
        assert gives == (takes,), node
        gives = get_args(given)


def first_parameter(method: object) -> str:
    return list(inspect.signature(method).parameters)[1]  # type: ignore[arg-type]


@pytest.mark.parametrize("node", NODES)
def test_what_a_node_owes_later_is_what_it_gives_at_once(node: type):
    hints = [get_type_hints(inspect.unwrap(getattr(node, m))) for m in ("step", "tick", "close")]
    assert len({get_args(hint["return"]) for hint in hints}) == 1
    assert issubclass(node, Node)
