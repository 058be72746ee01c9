"""What DESIGN promises of the structure: who may import whom, and that the stages fit together."""

import ast
import inspect
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from stream_dmr.messages import TrackEnded
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.nodes.read_frames import ReadFrames
from stream_dmr.pipeline.chain import Node
from stream_dmr.pipeline.config import Config
from stream_dmr.pipeline.session import Session, Setup
from stream_dmr.template.template_file import load_template
from tests.support.named_modules import unnamed_modules

ROOT = Path(__file__).resolve().parents[1]
# A link to nodes/, so that an installation adds one name to import; globs don't follow it.
LINKED = ROOT / "stream_dmr" / "nodes"
FILES = sorted([*(ROOT / "stream_dmr").rglob("*.py"), *LINKED.glob("*.py")])
_SETUP = Setup(config=Config(), template=load_template("cod"), calibration=None)
NODES = [CropFish, *map(type, Session(_SETUP).nodes)]
# Modules beside the packages, from the top down.
GROUND_FLOOR = [
    f"stream_dmr.{name}"
    for name in (
        *("species", "tables", "pictures", "files", "compiled", "messages", "reasons", "camera"),
        *("geometry", "settings", "errors", "version"),
    )
]
# From the top down, as in the design: a module belongs to the package with the longest name that it
# begins with, and imports from its own package and those below.
PACKAGES = [
    "stream_dmr",  # the names that `import stream_dmr` offers
    "stream_dmr.cli",
    "stream_dmr.api",
    "stream_dmr.batch",
    "stream_dmr.web",
    "stream_dmr.export",
    "stream_dmr.pipeline",
    "stream_dmr.nodes",
    "stream_dmr.evidence",
    "stream_dmr.store",
    "stream_dmr.recording",
    "stream_dmr.lengths",
    "stream_dmr.localization",
    "stream_dmr.fitting",
    "stream_dmr.tracking",
    "stream_dmr.detection",
    "stream_dmr.training",
    "stream_dmr.segmentation",
    "stream_dmr.networks",
    "stream_dmr.template",
    "stream_dmr.simulation",
    "stream_dmr.calibration",
    "stream_dmr.sources",
    "stream_dmr.evaluation",
    *GROUND_FLOOR,
]
WHO_KNOWS = {
    "apprise": ["stream_dmr.web"],
    "av": ["stream_dmr.recording"],
    "mcap": ["stream_dmr.recording"],
    "rerun": ["stream_dmr.recording"],
    "foxglove": ["stream_dmr.recording"],
    "google": ["stream_dmr.recording"],  # protobuf
    "torch": ["stream_dmr.networks", "stream_dmr.training", "stream_dmr.fitting.paper"],
    "prometheus_client": ["stream_dmr.web"],
    "jinja2": ["stream_dmr.web"],
    "sqlite3": ["stream_dmr.store", "stream_dmr.evidence"],
    "cryptography": ["stream_dmr.store", "stream_dmr.evidence"],
    "filterpy": ["stream_dmr.lengths", "stream_dmr.tracking"],
    "onnxruntime": ["stream_dmr.networks"],
    "ray": ["stream_dmr.batch"],
    "stream_dmr.nodes": [
        f"stream_dmr.{package}" for package in ("pipeline", "batch", "web", "nodes")
    ],
    "pynmeagps": ["stream_dmr.sources"],
    "serial": ["stream_dmr.sources"],
    "typer": ["stream_dmr.cli"],
}


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {module_of(path) for path in FILES}


@cache
def nodes_of(path: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


@cache
def imports(path: Path, *, top_only: bool = False) -> list[str]:
    """The modules that a file imports; `from package import module` as the module."""
    return list(_imports(path, top_only=top_only))


def _imports(path: Path, *, top_only: bool) -> Iterator[str]:
    nodes = nodes_of(path)
    for node in nodes[0].body if top_only else nodes:  # type: ignore[attr-defined]
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute here"
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            yield from names & MODULES or {str(node.module)}


def is_inside(module: str, packages: list[str]) -> bool:
    return any(module == package or module.startswith(f"{package}.") for package in packages)


def package_of(module: str) -> str:
    packages = [package for package in PACKAGES if is_inside(module, [package])]
    package = max(packages, key=len)
    assert package == module or package != "stream_dmr", f"{module} belongs to no package"
    return package


def test_every_module_belongs_to_a_package():
    with_modules = {package_of(module) for module in MODULES}
    assert with_modules == set(PACKAGES)


@pytest.mark.parametrize("library", WHO_KNOWS)
def test_only_its_packages_know_a_library(library: str):
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
        if is_inside(name, ["stream_dmr"])
        and PACKAGES.index(package_of(name)) < PACKAGES.index(package_of(module_of(path)))
    ]
    assert not upwards


def test_file_names_are_unique():
    names = [path.stem for path in FILES if not path.stem.startswith("__")]
    assert not [name for name, count in Counter(names).items() if count > 1]


def test_class_names_are_unique():
    nodes = (node for path in FILES for node in nodes_of(path))
    counts = Counter(node.name for node in nodes if isinstance(node, ast.ClassDef))
    assert not [name for name, count in counts.items() if count > 1]


# Python's own names with an underscore that are public all the same.
PUBLIC = {"_replace", "_asdict", "_fields", "_make", "_exit", "_value_"}
OWNERS = {"self", "cls", "other"}


def test_nobody_uses_private_names_of_others():
    folders = [*FILES, *(ROOT / "tests").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]
    used = [f"{path.relative_to(ROOT)}: {name}" for path in folders for name in private_uses(path)]
    assert not used


def private_uses(path: Path) -> Iterator[str]:
    """Private names that a file imports, or takes of objects that are not its own."""
    nodes = nodes_of(path)
    own = {node.attr for node in nodes if isinstance(node, ast.Attribute) and is_own(node)}
    own |= {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    for node in nodes:
        if isinstance(node, ast.ImportFrom):
            yield from (alias.name for alias in node.names if is_private(alias.name))
        elif isinstance(node, ast.Attribute) and is_private(node.attr) and node.attr not in own:
            yield node.attr


def is_own(node: ast.Attribute) -> bool:
    return isinstance(node.value, ast.Name) and node.value.id in OWNERS


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__") and name not in PUBLIC


# Modules that no test names, and why. `python -m tests.support.named_modules` lists all.
UNNAMED = {
    "stream_dmr.cli": "commands are tested as they are typed",
    "stream_dmr.export.export_choices": "names of choices",
    "stream_dmr.settings": "a base class without code of its own",
    "stream_dmr.version": "a number",
}


def test_every_module_is_named_by_a_test():
    assert not [m for m in unnamed_modules() if not is_inside(m, list(UNNAMED))]
    assert all(any(is_inside(m, [known]) for m in unnamed_modules()) for known in UNNAMED)


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
        (given,) = get_args(given)  # of a sequence
        gives = tuple(kind for kind in get_args(given) or (given,) if kind is not TrackEnded)


def first_parameter(method: object) -> str:
    return list(inspect.signature(method).parameters)[1]  # type: ignore[arg-type]


@pytest.mark.parametrize("node", NODES)
def test_close_returns_what_step_returns(node: type):
    hints = [get_type_hints(inspect.unwrap(getattr(node, m))) for m in ("step", "close")]
    assert len({get_args(hint["return"]) for hint in hints}) == 1
    assert issubclass(node, Node)
