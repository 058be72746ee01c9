"""Runs `stream-dmr` as a user does, within this process: one import of torch for all tests."""

import csv
import io
import sys
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch


@dataclass(frozen=True, kw_only=True)
class Outcome:
    code: int
    out: str
    err: str

    @property
    def error(self) -> str:
        """The one line that says what is wrong; warnings may stand before it."""
        lines = self.err.splitlines()
        errors = [line for line in lines if not line.startswith("warning: ")]
        assert len(errors) == 1, self.err
        assert errors[0].startswith("error: ")
        return errors[0].removeprefix("error: ")


def invoke(command: str, options: Mapping[str, str | None] | None = None) -> Outcome:
    """`stream-dmr COMMAND --key value ...`; a value of None gives a flag."""
    from stream_dmr.cli.main import main

    arguments = [part for item in (options or {}).items() for part in item if part is not None]
    out, err, code = io.StringIO(), io.StringIO(), 0
    argv = ["stream-dmr", *command.split(), *arguments]
    finders = patch.object(sys, "meta_path", [*sys.meta_path])  # a command hides what it needs not
    with redirect_stdout(out), redirect_stderr(err), patch.object(sys, "argv", argv), finders:
        try:
            main()
        except SystemExit as exit_:
            code = exit_.code if isinstance(exit_.code, int) else 0
    return Outcome(code=code, out=out.getvalue(), err=err.getvalue())


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))
