"""Make HTML from the templates of this folder; every value is escaped."""

from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

_FOLDER = Path(__file__).parent
_ENVIRONMENT = Environment(
    loader=FileSystemLoader(_FOLDER),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_ENVIRONMENT.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}


def render(template: str, **values: object) -> Markup:
    """The HTML of a template, given by its path in this folder."""
    text = _ENVIRONMENT.get_template(template).render(values)
    return Markup(text.encode(errors="backslashreplace").decode())  # names of files may be no UTF-8


def _source(path: str) -> Markup:
    """A script or a style sheet, unchanged."""
    return Markup((_FOLDER / path).read_text(encoding="utf-8"))


_ENVIRONMENT.filters["source"] = _source
