"""Exports recordings as meshes, COCO masks and tables."""

import json
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from functools import cache, cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
import trimesh

from stream_dmr.errors import OutputError
from stream_dmr.evidence.own_files import require_writable
from stream_dmr.evidence.seal import known_files, read_origin, seal_files
from stream_dmr.export.agency_tables import (
    AGENCIES,
    AGENCY_TEXTS,
    HAUL_COLUMNS,
    haul_row,
    template_of,
)
from stream_dmr.export.coco_masks import coco_masks, is_picture
from stream_dmr.export.export_choices import Agency, MeshFormat, TableFormat
from stream_dmr.export.fish_table import (
    FISH_TABLE,
    fish_record,
    unweighed_note,
    used_columns,
    write_csv,
    write_parquet,
)
from stream_dmr.export.viame_csv import viame_csv
from stream_dmr.files import make_folder, writing_to
from stream_dmr.messages import FishCrop, FittedMesh, Frame, LengthEstimate, LocalizedFish
from stream_dmr.pipeline.config import Config
from stream_dmr.pipeline.run_inputs import species_notes
from stream_dmr.recording.codec import stored_picture
from stream_dmr.recording.reading import (
    decoded_messages,
    messages_of,
    part_at,
    require_messages,
    require_time,
    require_tracks,
)
from stream_dmr.recording.record import make_record
from stream_dmr.recording.selection import EVERYTHING, Selection
from stream_dmr.recording.topics import RecordingSettings
from stream_dmr.recording.view_geometry import MeshRebuilder, place_fit
from stream_dmr.store.edits import ReviewedMessages
from stream_dmr.store.effort import read_effort
from stream_dmr.store.fish import Fish, database_of, read_fish, read_runs
from stream_dmr.store.open_results import open_results, require_recording, template_of_fish
from stream_dmr.store.run_facts import run_facts
from stream_dmr.store.run_tables import FramesTable, write_lengths
from stream_dmr.store.scale_checks import last_checks
from stream_dmr.template.template import Template

Stage = TypeVar("Stage", FishCrop, FittedMesh)


class Export:
    """A recording, or a part of it, for other programs. Raises a UserError."""

    def __init__(
        self, recording: Path, selection: Selection = EVERYTHING, *, overwrite: bool = False
    ) -> None:
        """With `overwrite`, existing files are replaced, except for files of a run."""
        self._path = recording
        self._database = database_of(recording)
        self.recording = open_results(recording)
        self.header = self.recording.header
        self._selection = selection
        self._reviewed = ReviewedMessages(self.recording, self._database, selection)
        self._written: list[Path] = []
        self._overwrite = overwrite
        self._earlier: set[Path] = set()  # exported before from the same recording
        self._new: list[Path] = []  # files and folders made here, not yet in a provenance
        self.notes: list[str] = []  # what the exports so far lack, one line each
        self._require_selected()

    @contextmanager
    def into(self, out: Path) -> Generator[None]:
        """The exports of the block go into `out`; provenance.json has their inputs and checksums.

        An error or a signal removes the files of the block, so that the same command can be given
        again; replaced files stay as they are then. OutputError if `out` holds exports of another
        recording.
        """
        origin = read_origin(out)
        if origin is not None and origin.resolve() != self._path.resolve():
            raise OutputError(
                f"{out}: expected a folder for exports of {self._path}, found exports of "
                f"{origin}; choose another --out"
            )
        self._earlier = {out / name for name in known_files(out)}
        try:
            yield
            database = self._database
            runs = {"": run_facts(self.header)} if database is None else read_runs(database)
            seal_files(out, self._written, runs=runs, origin=str(self._path))
        except BaseException:
            for path in reversed(self._new):
                with suppress(OSError):
                    path.rmdir() if path.is_dir() else path.unlink()
            raise

    def meshes(self, out: Path, *, format: MeshFormat) -> int:
        """Write `fish-ID/FRAME.ply` (or .glb) into `out`; returns their number.

        Vertices are in the camera frame, in mm; without a calibration a fish is one body length
        long.
        """
        self._require_writable(needed_for="--meshes")
        meshes, count = cache(MeshRebuilder.of), 0
        for fit, fish in self._localized(FittedMesh):
            part = part_at(self.recording, fit.timestamp_ns)
            shape = meshes(part).with_vertices(fit).shape
            vertices = None if shape is None else place_fit(shape, fish)[0]
            if vertices is not None:
                mesh = trimesh.Trimesh(vertices, part.header.template.faces, process=False)
                target = out / f"fish-{fit.track_id}" / f"{fit.frame_index:06d}.{format}"
                self._require_writable(target)
                with self._writing(target):
                    mesh.export(target)
                count += 1
        return count

    def masks(self, path: Path) -> int:
        """Write masks, head and tail as COCO JSON; returns the number of masks.

        They are in the pixels of the frame, lens distortion included. Frames without fish are
        listed too. Categories are the FAO codes of the fish, and "fish" without a code. Rejected
        fish and duplicates are left out: `train` would learn from them.
        """
        self._require_writable(path, needed_for="--masks")
        placed = {
            (fish.track_id, fish.frame_index): fish for fish in self._reviewed.of(LocalizedFish)
        }
        coco = coco_masks(
            (
                (frame.frame_index, frame.source, stored_picture(payload))
                for frame, payload in decoded_messages(self.recording, [Frame], self._selection)
                if isinstance(frame, Frame)
            ),
            (
                (crop, placed.get((crop.track_id, crop.frame_index)))
                for crop in self._reviewed.of(FishCrop)
                if crop.track_id not in self._left_out
            ),
            {fish.estimate.track_id: fish for fish in self._fish},
            video=self.header.source,
        )
        with self._writing(path):
            path.write_text(json.dumps(coco), encoding="utf-8")
        return len(coco["annotations"])

    def tables(self, out: Path, *, format: TableFormat) -> list[Path]:
        """Write lengths and frames (keypoints, one row per fish and frame) into `out`, as `run`.

        Fish that reviewers added, split or merged have their present frames. Lengths are those of
        lengths.db, if there is one: old segments of a camera may be deleted.
        """
        paths = [out / "lengths.csv", out / "frames.csv"]
        self._require_writable(*paths, *(path.with_suffix(".parquet") for path in paths))
        frames, edits = FramesTable(make_folder(out)), self._reviewed.edits
        edited, finished = self._reviewed.estimates(), list[LengthEstimate]()
        # Of edited fish, until their frame is over: threads may record places before estimates of
        # earlier frames, but estimates always in the same order.
        waiting: list[LengthEstimate] = []
        for message, _ in self._reviewed.decoded([LocalizedFish, LengthEstimate]):
            if isinstance(message, LengthEstimate):
                while waiting and waiting[0].frame_index < message.frame_index:
                    frames.write(make_record(waiting.pop(0), RecordingSettings()))
                if message.track_id in edited or message.track_id in edits.merged:
                    continue
                finished += [message] if message.is_final else []
            frames.write(make_record(message, RecordingSettings()))
            running = edited.get(message.track_id) if isinstance(message, LocalizedFish) else None
            if running is not None:
                waiting.append(running[message.frame_index])
        for estimate in waiting:
            frames.write(make_record(estimate, RecordingSettings()))
        frames.close()
        fish = [] if self._database is None else self._fish
        kept = {caught.estimate.track_id: caught.estimate for caught in fish}
        finished = [
            *(estimate for track_id, estimate in kept.items() if track_id not in edits.merged),
            *(caught for caught in finished if caught.track_id not in kept),
        ]
        flags = {caught.estimate.track_id: caught.flags for caught in fish}
        write_lengths(out / "lengths.csv", finished, flags)
        if format == "parquet":
            from pyarrow import csv, parquet

            for path in paths:
                parquet.write_table(csv.read_csv(path), path.with_suffix(".parquet"))
                path.unlink()
            paths = [path.with_suffix(".parquet") for path in paths]
        self._written += paths
        return paths

    def fish(
        self, out: Path, config: Config, *, format: TableFormat, all_columns: bool = False
    ) -> Path:
        """Write fish.csv (or .parquet): lengths as fisheries use them, verdicts, inputs.

        A .csv is without the columns that are empty throughout, unless `all_columns` asks for them.
        """
        path = out / f"fish.{format}"
        self._require_writable(path)
        checks = {} if self._database is None else last_checks(self._database)
        settings, notes = config.fisheries, species_notes(config, self.header.template)
        records = [fish_record(fish, self._template(fish), settings, checks) for fish in self._fish]
        self.notes += notes or unweighed_note(records, settings)
        with self._writing(path):
            if format == "csv":
                write_csv(path, FISH_TABLE if all_columns else used_columns(records), records)
            else:
                write_parquet(path, FISH_TABLE, records)
        return path

    def viame(self, path: Path) -> int:
        """Write boxes, outlines and the facts of each fish as VIAME CSV, for DIVE.

        Returns the number of boxes. Rejected fish and duplicates are left out.
        """
        self._require_writable(path, needed_for="--viame")
        times_ns, pictures = list[int](), dict[int, str]()
        for frame in messages_of(self.recording, Frame, self._selection):
            times_ns.append(frame.timestamp_ns)
            if is_picture(frame.source):
                pictures[frame.frame_index] = frame.source
        steps = np.diff(np.array(times_ns, np.int64))
        text, count = viame_csv(
            self._counted(),
            {fish.estimate.track_id: fish for fish in self._fish},
            self._template,
            fps=round(1e9 / float(np.median(steps)), 3) if len(steps) else None,
            pictures=pictures,
            is_part=not self._selection.is_everything,
        )
        with self._writing(path):
            path.write_text(text, encoding="utf-8")
        return count

    def mot(self, path: Path) -> int:
        """Write the boxes of the fish that count as MOTChallenge text; returns their number.

        Left and top are from the picture's corner, as `run --boxes` reads them; MOTChallenge's own
        files count them from 1.
        """
        self._require_writable(path, needed_for="--mot")
        boxes = sorted(
            (crop.frame_index, crop.track_id, *crop.bbox_xyxy_px.tolist())
            for crop, _ in self._counted()
        )
        with self._writing(path), path.open("w", encoding="utf-8") as file:
            for frame_index, track_id, x0, y0, x1, y1 in boxes:
                file.write(f"{frame_index},{track_id},{x0},{y0},{x1 - x0},{y1 - y0},1,-1,-1,-1\n")
        return len(boxes)

    def agency(self, out: Path, agency: Agency) -> list[Path]:
        """Write the tables of AGENCIES and AGENCY_TEXTS; rejected fish and doubles are left out."""
        fish = [
            (caught, template_of(caught, self._template(caught)))
            for caught in self._fish
            if caught.counts
        ]
        tables = {
            out / name: (columns, [row for entry in fish for row in rows_of(*entry)])
            for name, (columns, rows_of) in AGENCIES[agency].items()
        }
        texts = {out / name: text for name, text in AGENCY_TEXTS.get(agency, {}).items()}
        self._require_writable(*tables, *texts)
        for path, (columns, rows) in tables.items():
            with self._writing(path):
                write_csv(path, columns, rows)
        for path, text in texts.items():
            with self._writing(path):
                path.write_text(text, encoding="utf-8")
        first, (_, rows) = next(iter(tables.items()))
        if lacking := len(fish) - len(rows):
            why = "have no time in UTC, or no species where it needs one, and are left out"
            self.notes.append(f"{first.name}: {lacking} of {len(fish)} fish {why}")
        return [*tables, *texts]

    def hauls(self, out: Path) -> Path:
        """Write hauls.csv: each haul with its effort. Raises OutputError without a lengths.db."""
        path, database = out / "hauls.csv", self._database
        if database is None:
            raise OutputError(
                f"{self._path}: expected the folder of a run, which has a lengths.db; give that"
            )
        self._require_writable(path)
        efforts = read_effort(database, [fish for fish in self._fish if fish.counts])
        zeros = {facts.utc_zero_ns for facts in read_runs(database).values()}
        zero_ns = zeros.pop() if len(zeros) == 1 else None
        with self._writing(path):
            write_csv(
                path, HAUL_COLUMNS, [haul_row(effort, utc_zero_ns=zero_ns) for effort in efforts]
            )
        return path

    @cached_property
    def _fish(self) -> list[Fish]:
        return read_fish(self._path, self.recording, self._selection)

    def _template(self, fish: Fish) -> Template:
        return template_of_fish(self.recording, fish)

    @cached_property
    def _left_out(self) -> set[int]:
        """Track ids of rejected fish and of doubles."""
        return {fish.estimate.track_id for fish in self._fish if not fish.counts}

    def _require_selected(self) -> None:
        """Refuse an empty recording or selection; lengths.db may have more fish than it."""
        if self._database is None:
            require_messages(self.recording)
        if self._selection.is_everything:
            return
        track_ids = {fish.estimate.track_id for fish in self._fish}
        if not track_ids:
            require_time(self.recording, self._selection)
        if self._selection.tracks is not None:
            track_ids |= {fish.track_id for fish in self._reviewed.of(LocalizedFish)}
            require_tracks(self._selection, track_ids)

    def _require_writable(self, *paths: Path, needed_for: str = "") -> None:
        """UserError if a file may not be written, or an option needs a lost recording."""
        if needed_for:
            require_recording(self.recording, where=self._path, what=needed_for)
        require_writable(*paths, overwrite=self._overwrite, is_own=self._earlier.__contains__)
        places = (place for path in paths for place in (*reversed(path.parents), path))
        self._new += [place for place in places if not place.exists()]

    @contextmanager
    def _writing(self, path: Path) -> Generator[None]:
        make_folder(path.parent)
        with writing_to(path):
            yield
        self._written.append(path)

    def _counted(self) -> Iterator[tuple[FishCrop, LocalizedFish]]:
        """Each crop of the fish that count, with its place."""
        seen = self._localized(FishCrop)
        return (pair for pair in seen if pair[0].track_id not in self._left_out)

    def _localized(self, kind: type[Stage]) -> Iterator[tuple[Stage, LocalizedFish]]:
        """Each crop or fit with the place of its fish."""
        waiting: dict[tuple[int, int], Stage] = {}
        for message, _ in self._reviewed.decoded([kind, LocalizedFish]):
            if isinstance(message, kind):
                waiting[message.track_id, message.frame_index] = message
            elif isinstance(message, LocalizedFish):
                found = waiting.pop((message.track_id, message.frame_index), None)
                if found is not None:
                    yield found, message
