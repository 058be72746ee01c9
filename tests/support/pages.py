"""What `make docs` writes: the plan of the imports, and the tables of all settings and reasons.

A generated file is written whole; a generated table stands between two marks of its page.
"""

import ast
import inspect
import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from stream_dmr import messages
from stream_dmr.pipeline.config import Config
from stream_dmr.reasons import Reason
from stream_dmr.recording.topics import FOXGLOVE_TOPICS, TOPICS
from stream_dmr.store.run_tables import FishRow, FrameRow
from tests.support.plan import draw_plan, read_plan

DOCS = Path(__file__).resolve().parents[2] / "docs"
BEGIN = "<!-- begin of what `make docs` writes -->\n"
END = "<!-- end of what `make docs` writes -->\n"
_REMEDY_PAGES = {"train the network": "train.md", "calibrate": "calibration.md"}
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


def files_tables() -> str:
    """Topics, schemas and entities, then the fields of every message."""
    return "\n".join([topics_table() + "\n", *_message_tables()])


def topics_table() -> str:
    """The Markdown tables of topics in `docs/files.md`."""
    lines = ["| message | topic (.mcap) | schema | entities (.rrd) |", "|---|---|---|---|"]
    for row in TOPICS.values():
        entities = ", ".join(f"`{path}`" for path in row.entities)
        lines.append(f"| `{row.message.__name__}` | `{row.topic}` | `{row.schema}` | {entities} |")
    lines += ["", "| topic with `foxglove = true` | schema |", "|---|---|"]
    lines += [f"| `{topic}` | `{schema}` |" for topic, schema in FOXGLOVE_TOPICS.items()]
    return "\n".join(lines)


def _message_tables() -> Iterator[str]:
    """For each class of messages.py its fields, their types, and the comments on them."""
    source = Path(messages.__file__).read_text(encoding="utf-8")
    lines = source.splitlines()
    rows_of: dict[str, list[tuple[str, ...]]] = {}
    for node in ast.parse(source).body:
        if isinstance(node, ast.ClassDef):
            inherited = [row for base in node.bases for row in rows_of[ast.unparse(base)]]
            rows = rows_of[node.name] = inherited + [
                (f"`{ast.unparse(field.target)}`", _type(field), _comment(lines, field))
                for field in node.body
                if isinstance(field, ast.AnnAssign)
            ]
            if not rows or node.name == "FishMessage":  # nothing of its own goes anywhere
                continue
            text = (ast.get_docstring(node) or "").splitlines()[0]
            yield f"**{node.name}**: {text}\n\n" + _markdown(["field", "type", ""], iter(rows))


def _type(field: ast.AnnAssign) -> str:
    return f"`{ast.unparse(field.annotation)}`".replace("np.ndarray, ", "")


def _comment(lines: list[str], field: ast.AnnAssign) -> str:
    """What stands behind a field, or before it in lines of its own."""
    _, mark, behind = lines[field.lineno - 1].partition("#")
    if mark:
        return behind.strip()
    before = field.lineno - 1
    while lines[before - 1].strip().startswith("#"):
        before -= 1
    return " ".join(line.strip(" #") for line in lines[before : field.lineno - 1])


def columns_table(row: type) -> str:
    """The columns of a row class; those without a comment share that of the one before."""
    source = inspect.getsource(row)
    (kind,), rows = ast.parse(source).body, list[tuple[str, str]]()
    for field in kind.body if isinstance(kind, ast.ClassDef) else ():
        if isinstance(field, ast.AnnAssign):
            name, text = f"`{ast.unparse(field.target)}`", _comment(source.splitlines(), field)
            rows.append((name, text) if text else (f"{rows[-1][0]}, {name}", rows.pop()[1]))
    return _markdown(["column", "meaning"], iter(rows))


def reasons_table() -> str:
    """One row for each reason, below what it refuses."""
    rows = list[tuple[str, ...]]()
    for reason in Reason:
        if not rows or rows[-1][-1] != reason.subject:
            rows.append((f"**{reason.subject}**", "", "", reason.subject))
        remedy = reason.remedy
        for words, page in _REMEDY_PAGES.items():
            remedy = remedy.replace(words, f"[{words}]({page})")
        rows.append((f"`{reason}`", reason.explanation, remedy, reason.subject))
    return _markdown(["reason", "meaning", "what to do"], (row[:3] for row in rows))


def _markdown(head: list[str], rows: Iterator[tuple[str, ...]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    escaped = ([cell.replace("|", "\\|") for cell in cells] for cells in lines)
    return "".join(f"| {' | '.join(cells)} |\n" for cells in escaped)


WHOLE: dict[str, Callable[[], str]] = {"images/plan.svg": lambda: draw_plan(read_plan())}
# In the order of the marks of each page.
TABLES: dict[str, list[Callable[[], str]]] = {
    "settings.md": [settings_tables],
    "files.md": [partial(columns_table, FishRow), partial(columns_table, FrameRow), files_tables],
    "troubleshooting.md": [reasons_table],
}


def pages() -> Iterator[tuple[Path, str]]:
    """Every page with a generated part, and its text as it should be."""
    for name, make in WHOLE.items():
        yield DOCS / name, make()
    for name, makers in TABLES.items():
        text, *parts = (DOCS / name).read_text(encoding="utf-8").split(BEGIN)
        assert len(parts) == len(makers), f"docs/{name}: expected {len(makers)} lines {BEGIN!r}"
        for make, part in zip(makers, parts, strict=True):
            _, end, after = part.partition(END)
            assert end, f"docs/{name}: expected a line {END!r} after {BEGIN!r}, got none"
            text += f"{BEGIN}\n{make()}\n{END}{after}"
        yield DOCS / name, text


if __name__ == "__main__":
    for path, text in pages():
        path.write_text(text, encoding="utf-8")
