"""Serve `review`: its page, clips and verdicts."""

import secrets
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from http import HTTPStatus
from typing import Any

import numpy as np

from stream_dmr.errors import ConfigError, UserError
from stream_dmr.species import load_species
from stream_dmr.store.fish import Fish, database_of, read_measured_fish
from stream_dmr.store.open_results import require_recording
from stream_dmr.store.verdicts import NOT_REVIEWED
from stream_dmr.web.added_fish import DoubtError
from stream_dmr.web.clip import fish_clip
from stream_dmr.web.report_page import PlacedReport, RunReport, fish_detail, place, render_page
from stream_dmr.web.token_server import Request, Response, Route, TokenServer, json_response
from stream_dmr.web.verdict_recorder import VerdictRecorder, parse_verdict


@dataclass(frozen=True, kw_only=True)
class AuditSample:
    """A random sample of fish: its size, and the seed of the generator."""

    size: int
    seed: int = 0


class ReviewQueue:
    """Takes the verdicts of a reviewer on the fish of all reports. Thread-safe."""

    def __init__(
        self,
        reports: Sequence[RunReport],
        *,
        reviewer: str,
        blind: bool = False,
        sample: AuditSample | None = None,
    ) -> None:
        """UserError if a report has no database or no recording."""
        for report in reports:
            require_recording(report.recording, where=report.path, what="a review")
        self.placed = place(reports)
        self._recorders = [VerdictRecorder(report, reviewer, blind=blind) for report in reports]
        measured = [] if sample is None else measured_numbers(self.placed)
        self._measured = {*measured}
        self._last = [recorder.last() for recorder in self._recorders]
        self._chosen = None if sample is None else sampled(measured, sample)
        self._about: dict[str, Any] = {"reviewer": reviewer, "blind": blind}
        self._about["species"] = species_choices(reports[0].config.species.own_list)
        if sample is not None:
            self._about["sample"] = {"size": sample.size, "seed": sample.seed}

    def page(self, title: str) -> str:
        reports = [
            replace(report, fish=[fish for fish in self._fish(run) if self._is_shown(run, fish)])
            for run, report in enumerate(recorder.report for recorder in self._recorders)
        ]
        return render_page(reports, title=title, review=self._about | {"undo": self._undo()[1]})

    def reviewed_rows(self) -> list[dict[str, Any]]:
        """The rows of all fish that a verdict names; `{"id": ..., "gone": true}` for lost fish."""
        rows: list[dict[str, Any]] = []
        for run, recorder in enumerate(self._recorders):
            _, _, named = recorder.snapshot()
            rows += self._rows(run, named) if named else []
        return rows

    def record(self, content: bytes) -> dict[str, Any]:
        """Take a verdict in JSON. Raises UserError if it is invalid.

        Returns `rows` of the changed fish, the verdict in words (`said`), and in `undo` the verdict
        that an undo would take back: this reviewer's last verdict in any run.
        """
        submitted = parse_verdict(content)
        is_undo = submitted.kind == "undo"
        if is_undo:  # another review of the same name may have written, or undone, meanwhile
            self._last = [recorder.last() for recorder in self._recorders]
        run, undone = self._undo() if is_undo else (submitted.run, "")
        recorder = self._recorder(run)
        rows = self._rows(run, recorder.record(submitted))
        self._last[run] = recorder.last()
        in_words = f"{undone}, taken back" if is_undo else self._in_words(run)
        return {"rows": rows, "said": in_words, "undo": self._undo()[1]}

    def detail(self, run: int, track_id: int) -> dict[str, Any]:
        """The details that a row opens. UserError without such a fish."""
        for fish in self._fish(run, {track_id}):
            return fish_detail(fish, self._recorder(run).report)
        raise UserError(f"expected a fish of this review, got {track_id}")

    def thumbnail(self, run: int, track_id: int) -> bytes:
        """The best view of a fish as WebP; empty if there is none."""
        return next(
            (view.thumbnail for view in self._recorder(run).report.drawn(track_id).views), b""
        )

    def clip(self, run: int, track_id: int, shift: int) -> Iterator[bytes]:
        """The clip around a fish, see `fish_clip`. UserError without such a fish."""
        recorder = self._recorder(run)
        return fish_clip(recorder.report, recorder.pictures, track_id, shift=shift)

    def close(self) -> None:
        for recorder in self._recorders:
            recorder.pictures.close()

    def _recorder(self, run: int) -> VerdictRecorder:
        if not 0 <= run < len(self._recorders):
            raise UserError(f"expected a run of this review, got {run}")
        return self._recorders[run]

    def _undo(self) -> tuple[int, str]:
        """The run of this reviewer's last verdict, and that verdict in words; "" without any."""
        times = [0 if verdict is None else verdict.written_ns for verdict in self._last]
        run = times.index(max(times))
        return run, self._in_words(run)

    def _in_words(self, run: int) -> str:
        last, placed = self._last[run], self.placed[run]
        video = f" of {placed.report.title}" if placed.is_one_of_many else ""
        return f"Fish {last.track_id}{video}: {last.in_words}" if last else ""

    def _rows(self, run: int, track_ids: Sequence[int] | set[int]) -> list[dict[str, Any]]:
        placed = self.placed[run]  # verdicts change its fish, but nothing that a row takes of it
        fish = {seen.estimate.track_id: seen for seen in self._fish(run, set(track_ids))}
        lost = [track_id for track_id in track_ids if track_id not in fish]
        gone = [{"id": placed.row_id(track_id), "gone": True} for track_id in lost]
        return [*(placed.row(f) for f in fish.values() if self._is_shown(run, f)), *gone]

    def _fish(self, run: int, wanted: set[int] | None = None) -> Iterator[Fish]:
        """The fish of a run as this reader sees them."""
        report, reviews, _ = self._recorder(run).snapshot()
        for fish in report.fish:
            track_id = fish.estimate.track_id
            if wanted is None or track_id in wanted:
                yield replace(fish, review=reviews.get(track_id, NOT_REVIEWED))

    def _is_shown(self, run: int, fish: Fish) -> bool:
        """True for the fish of the sample, and for fish added after it was drawn."""
        number = self.placed[run].row_id(fish.estimate.track_id)
        return self._chosen is None or number in self._chosen or number not in self._measured


def species_choices(own_list: str) -> list[dict[str, str]]:
    """Codes and names that a reviewer may type, and the `value` that becomes the verdict.

    The value of a species in the user's own list is its code: readers need not have the list.
    """
    bundled = {species.code for species in load_species()}
    try:
        known = load_species(own_list)
    except ConfigError:  # the list is not on this machine
        known = load_species()
    return [
        {
            "code": species.code,
            "name": species.english_name or species.scientific_name,
            "scientific": species.scientific_name,
            "value": species.scientific_name if species.code in bundled else species.code,
        }
        for species in known
    ]


def measured_numbers(placed: Sequence[PlacedReport]) -> list[int]:
    """The numbers, in the page, of the fish that were measured, by their folders' paths.

    Their order is the same in whatever order the folders are given.
    """
    return [
        number
        for part in sorted(placed, key=lambda part: part.report.path.resolve())
        if (database := database_of(part.report.path)) is not None
        for number in sorted(
            part.row_id(fish.estimate.track_id) for fish in read_measured_fish(database)
        )
    ]


def sampled(numbers: Sequence[int], sample: AuditSample) -> set[int]:
    """A random sample of the numbers; equal seeds draw equal samples."""
    rng = np.random.default_rng(sample.seed)
    size = min(sample.size, len(numbers))
    return set(rng.choice(numbers, size, replace=False).tolist())


class ReviewServer(TokenServer):
    """Serves the page on this machine, to people who have the token in `address`."""

    setting = "--port"

    def __init__(self, queue: ReviewQueue, *, title: str, port: int = 0) -> None:
        self._queue = queue
        routes: dict[tuple[str, str], Route] = {
            ("GET", "/"): lambda _: Response(queue.page(title).encode()),
            ("GET", "/reviewed.json"): lambda _: json_response(queue.reviewed_rows()),
            ("GET", "/fish.json"): lambda asked: json_response(
                queue.detail(asked.number("run"), asked.number("fish"))
            ),
            ("GET", "/thumbnail"): lambda asked: Response(
                queue.thumbnail(asked.number("run"), asked.number("fish")), "image/webp"
            ),
            ("GET", "/clip"): lambda asked: Response(
                queue.clip(asked.number("run"), asked.number("fish"), asked.number("shift")),
                "application/octet-stream",
            ),
            ("POST", "/verdict"): self._take_verdict,
        }
        super().__init__(("127.0.0.1", port), routes, token=secrets.token_urlsafe(24))
        self.address += f"?token={self.token}"

    def close(self) -> None:
        super().close()
        self._queue.close()

    def _take_verdict(self, asked: Request) -> Response:
        try:
            return json_response(self._queue.record(asked.body))
        except DoubtError as error:
            return json_response({"question": str(error)}, HTTPStatus.CONFLICT)
