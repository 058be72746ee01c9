"""Exports recordings as meshes, COCO masks and tables."""

import json
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import trimesh

from stream_dmr.errors import OutputError
from stream_dmr.evidence.own_files import require_writable
from stream_dmr.evidence.seal import known_files, read_origin, seal_files
from stream_dmr.export.agency_tables import (
    HAUL_COLUMNS,
    RDBES_COLUMNS,
    WCPFC_COLUMNS,
    haul_row,
    rdbes_row,
    wcpfc_row,
    write_rows,
)
from stream_dmr.export.coco_masks import coco_masks, mask_in_frame
from stream_dmr.export.export_choices import Agency, MeshFormat, TableFormat
from stream_dmr.export.fish_table import fish_records, unweighed_note, write_csv, write_parquet
from stream_dmr.export.viame_csv import ViameTracks
from stream_dmr.files import make_folder, writing_to
from stream_dmr.messages import FishCrop, FittedMesh, Frame, LengthEstimate, LocalizedFish, Message
from stream_dmr.recording.codec import stored_picture
from stream_dmr.recording.reading import (
    decoded_messages,
    known_shapes,
    messages_of,
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
from stream_dmr.store.fisheries import FisheriesSettings
from stream_dmr.store.open_results import open_results, require_recording
from stream_dmr.store.run_facts import run_facts
from stream_dmr.store.run_tables import FramesTable, write_lengths
from stream_dmr.template.template import Template


class Export:
    """A recording, or a part of it, for other programs. Raises a UserError."""

    def __init__(
        self, recording: Path, selection: Selection = EVERYTHING, *, overwrite: bool = False
    ) -> None:
        """With `overwrite`, existing files are replaced, except for those of a run."""
        self._path = recording
        self._database = database_of(recording)
        self._recording = open_results(recording)
        self._selection = selection
        self._reviewed = ReviewedMessages(self._recording, self._database, selection)
        self._written: list[Path] = []
        self._overwrite = overwrite
        self._earlier: set[Path] = set()  # exported before from the same recording
        self._new: list[Path] = []  # files and folders that were not there, and no provenance knows
        self.notes: list[str] = []  # what is missing in the exports so far, one line each
        self._require_selected()

    @property
    def config_toml(self) -> str:
        return self._recording.header.config_toml

    @property
    def template(self) -> Template:
        return self._recording.header.template

    @property
    def warnings(self) -> Sequence[str]:
        """What is lost of the recording, one line each."""
        return self._recording.warnings

    def meshes(self, out: Path, *, format: MeshFormat) -> int:
        """Write `fish-ID/FRAME.ply` (or .glb) into `out`; returns their number.

        Vertices are in the camera frame, in mm; without a calibration a fish is one body length
        long.
        """
        self._require_recording("--meshes")
        template = self.template
        restored, count = MeshRebuilder(template, known_shapes(self._recording)), 0
        for fit, fish in _pairs(self._messages(FittedMesh, LocalizedFish)):
            shape = restored.with_vertices(fit).shape
            vertices = None if shape is None else place_fit(shape, fish)[0]
            if vertices is None:
                continue
            folder = out / f"fish-{fit.track_id}"
            mesh = trimesh.Trimesh(vertices, template.faces, process=False)
            target = folder / f"{fit.frame_index:06d}.{format}"
            self._require_writable(target)
            with writing_to(make_folder(folder)):
                mesh.export(target)
            self._written.append(target)
            count += 1
        return count

    def masks(self, path: Path) -> int:
        """Write the masks as COCO JSON with run lengths; returns their number.

        They are in the pixels of the frame, lens distortion included. Frames without fish are
        listed too. Categories are the FAO codes of the fish, and "fish" where there is none.
        Rejected fish and doubles are left out: `train` would learn from them.
        """
        self._require_recording("--masks")
        self._require_writable(path)
        left_out = self._left_out()
        frames = decoded_messages(self._recording, [Frame], self._selection)
        coco = coco_masks(
            (
                (frame.frame_index, frame.source, stored_picture(payload))
                for frame, payload in frames
                if isinstance(frame, Frame)
            ),
            (
                crop
                for crop in self._messages(FishCrop)
                if isinstance(crop, FishCrop) and crop.track_id not in left_out
            ),
            {one.estimate.track_id: one.sure_code for one in self._all_fish() if one.counts},
        )
        self._write_text(path, json.dumps(coco))
        return len(coco["annotations"])

    def tables(self, out: Path, *, format: TableFormat) -> list[Path]:
        """Write lengths and frames (keypoints, one row per fish and frame) into `out`, as `run`.

        Fish that reviewers added, split or merged have the frames that they have since. Lengths
        are those of lengths.db, where there is one: of a camera, old segments may be deleted.
        """
        paths = [out / "lengths.csv", out / "frames.csv"]
        self._require_writable(*paths, *(path.with_suffix(".parquet") for path in paths))
        frames, edits = FramesTable(make_folder(out)), self._reviewed.edits
        edited, finished = self._reviewed.estimates(), list[LengthEstimate]()
        for message in self._messages(LocalizedFish, LengthEstimate):
            if isinstance(message, LengthEstimate):
                if message.track_id in edited or message.track_id in edits.merged:
                    continue
                finished += [message] if message.is_final else []
            frames.write(make_record(message, RecordingSettings()))
            running = edited.get(message.track_id) if isinstance(message, LocalizedFish) else None
            if running is not None:
                frames.write(make_record(running[message.frame_index], RecordingSettings()))
        frames.close()
        fish = [] if self._database is None else self._all_fish()
        kept = {one.estimate.track_id: one.estimate for one in fish}
        finished = [
            *(estimate for track_id, estimate in kept.items() if track_id not in edits.merged),
            *(one for one in finished if one.track_id not in kept),
        ]
        doubtful = {one.estimate.track_id for one in fish if one.may_count_twice}
        write_lengths(out / "lengths.csv", finished, may_count_twice=doubtful)
        paths = paths if format == "csv" else [_as_parquet(path) for path in paths]
        self._written += paths
        return paths

    def fish(self, out: Path, settings: FisheriesSettings, *, format: TableFormat) -> Path:
        """Write fish.csv (or .parquet): lengths as fisheries use them, verdicts, inputs."""
        self._require_writable(out / f"fish.{format}")
        fish = self._all_fish()
        records = fish_records(fish, self.template, settings, database=self._database)
        self.notes += unweighed_note(records, settings)
        write = write_csv if format == "csv" else write_parquet
        path = write(make_folder(out) / "fish", records)
        self._written.append(path)
        return path

    def viame(self, path: Path) -> int:
        """Write boxes, outlines, ends and lengths as VIAME CSV, for DIVE; returns their number.

        Rejected fish and doubles are left out.
        """
        self._require_recording("--viame")
        self._require_writable(path)
        left_out = self._left_out()
        tracks = ViameTracks(self._all_fish(), fps=self._fps())
        crops: dict[tuple[int, int], FishCrop] = {}
        for message in self._messages(FishCrop, LocalizedFish):
            if isinstance(message, FishCrop):
                crops[message.track_id, message.frame_index] = message
            elif isinstance(message, LocalizedFish):
                crop = crops.pop((message.track_id, message.frame_index), None)
                if crop is not None and message.track_id not in left_out:
                    tracks.add(
                        track_id=message.track_id,
                        frame_index=message.frame_index,
                        timestamp_ns=message.timestamp_ns,
                        bbox_xyxy_px=crop.bbox_xyxy_px,
                        mask=mask_in_frame(crop),
                        keypoints_px=message.keypoints_px,
                    )
        self._write_text(path, tracks.text())
        return tracks.count

    def agency(self, out: Path, agency: Agency) -> Path:
        """Write the fish as wcpfc.csv or rdbes.csv; rejected ones and doubles are left out."""
        path = out / f"{agency}.csv"
        self._require_writable(path)
        make, columns = (
            (wcpfc_row, WCPFC_COLUMNS) if agency is Agency.WCPFC else (rdbes_row, RDBES_COLUMNS)
        )
        rows = [make(one, self.template) for one in self._all_fish() if one.counts]
        self._written.append(write_rows(make_folder(out) / path.name, columns, rows))
        return path

    def hauls(self, out: Path) -> Path:
        """Write hauls.csv: each haul with its effort. Raises OutputError without a lengths.db."""
        path, database = out / "hauls.csv", self._database
        if database is None:
            raise OutputError(
                f"{self._path}: expected the folder of a run, which has a lengths.db; give that"
            )
        self._require_writable(path)
        efforts = read_effort(database, [one for one in self._all_fish() if one.counts])
        zeros = {facts.utc_zero_ns for facts in read_runs(database).values()}
        zero_ns = zeros.pop() if len(zeros) == 1 else None
        rows = [haul_row(one, utc_zero_ns=zero_ns) for one in efforts]
        self._written.append(write_rows(make_folder(out) / path.name, HAUL_COLUMNS, rows))
        return path

    def _require_recording(self, what: str) -> None:
        require_recording(self._recording, where=self._path, what=what)

    def _require_selected(self) -> None:
        """Refuse a recording or a selection of nothing; lengths.db may know more fish than it."""
        if self._database is None:
            require_messages(self._recording)
        if self._selection.is_everything:
            return
        fish = {one.estimate.track_id for one in self._all_fish()}
        if not fish:
            require_time(self._recording, self._selection)
        if self._selection.tracks is not None:
            fish |= {getattr(one, "track_id", 0) for one in self._messages(LocalizedFish)}
            require_tracks(self._selection, fish)

    def _fps(self) -> float | None:
        """Frames per second, by the median time between frames; None of fewer than two."""
        frames = messages_of(self._recording, Frame, self._selection)
        steps = np.diff(np.array([frame.timestamp_ns for frame in frames], np.int64))
        return round(1e9 / float(np.median(steps)), 3) if len(steps) else None

    def _all_fish(self) -> list[Fish]:
        return read_fish(self._path, self._recording, self._selection)

    def _left_out(self) -> set[int]:
        """Track ids of rejected fish and of doubles."""
        return {one.estimate.track_id for one in self._all_fish() if not one.counts}

    def _write_text(self, path: Path, text: str) -> None:
        make_folder(path.parent)
        with writing_to(path):
            path.write_text(text, encoding="utf-8")
        self._written.append(path)

    def claim(self, out: Path) -> None:
        """Raise OutputError where `out` holds exports of another recording."""
        origin = read_origin(out)
        if origin is not None and origin.resolve() != self._path.resolve():
            raise OutputError(
                f"{out}: expected a folder for exports of {self._path}, found exports of "
                f"{origin}; choose another --out"
            )
        self._earlier = {out / name for name in known_files(out)}

    def provenance(self, out: Path) -> Path:
        """Write provenance.json: the inputs and checksums of all files written into `out`."""
        if self._database is None:
            runs = {"": run_facts(self._recording.header)}
        else:
            runs = read_runs(self._database)
        sealed = seal_files(out, self._written, runs=runs, origin=str(self._path))
        self._new.clear()
        return sealed

    @contextmanager
    def kept_if_sealed(self) -> Generator[None]:
        """Remove what the block wrote where it ends before `provenance`: by an error or a signal.

        So the same command can be given again. Files that were replaced stay as they are then.
        """
        try:
            yield
        except BaseException:
            for path in reversed(self._new):
                with suppress(OSError):
                    path.rmdir() if path.is_dir() else path.unlink()
            raise

    def _require_writable(self, *paths: Path) -> None:
        require_writable(*paths, overwrite=self._overwrite, is_own=self._earlier.__contains__)
        places = (place for path in paths for place in (*reversed(path.parents), path))
        self._new += [place for place in places if not place.exists()]

    def _messages(self, *kinds: type[Message]) -> Iterator[Message]:
        yield from self._reviewed.of(kinds)


def _pairs(messages: Iterable[Message]) -> Iterator[tuple[FittedMesh, LocalizedFish]]:
    waiting: dict[tuple[int, int], FittedMesh] = {}
    for message in messages:
        if isinstance(message, FittedMesh):
            waiting[message.track_id, message.frame_index] = message
        elif isinstance(message, LocalizedFish):
            fit = waiting.pop((message.track_id, message.frame_index), None)
            if fit is not None:
                yield fit, message


def _as_parquet(table: Path) -> Path:
    from pyarrow import csv, parquet

    path = table.with_suffix(".parquet")
    parquet.write_table(csv.read_csv(table), path)
    table.unlink()
    return path
