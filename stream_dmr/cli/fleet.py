"""`stream-dmr fleet`: how the boxes of a fleet are, on one page ashore."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stream_dmr.cli.shared_options import OverwriteOption, stop_on_signals

if TYPE_CHECKING:
    from collections.abc import Iterable

    from stream_dmr.watch.fleet_boxes import BoxState


def fleet(
    boxes: Annotated[
        list[str],
        typer.Argument(
            help="Addresses of status pages, such as http://10.0.0.7:8480/, or files with one "
            "NAME ADDRESS a line.",
            metavar="URL|FILE...",
        ),
    ],
    out: Annotated[Path, typer.Option(help="The page to write.")] = Path("fleet.html"),
    every: Annotated[
        float,
        typer.Option(help="Ask again and write it again every so many seconds; 0: once.", min=0),
    ] = 0.0,
    overwrite: OverwriteOption = False,
) -> None:
    """Write one page with health, fish an hour, alarms, disk and last contact of each box.

    A box that does not answer is shown with what it said last, which is kept in a .json of the
    page's name. The page needs no server; with --every, Ctrl-C ends it.
    """
    from stream_dmr.errors import UserError
    from stream_dmr.results.own_files import is_made_by, require_writable
    from stream_dmr.watch.fleet_boxes import ask_all, load_boxes
    from stream_dmr.watch.fleet_memory import read_memory, replace_text, write_memory
    from stream_dmr.watch.fleet_page import fleet_page

    memory = out.with_suffix(".json")
    if memory == out:
        raise UserError(f"--out: expected a page such as fleet.html, got {out}")
    require_writable(out, memory, overwrite=overwrite, is_own=is_made_by("fleet"))
    states = read_memory(memory, load_boxes(boxes))
    changes = _Changes()
    with stop_on_signals() as stop:
        while not stop.is_set():
            began_s = time.monotonic()
            states = ask_all(states)
            page = fleet_page(states, title="Fleet", every_s=every, now_ns=time.time_ns())
            write_memory(memory, states)
            replace_text(out, page)
            changes.show(states)
            if not every or stop.wait(max(0.0, every - (time.monotonic() - began_s))):
                break


class _Changes:
    """Prints a line for each box whose state or alarms are others than at the last look."""

    def __init__(self) -> None:
        self._told: dict[str, list[str]] = {}  # by address

    def show(self, states: "Iterable[BoxState]") -> None:
        """Print what is new."""
        from stream_dmr.watch.fleet_page import alarms_of, state_text

        for state in states:
            told = [state_text(state), *alarms_of(state)]
            if self._told.get(state.box.address) != told:
                print(f"{state.box.name}: {'; '.join(told)}; {_figures(state)}", flush=True)
            self._told[state.box.address] = told


def _figures(state: "BoxState") -> str:
    from stream_dmr.watch.fleet_page import disk_text, minute_text

    if state.contact_ns is None or state.reading is None:
        return "never answered"
    if state.error:
        return f"last contact {minute_text(state.contact_ns)}"
    return f"{state.reading.fish_per_hour:.0f} fish an hour, {disk_text(state.reading)} free"
