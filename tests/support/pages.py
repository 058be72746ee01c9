"""What `make docs` writes: the plan of the imports, and the tables of all settings and reasons.

A generated file is written whole; a generated table stands between two marks of its page.
"""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from stream_dmr.running.config import Config
from tests.support.plan import draw_plan, read_plan

DOCS = Path(__file__).resolve().parents[2] / "docs"
BEGIN = "<!-- begin of what `make docs` writes -->\n"
END = "<!-- end of what `make docs` writes -->\n"
_BOUNDS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}


def settings_tables() -> str:
    """One Markdown table for each table of config.toml."""
    schema = Config.model_json_schema()
    return "\n".join(
        f"## `[{name}]`: {table['description']}\n\n"
        + _markdown(["setting", "default", "may be", "meaning"], _rows(_resolve(schema, table)))
        for name, table in schema["properties"].items()
    )


def _resolve(schema: dict[str, Any], table: dict[str, Any]) -> dict[str, Any]:
    return schema["$defs"][table["$ref"].rsplit("/", 1)[1]]["properties"]


def _rows(settings: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    for key, setting in settings.items():
        default = json.dumps(setting["default"], ensure_ascii=False)
        yield f"`{key}`", f"`{default}`", _allowed(setting), setting["description"]


def _allowed(setting: dict[str, Any]) -> str:
    if "enum" in setting:
        return ", ".join(f'`"{choice}"`' for choice in setting["enum"])
    bounds = [f"{sign} {setting[bound]:g}" for bound, sign in _BOUNDS.items() if bound in setting]
    return ", ".join(bounds)


def _markdown(head: list[str], rows: Iterator[tuple[str, ...]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


WHOLE: dict[str, Callable[[], str]] = {"images/plan.svg": lambda: draw_plan(read_plan())}
TABLES: dict[str, Callable[[], str]] = {"settings.md": settings_tables}


def pages() -> Iterator[tuple[Path, str]]:
    """Every page with a generated part, and its text as it should be."""
    for name, make in WHOLE.items():
        yield DOCS / name, make()
    for name, make in TABLES.items():
        before, _, rest = (DOCS / name).read_text(encoding="utf-8").partition(BEGIN)
        _, end, after = rest.partition(END)
        assert end, f"docs/{name}: expected the lines {BEGIN!r} and {END!r}, got none"
        yield DOCS / name, f"{before}{BEGIN}\n{make()}\n{END}{after}"


if __name__ == "__main__":
    for path, text in pages():
        path.write_text(text, encoding="utf-8")
