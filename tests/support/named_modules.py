"""Which modules of the library no test names: `python -m tests.support.named_modules` lists them.

A test names a module by importing it, or by its own file's name: tests/.../test_MODULE.py.
"""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def library_modules() -> dict[str, Path]:
    """The modules that hold code, by name; `nodes/` is `stream_dmr.nodes`."""
    found = dict[str, Path]()
    for path in sorted([*(ROOT / "stream_dmr").rglob("*.py"), *(ROOT / "nodes").glob("*.py")]):
        parts = path.relative_to(ROOT).with_suffix("").parts
        if parts[-1].startswith("__"):
            continue
        found[".".join(parts if parts[0] == "stream_dmr" else ("stream_dmr", *parts))] = path
    return found


def named_by_tests() -> Iterator[str]:
    """The modules that tests import; of a name imported from a package, both as a module."""
    for path in (ROOT / "tests").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                yield str(node.module)
                yield from (f"{node.module}.{alias.name}" for alias in node.names)


@cache
def unnamed_modules() -> list[str]:
    """Modules that no test imports and that have no test file of their own."""
    named = set(named_by_tests())
    files = {path.stem.removeprefix("test_") for path in (ROOT / "tests").rglob("test_*.py")}
    return [m for m in library_modules() if m not in named and m.split(".")[-1] not in files]


if __name__ == "__main__":
    print("\n".join(unnamed_modules()))
