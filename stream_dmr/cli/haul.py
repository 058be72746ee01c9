"""`stream-dmr haul`: begins and ends hauls, on a running box or in a folder of results."""

import json
import urllib.error
import urllib.request
from getpass import getuser
from http.client import HTTPException
from pathlib import Path
from typing import Annotated, Literal

import typer

_TIMEOUT_S = 10.0


def haul(
    what: Annotated[Literal["start", "end"], typer.Argument(help="start or end")],
    target: Annotated[
        str,
        typer.Argument(
            help="Address of a run's status page, or the --out of a run.", metavar="URL|DIR"
        ),
    ],
    name: Annotated[
        str, typer.Option(help="Name of the haul.", show_default="the next number")
    ] = "",
    at: Annotated[
        str | None,
        typer.Option(
            help="When: UTC as 2026-11-22T06:00:00Z, or seconds as in lengths.csv; for a DIR.",
        ),
    ] = None,
    token_file: Annotated[
        Path | None, typer.Option(help="The access token of the status page.")
    ] = None,
) -> None:
    """Begin or end a haul; its fish are those whose middle frame lies in it."""
    from stream_dmr.errors import UserError

    if target.startswith(("http://", "https://")):
        if at is not None:
            raise UserError(
                f"--at: expected with the folder of a run alone, a running box takes a haul as of "
                f"now, got {at} with {target}; leave it out, or give the box's --out"
            )
        print(_post(target, what, name, token_file))
    elif "://" in target:
        raise UserError(
            f"{target}: expected http:// or https:// of a run's status page, or the --out of a "
            "run, got another kind of address"
        )
    else:
        print(_write(Path(target), what, name, at))


def _post(address: str, what: str, name: str, token_file: Path | None) -> str:
    from stream_dmr.errors import UserError

    headers = {"Content-Type": "application/json"}
    if token_file is not None:
        headers["Authorization"] = f"Bearer {_read_token(token_file)}"
    content = json.dumps({"what": what, "name": name, "said_by": getuser()}).encode()
    try:
        request = urllib.request.Request(f"{address.rstrip('/')}/haul", content, headers)
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
            return f"haul {json.loads(answer.read())['name']}: {what}"
    except urllib.error.HTTPError as error:
        with error:
            is_ours = error.headers.get_content_type() == "text/plain"
            said = error.read(500).decode(errors="replace").strip() if is_ours else ""
        raise UserError(f"{address}: expected it to take the haul, got: {said or error}") from error
    except (OSError, ValueError, KeyError, TypeError, HTTPException) as error:
        raise UserError(
            f"{address}: expected the status page of a run ([watch] port), got: {error}"
        ) from error


def _read_token(path: Path) -> str:
    from stream_dmr.errors import UserError, reason_of

    try:
        return path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(
            f"--token-file {path}: expected a file with the access token, got: {reason_of(error)}"
        ) from error


def _write(folder: Path, what: str, name: str, at: str | None) -> str:
    from stream_dmr.results.haul_events import write_haul

    written = write_haul(folder, what, name=name, at=at, said_by=getuser())
    return f"haul {written}: {what}"
