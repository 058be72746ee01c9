"""A video on its way through a batch: in one piece, or in some."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from stream_dmr.batch.job import SCOUT, Outcome, outcome_of, pieces_folder
from stream_dmr.batch.manifest import Job
from stream_dmr.batch.pieces import pieces_of
from stream_dmr.batch.places import DONE, FAILED
from stream_dmr.batch.stitch import stitch
from stream_dmr.errors import UserError


class Video:
    """What is still to be done of a video, and what became of it."""

    def __init__(self, job: Job, out: Path, piece_frames: int) -> None:
        """Videos of more than `piece_frames` (0: none) are cut; what is done of them is kept."""
        self.job = job
        self.outcome: Outcome | None = None  # once it is certain
        self._out, self._piece_frames = out, piece_frames
        self._plan()

    def todo(self) -> Sequence[Job]:
        """The pieces to do now; of a raw video there may be more when they are done."""
        return () if self.outcome else [one for one in self.pieces if one.label not in self._done]

    def done(self) -> Sequence[Job]:
        """The pieces that are done."""
        return [one for one in self.pieces if one.label in self._done]

    def take(self, piece: Outcome) -> None:
        """Take note of what became of a piece, while nothing is certain of the video."""
        if piece.status != DONE:
            self._end(replace(piece, name=self.job.label, key=self.job.key, status=FAILED))
        elif self.pieces == [self.job]:
            self._end(piece)
        elif self.pieces[0].piece == SCOUT:
            self._plan()
        else:
            self._done.add(piece.name)
            self._stitch_if_done()

    def _plan(self) -> None:
        self.pieces = [self.job]
        if self._piece_frames:
            self.pieces = pieces_of(self.job, self._piece_frames, self._out)
        self._done = set[str]()
        if self.pieces != [self.job]:
            self._done = {one.label for one in self.pieces if self._is_done(one)}
            self._stitch_if_done()

    def _is_done(self, piece: Job) -> bool:
        outcome = outcome_of(piece, self._out)
        return outcome is not None and outcome.status == DONE

    def _stitch_if_done(self) -> None:
        if self.todo():
            return
        try:
            self._end(stitch(self.job, self.pieces, self._out))
        except UserError as error:
            failed = Outcome(
                name=self.job.label, key=self.job.key, status=FAILED, reason=str(error)
            )
            self._end(failed)

    def _end(self, outcome: Outcome) -> None:
        self.outcome = outcome
        if outcome.status == DONE:
            shutil.rmtree(pieces_folder(self.job, self._out), ignore_errors=True)
