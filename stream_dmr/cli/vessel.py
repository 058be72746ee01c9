"""The commands `haul`, `digest` and `fleet`."""

import json
import time
import urllib.error
import urllib.request
from collections.abc import Iterable
from datetime import date
from getpass import getuser
from http import HTTPStatus
from http.client import HTTPException
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from stream_dmr.cli.shared_options import OverwriteOption, stop_on_signals, warn
from stream_dmr.errors import UserError, reason_of

if TYPE_CHECKING:
    from stream_dmr.web.fleet_page import BoxState

_TIMEOUT_S = 10.0


def haul(
    what: Annotated[Literal["start", "end"], typer.Argument(help="start or end")],
    target: Annotated[
        str,
        typer.Argument(
            help="Address of a run's status page, or the --out of a run.", metavar="URL|DIR"
        ),
    ],
    name: Annotated[str, "Name of the haul.", "the next number"] = "",
    at: Annotated[
        str | None, "When: UTC as 2026-11-22T06:00:00Z, or seconds as in lengths.csv; for a DIR."
    ] = None,
    token_file: Annotated[Path | None, "The access token of the status page."] = None,
) -> None:
    """Begin or end a haul; its fish are those whose middle frame lies in it."""
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
        from stream_dmr.pipeline.haul_log import write_haul

        written = write_haul(Path(target), what, name=name, at=at, said_by=getuser())
        print(f"haul {written}: {what}")


def _post(address: str, what: str, name: str, token_file: Path | None) -> str:
    from stream_dmr.files import read_secret

    headers = {"Content-Type": "application/json"}
    if token_file is not None:
        headers["Authorization"] = f"Bearer {read_secret(token_file, where='--token-file')}"
    content = json.dumps({"what": what, "name": name, "said_by": getuser()}).encode()
    try:
        request = urllib.request.Request(f"{address.rstrip('/')}/haul", content, headers)
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
            return f"haul {json.loads(answer.read())['name']}: {what}"
    except urllib.error.HTTPError as error:
        with error:
            is_ours = error.headers.get_content_type() == "text/plain"
            reply = error.read(500).decode(errors="replace").strip() if is_ours else ""
        if error.code == HTTPStatus.UNAUTHORIZED:
            reply = "it wants its access token: --token-file FILE"
        raise UserError(
            f"{address}: expected it to take the haul, got: {reply or error}"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, HTTPException) as error:
        # The text of a URLError, <urlopen error ...>, hides its cause: an error or a text.
        cause = error.reason if isinstance(error, urllib.error.URLError) else error
        got = reason_of(cause) if isinstance(cause, Exception) else cause
        raise UserError(
            f"{address}: expected the status page of a run, got: {got}; give the address that "
            "the run prints when it starts ([watch] port in its config)"
        ) from error


def digest(
    folder: Annotated[Path, typer.Argument(help="The --out of a run.", metavar="DIR")],
    day: Annotated[str, "The UTC day, such as 2026-11-25."],
    out: Annotated[Path | None, "The file to write.", "digest-DAY.zip in the folder"] = None,
    key: Annotated[Path | None, "The device's private key, which signs it; see keygen."] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write a day of a run into one small file (50 kB, or what its fish need), to be sent ashore.

    It has the fish, hauls, positions, hours watched, alarms, hashes of the recordings, and small
    pictures of as many fish as there is room for. `fleet` shows it, `verify --key` checks it.
    """
    from stream_dmr.evidence.own_files import is_made_by, require_writable
    from stream_dmr.store.ledger import Signer
    from stream_dmr.web.day_digest import MAX_BYTES, digest_name, write_digest

    try:
        asked = date.fromisoformat(day)
    except ValueError as error:
        raise UserError(f"--day: expected a day such as 2026-11-25, got {day}") from error
    path = out or folder / digest_name(asked)
    require_writable(path, overwrite=overwrite, is_own=is_made_by("digest"))
    size = write_digest(folder, asked, path, Signer(key))
    print(f"{path}: {size / 1000:.1f} kB")
    if size > MAX_BYTES:
        warn([f"{path}: more than {MAX_BYTES // 1000} kB, since no fish is left out"])


def fleet(
    boxes: Annotated[
        list[str],
        typer.Argument(
            help="Addresses of status pages, such as http://10.0.0.7:8480/, digests or folders of "
            "a box's digests, or files with one NAME ADDRESS a line, where FILE.pub after digests "
            "checks their signature.",
            metavar="URL|FILE|DIR...",
        ),
    ],
    out: Annotated[Path, "The page to write."] = Path("fleet.html"),
    every: Annotated[
        float,
        typer.Option(help="Ask again and write it again every so many seconds; 0: once.", min=0),
    ] = 0.0,
    overwrite: OverwriteOption = False,
) -> None:
    """Write one page with health, fish per hour, alarms, disk and last contact of each box.

    A box that does not answer is shown with what it said last, which is kept in a .json of the
    page's name. The page needs no server; with --every, Ctrl-C ends it.
    """
    from stream_dmr.evidence.own_files import is_made_by, require_writable
    from stream_dmr.files import replace_text
    from stream_dmr.web.fleet_page import ask_all, fleet_page, load_boxes, read_memory, write_memory

    memory = out.with_suffix(".json")
    if memory == out:
        raise UserError(f"--out: expected a page such as fleet.html, got {out}")
    require_writable(out, memory, overwrite=overwrite, is_own=is_made_by("fleet"))
    states = read_memory(memory, load_boxes(boxes))
    printed = dict[str, str]()  # by address
    with stop_on_signals() as stop:
        while not stop.is_set():
            began_s = time.monotonic()
            states = ask_all(states)
            page = fleet_page(states, every_s=every, now_ns=time.time_ns())
            write_memory(memory, states)
            replace_text(out, page)
            _print_changes(states, printed)
            if not every or stop.wait(max(0.0, every - (time.monotonic() - began_s))):
                break


def _print_changes(states: "Iterable[BoxState]", printed: dict[str, str]) -> None:
    """Print a line for each box whose state or alarms changed since they were `printed`."""
    for state in states:
        now = ": ".join(filter(None, (state.text, "; ".join(state.alarms))))
        if printed.get(state.box.address) != now:
            print(
                f"{state.box.name}: {'; '.join(filter(None, (now, _figures(state))))}", flush=True
            )
        printed[state.box.address] = now


def _figures(state: "BoxState") -> str:
    if state.contact_ns is None or state.reading is None:
        return ""
    figures = f"{state.reading.fish_per_hour:.0f} fish per hour, {state.reading.disk_text} free"
    if state.error:
        figures = f"last contact {state.contact_text}"
    return ", ".join(filter(None, (figures, state.signature_text)))
