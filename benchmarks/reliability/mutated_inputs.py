"""Mutated inputs: each is read or refused in one line, soon, and nothing is written elsewhere."""

import json
import os
import random
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import get_args

import numpy as np

from benchmarks.reliability.mutations import (
    Mutate,
    by_box,
    by_byte,
    by_chunk,
    by_line,
    by_node,
    by_record,
    by_sentence,
    of_header,
)
from benchmarks.reliability.rtsp_session import playing, write_session
from stream_dmr.calibration.calibration_file import load_calibration
from stream_dmr.detection.given_fish import open_annotated_fish
from stream_dmr.errors import UserError
from stream_dmr.export.exporter import Export
from stream_dmr.messages import Frame, Message
from stream_dmr.pipeline.config import load_config
from stream_dmr.recording.codec import decode
from stream_dmr.recording.reading import open_recordings
from stream_dmr.recording.rerun.viewer import convert
from stream_dmr.simulation import DEMO_SCENE
from stream_dmr.sources.open_source import open_positions, open_source
from stream_dmr.sources.position_readers import LineSplitter
from stream_dmr.sources.positions import FixBuilder
from stream_dmr.sources.sensors_settings import SensorsSettings
from stream_dmr.sources.source import ReadFramesSettings
from stream_dmr.template.template_file import load_template
from tests.support.nmea import straight_way

_SLOW_S = 10.0


@dataclass(frozen=True, kw_only=True)
class Input:
    """A kind of input: an original, how it is read, and its share of all mutants."""

    name: str
    original: Path
    read: Callable[[Path], object]
    mutate: tuple[Mutate, ...]  # in turn
    share: float
    beside: tuple[Path, ...] = ()  # what has to lie there too, under the mutant's name


def inputs(folder: Path, root: Path) -> list[Input]:
    """All kinds; those that have no original in the repository are made from one that it has."""
    clip, golden = DEMO_SCENE, root / "recordings" / "golden" / "recording.mcap"
    made = folder / "originals"
    made.mkdir(parents=True)
    write_coco(clip / "boxes.txt", made / "coco.json")
    write_cvat(clip / "boxes.txt", made / "cvat.xml")
    convert(golden, made / "golden.rrd")
    write_session(made / "rail.rtsp")
    (made / "way.nmea").write_text(straight_way(60))
    text, species = (by_byte, by_line), (clip / "species.ply", clip / "species.toml")
    mask = next(path for path in sorted((clip / "masks").glob("*.png")) if path.stat().st_size)
    return [
        Input(name="boxes", original=clip / "boxes.txt", read=read_boxes, mutate=text, share=0.11),
        Input(
            **{"name": "boxes, COCO", "original": made / "coco.json", "read": read_boxes},
            **{"mutate": (by_byte, by_node), "share": 0.12},
        ),
        Input(
            **{"name": "boxes, CVAT", "original": made / "cvat.xml", "read": read_boxes},
            **{"mutate": text, "share": 0.10},
        ),
        Input(
            **{"name": "masks", "original": mask, "read": read_masks},
            **{"mutate": (by_byte, by_chunk), "share": 0.10},
        ),
        Input(
            **{"name": "calibration", "original": clip / "calibration.yaml"},
            **{"read": load_calibration, "mutate": text, "share": 0.14},
        ),
        Input(
            **{"name": "config", "original": root / "config.toml", "read": load_config},
            **{"mutate": text, "share": 0.11},
        ),
        Input(
            **{"name": "positions, NMEA", "original": made / "way.nmea", "read": read_positions},
            **{"mutate": (by_byte, by_sentence), "share": 0.06},
        ),
        Input(
            **{"name": "template TOML", "original": species[1], "read": read_template},
            **{"mutate": text, "share": 0.10, "beside": species[:1]},
        ),
        Input(
            **{"name": "template mesh", "original": species[0], "read": read_template},
            **{"mutate": (by_byte, of_header), "share": 0.05, "beside": species[1:]},
        ),
        Input(
            **{"name": "mcap", "original": golden, "read": read_and_export},
            **{"mutate": (by_byte, by_record), "share": 0.06},
        ),
        Input(
            **{"name": "rrd", "original": made / "golden.rrd", "read": read_messages},
            **{"mutate": (by_byte,), "share": 0.01},
        ),
        Input(
            **{"name": "video", "original": clip / "video.mp4", "read": read_video},
            **{"mutate": (by_byte, by_box), "share": 0.03},
        ),
        Input(
            **{"name": "RTSP session", "original": made / "rail.rtsp", "read": read_stream},
            **{"mutate": (by_byte,), "share": 0.01},
        ),
    ]


def mutate_inputs(
    folder: Path, root: Path, *, count: int, seed: int = 0
) -> Iterator[dict[str, object]]:
    """`count` mutants in all; a row a kind of input."""
    kinds = inputs(folder, root)
    sandbox = folder / "sandbox"
    (sandbox / "out").mkdir(parents=True)
    os.chdir(sandbox)  # so that no relative path leads to anything of ours
    for kind in kinds:
        yield _mutate_one(folder, kind, max(2, round(count * kind.share)), seed)


def _mutate_one(folder: Path, kind: Input, count: int, seed: int) -> dict[str, object]:
    rng, original = random.Random(f"{seed} {kind.name}"), kind.original.read_bytes()
    place = folder / "in"
    place.mkdir(exist_ok=True)
    mutant = place / f"mutant{kind.original.suffix}"
    for path in kind.beside:
        shutil.copy(path, mutant.with_suffix(path.suffix))
    mutant.write_bytes(original)
    kind.read(mutant)  # else all that follows would be refused, and show nothing
    before = names_and_sizes(folder)
    refused, broken, slowest_s = 0, [], 0.0
    for number in range(count):
        mutate = kind.mutate[number % len(kind.mutate)]
        data = mutate(original, rng)
        mutant.write_bytes(data)
        began = time.monotonic()
        said = outcome(kind, mutant)
        slowest_s = max(slowest_s, time.monotonic() - began)
        refused += said == "refused"
        if said not in ("refused", "read"):
            broken.append(f"{mutate.__name__}: {said}")
            (folder / f"broken-{kind.name.replace(' ', '-')}-{len(broken)}").write_bytes(data)
            before = names_and_sizes(folder)
    return {
        "input": kind.name,
        "mutants": count,
        "refused": refused,
        "broken": len(broken),
        "kinds": sorted({line[:150] for line in broken})[:6],
        "slowest s": round(slowest_s, 2),
        "too slow": slowest_s > _SLOW_S,
        "paths written elsewhere": sorted(names_and_sizes(folder) ^ before)[:5],
    }


def outcome(kind: Input, mutant: Path) -> str:
    """`read`, `refused`, or what went wrong."""
    signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(round(3 * _SLOW_S))
    try:
        with redirect_stderr(StringIO()) as said:
            kind.read(mutant)
    except UserError as error:
        return "refused" if "\n" not in str(error) else f"two lines: {error}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    finally:
        signal.alarm(0)
    return "read" if not said.getvalue() else f"on stderr: {said.getvalue()}"


def _too_long(*_: object) -> None:
    raise TimeoutError("it hung")


def names_and_sizes(folder: Path) -> set[tuple[str, int]]:
    """Of all files below a folder, but for the mutant and what is written into the output."""
    return {
        (path.relative_to(folder).as_posix(), path.stat().st_size)
        for path in folder.rglob("*")
        if path.is_file() and not path.is_relative_to(folder / "in")
        if not path.is_relative_to(folder / "sandbox" / "out")
    }


def read_boxes(path: Path) -> None:
    """All of them, on a frame."""
    picture = np.zeros((960, 1280, 3), np.uint8)
    found = open_annotated_fish(boxes=path, masks=None)
    for index in range(1, 8):
        found.detect(Frame(frame_index=index, timestamp_ns=index, image=picture, source="x"))


def read_masks(path: Path) -> None:
    """The mask of a first frame."""
    folder = path.parent / "masks"
    folder.mkdir(exist_ok=True)
    shutil.copy(path, folder / "000001.png")
    picture = np.zeros((960, 1280, 3), np.uint8)
    frame = Frame(frame_index=1, timestamp_ns=0, image=picture, source="x")
    open_annotated_fish(boxes=None, masks=folder).detect(frame)


def read_template(path: Path) -> None:
    """A mesh and the TOML beside it."""
    load_template(str(path.with_suffix(".ply")))


def read_positions(path: Path) -> None:
    """All of a file, and the same bytes as a receiver sends them."""
    settings = SensorsSettings(start_utc="2026-11-22T06:00:00Z")
    builder, splitter = FixBuilder(settings, now_ns=time.time_ns), LineSplitter()
    data = path.read_bytes()
    for start in range(0, len(data), 100):
        for line in splitter.lines(data[start : start + 100]):
            builder.take(line, arrival_ns=time.monotonic_ns())
    source = open_positions(str(path), settings, is_since_1970=False)
    try:
        found = [*source.take(frame_at(10**9)), *source.take(frame_at(10**18)), *source.finish()]
    finally:
        source.close()
    for one in found:
        assert abs(one.latitude) <= 90
        assert abs(one.longitude) <= 180


def frame_at(timestamp_ns: int) -> Frame:
    """A small one."""
    picture = np.zeros((1, 1, 3), np.uint8)
    return Frame(frame_index=1, timestamp_ns=timestamp_ns, image=picture, source="x")


def read_video(path: Path) -> None:
    """Every frame of it."""
    source = open_source(str(path), ReadFramesSettings(silence_s=5.0))
    try:
        for frame in source:
            assert -(2**63) <= frame.timestamp_ns < 2**63
    finally:
        source.close()


def read_stream(path: Path) -> None:
    """The frames that come within a second, over one connection or several."""
    with playing(path) as address:
        source = open_source(address, ReadFramesSettings(connect_s=2.0, silence_s=1.0))
        threading.Timer(1.0, source.close).start()
        for frame in source:
            assert 0 <= frame.timestamp_ns < 2**63


def read_messages(path: Path) -> None:
    """Every message of a recording."""
    for kind, payload in open_recordings([path]).payloads(get_args(Message)):
        decode(kind, payload)


def read_and_export(path: Path) -> None:
    """Every message of a recording, and all that can be made of it."""
    read_messages(path)
    out = Path("out")
    shutil.rmtree(out, ignore_errors=True)  # no export writes over another's files
    export = Export(path)
    export.tables(out, format="csv")
    export.masks(out / "masks.json")
    export.meshes(out / "meshes", format="ply")


def write_coco(boxes: Path, coco: Path) -> None:
    """The same boxes as COCO's JSON."""
    rows = [[float(cell) for cell in line.split(",")] for line in boxes.read_text().splitlines()]
    frames = sorted({int(row[0]) for row in rows})
    images = [{"id": k, "file_name": f"{k:06d}.png"} for k in frames]
    annotations = [
        {"id": k, "image_id": int(row[0]), "track_id": int(row[1]), "bbox": row[2:6]}
        for k, row in enumerate(rows, start=1)
    ]
    coco.write_text(json.dumps({"images": images, "annotations": annotations}))


def write_cvat(boxes: Path, cvat: Path) -> None:
    """The same boxes as CVAT's XML."""
    lines = ["<annotations>"]
    rows = [[float(cell) for cell in line.split(",")] for line in boxes.read_text().splitlines()]
    for track in sorted({int(row[1]) for row in rows}):
        lines.append(f'<track id="{track - 1}" label="fish">')
        for frame, _, x, y, w, h, *_ in (row for row in rows if row[1] == track):
            corners = f'xtl="{x}" ytl="{y}" xbr="{x + w}" ybr="{y + h}"'
            lines.append(f'<box frame="{int(frame) - 1}" outside="0" {corners}></box>')
        lines.append("</track>")
    cvat.write_text("\n".join([*lines, "</annotations>"]))
