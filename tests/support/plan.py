"""The plan of the imports between packages, as an SVG: docs/images/plan.svg.

Packages stand from top to bottom in the order of `tests.test_architecture.PACKAGES`. An arc from
one package down to another says that the upper imports the lower. Arcs that a chain of others
implies are grey.
"""

import ast
from functools import cache
from typing import NamedTuple
from xml.sax.saxutils import escape

from tests.test_architecture import FILES, PACKAGES, ROOT, imports, is_inside, module_of

PACKAGE = ROOT / "stream_dmr"
_GROUND = "ground floor"
_ROW_PX, _TOP_PX, _BOX_PX, _TEXT_PX, _ARCS_PX = 34, 20, 130, 640, 330
_STYLE = """
  text { font: 14px sans-serif; fill: #222 } .name { font-weight: bold }
  rect { fill: #e8f0f7; stroke: #4a6d8c } path { fill: none; stroke: #b9c2ca; stroke-width: 1 }
  .direct { stroke: #24557a; stroke-width: 1.8; marker-end: url(#head) }
  #head path { fill: #24557a }
"""


class Plan(NamedTuple):
    """Packages from the top down, each with what it does, and who imports whom."""

    packages: dict[str, str]
    imports: set[tuple[str, str]]


def package_name(module: str) -> str:
    """The package of a module; modules beside the packages are one package, except the API."""
    if module == "stream_dmr":
        return module
    if module == "stream_dmr.api":
        return "api"
    first = module.removeprefix("stream_dmr.").partition(".")[0]
    return first if first and (PACKAGE / first).is_dir() else _GROUND


@cache
def read_plan() -> Plan:
    """The packages as they are and the imports between them."""
    between = {
        (package_name(module_of(path)), package_name(name))
        for path in FILES
        for name in imports(path)
        if is_inside(name, ["stream_dmr"])
    }
    packages = dict.fromkeys(package_name(package) for package in PACKAGES)
    return Plan(
        packages={name: _description(name) for name in packages},
        imports={(upper, lower) for upper, lower in between if upper != lower},
    )


def direct(plan: Plan) -> set[tuple[str, str]]:
    """Imports that no chain of others implies: the transitive reduction."""
    below = {
        package: {lower for upper, lower in plan.imports if upper == package}
        for package in plan.packages
    }
    reached: dict[str, set[str]] = {}
    for package in reversed(plan.packages):  # whatever it imports stands below it, so has been seen
        reached[package] = below[package].union(*(reached[lower] for lower in below[package]))
    return {
        (upper, lower)
        for upper, lower in plan.imports
        if not any(lower in reached[between] for between in below[upper])
    }


def draw_plan(plan: Plan) -> str:
    """The plan as the text of an SVG."""
    height = 2 * _TOP_PX + _ROW_PX * len(plan.packages)
    width = _BOX_PX + _TEXT_PX + _ARCS_PX
    rows = {package: _TOP_PX + _ROW_PX * (i + 0.5) for i, package in enumerate(plan.packages)}
    shown = direct(plan)
    arcs = sorted(plan.imports, key=lambda arc: (arc in shown, rows[arc[0]], rows[arc[1]]))
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}">',
        f"<style>{_STYLE}</style>",
        '<defs><marker id="head" orient="auto" markerWidth="7" markerHeight="7" refX="6" refY="3">'
        '<path d="M0,0 L6,3 L0,6 z"/></marker></defs>',
        f'<rect x="0" y="0" width="{width}" height="{height}" style="fill: #fff; stroke: none"/>',
        *(_row(package, text, rows[package]) for package, text in plan.packages.items()),
        *(_arc(rows[upper], rows[lower], (upper, lower) in shown) for upper, lower in arcs),
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def _row(name: str, text: str, y: float) -> str:
    return (
        f'<rect x="{_TEXT_PX}" y="{y - 12:g}" width="{_BOX_PX}" height="24" rx="4"/>'
        f'<text class="name" x="{_TEXT_PX + 8}" y="{y + 5:g}">{escape(name)}</text>'
        f'<text x="{_TEXT_PX - 10}" y="{y + 5:g}" text-anchor="end">{escape(text)}</text>'
    )


def _arc(top: float, bottom: float, is_direct: bool) -> str:
    left, reach = _TEXT_PX + _BOX_PX, 20 + (bottom - top) * 0.55
    style = ' class="direct"' if is_direct else ""
    start, end = f"{left},{top + 4:g}", f"{left},{bottom - 4:g}"
    return (
        f'<path{style} d="M{start} C{left + reach:g},{top + 4:g} '
        f'{left + reach:g},{bottom - 4:g} {end}"/>'
    )


def _description(package: str) -> str:
    if package == _GROUND:
        loose = [file.stem for file in sorted(PACKAGE.glob("*.py")) if file.stem != "__init__"]
        return ", ".join(loose)
    file = PACKAGE / ("" if package == "stream_dmr" else package) / "__init__.py"
    file = PACKAGE / "api.py" if package == "api" else file
    text = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8")))
    assert text, f"{file}: expected a docstring, got none; say in one line what the package does"
    return text.splitlines()[0].rstrip(".").replace("`", "")
