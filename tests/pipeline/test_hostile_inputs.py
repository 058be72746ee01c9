"""Inputs that never end, nest without end or fill the memory: refused in one line, and soon."""

import os
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from stream_dmr.batch.manifest import read_manifest
from stream_dmr.calibration.calibration_file import load_calibration
from stream_dmr.calibration.corners import read_grey
from stream_dmr.cli.vessel import haul
from stream_dmr.detection.box_files import load_boxes
from stream_dmr.detection.mask_folder import MaskFolder
from stream_dmr.errors import (
    AnnotationError,
    CalibrationError,
    ConfigError,
    SourceError,
    TemplateError,
    UserError,
)
from stream_dmr.evaluation.length_tables import read_truth
from stream_dmr.pipeline.config import load_config
from stream_dmr.recording.reading import open_recordings
from stream_dmr.sources.open_source import open_positions, open_source
from stream_dmr.sources.sensors_settings import SensorsSettings
from stream_dmr.sources.source import ReadFramesSettings
from stream_dmr.store.ledger import Signer, load_public_key
from stream_dmr.template.from_masks import template_from_masks
from stream_dmr.template.template_file import load_template
from stream_dmr.training.annotated_images import read_annotated_images, read_image

NESTED = {
    "brackets": "%YAML:1.0\n---\ncamera_matrix: " + "[" * 100_000,
    "braces": "%YAML:1.0\n---\ncamera_matrix: " + "{" * 100_000,
    "dashes": "%YAML:1.0\n---\ncamera_matrix:\n   " + "- " * 100_000,
    "indentation": "%YAML:1.0\n---\n" + "".join(" " * n + "a:\n" for n in range(1200)),
}


@pytest.mark.parametrize("nested", NESTED)
def test_a_calibration_that_is_nested_deep_is_refused(tmp_path: Path, nested: str):
    path = tmp_path / "calibration.yaml"
    path.write_text(NESTED[nested])
    with pytest.raises(CalibrationError, match="nested deeper"):
        load_calibration(path)


ENDLESS: dict[str, tuple[Callable[[Path], object], type[UserError]]] = {
    "calibration": (load_calibration, CalibrationError),
    "config": (load_config, ConfigError),
}


@pytest.fixture
def large_file(tmp_path: Path) -> Path:
    """A sparse file of 2 GB, which takes no room on the disk."""
    path = tmp_path / "large"
    path.touch()
    os.truncate(path, 2 * 10**9)
    return path


def read_mask(path: Path) -> object:
    (path.parent / "000001.png").symlink_to(path)
    return MaskFolder(path.parent).labels(1, width=8, height=8)


def read_coco(path: Path) -> object:
    cv2.imwrite(str(path.with_name("1.jpg")), np.zeros((48, 64, 3), np.uint8))
    (coco := path.with_suffix(".json")).symlink_to(path)
    return list(read_annotated_images(path.parent, coco))


def read_positions(path: Path) -> object:
    return open_positions(str(path), SensorsSettings(), is_since_1970=False)


READERS: dict[str, Callable[[Path], object]] = {
    "calibration": load_calibration,
    "config": load_config,
    "boxes": load_boxes,
    "manifest": lambda path: read_manifest(path, config=None, template="cod"),
    "truth": read_truth,
    "public key": load_public_key,
    "private key": Signer,
    "board": read_grey,
    "image": read_image,
    "mask": read_mask,
    "mask of a template": lambda path: template_from_masks(path, thickness=0.5, name="fish"),
    "COCO": read_coco,
    "video": lambda path: open_source(str(path), ReadFramesSettings()),
    "positions": read_positions,
    "recording": lambda path: open_recordings([path]),
    "token": lambda path: haul("start", "http://127.0.0.1:1/", token_file=path),
}


@pytest.mark.parametrize("kind", READERS)
@pytest.mark.parametrize("device", ["/dev/zero", "a pipe"])
def test_pipes_and_devices_are_refused(tmp_path: Path, kind: str, device: str):
    path = tmp_path / "given"
    if device == "a pipe":
        os.mkfifo(path)
    else:
        path.symlink_to(device)
    with pytest.raises(UserError):
        READERS[kind](path)


@pytest.mark.parametrize("kind", ENDLESS)
def test_a_file_that_is_too_large_is_refused(kind: str, large_file: Path):
    load, error = ENDLESS[kind]
    with pytest.raises(error, match="more than 1000 kB"):
        load(large_file)


def test_a_template_beside_an_endless_toml_is_refused(tmp_path: Path):
    (tmp_path / "fish.ply").write_bytes(b"ply")
    (tmp_path / "fish.toml").symlink_to("/dev/zero")
    with pytest.raises(TemplateError):
        load_template(str(tmp_path / "fish.ply"))


def test_boxes_that_never_end_are_refused(monkeypatch: pytest.MonkeyPatch, large_file: Path):
    monkeypatch.setattr("stream_dmr.detection.box_files._MAX_BYTES", 10**6)
    with pytest.raises(UserError, match="a pipe or a device"):
        load_boxes(Path("/dev/zero"))
    with pytest.raises(UserError, match="more than 1000 kB"):
        load_boxes(large_file)


def huge_png(path: Path) -> Path:
    """The header of a picture of 30000 by 30000 pixels, and hardly any data."""
    header = struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(b"")), (b"IEND", b"")]
    data = b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in chunks
    )
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + data)
    return path


def test_a_huge_picture_is_refused_by_its_header(tmp_path: Path):
    picture = huge_png(tmp_path / "1.png")
    with pytest.raises(SourceError, match="150 megapixels or less"):
        open_source(str(tmp_path), ReadFramesSettings())
    with pytest.raises(CalibrationError, match="too large"):
        read_grey(picture)
    with pytest.raises(AnnotationError, match="150 megapixels or less"):
        read_image(picture)
    with pytest.raises(TemplateError, match="150 megapixels or less"):
        template_from_masks(picture, thickness=0.5, name="huge")


def test_a_huge_mask_is_refused_before_training_reads_it(tmp_path: Path):
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "1.jpg"), np.zeros((48, 64, 3), np.uint8))
    huge_png(tmp_path / "masks" / "1.png")
    with pytest.raises(AnnotationError, match=r"masks/1\.png.*150 megapixels or less"):
        list(read_annotated_images(tmp_path, tmp_path / "masks"))


TWO_SIGNALS = """
import signal
import threading
from stream_dmr.cli.shared_options import stop_on_signals

enter, sent = threading.Condition.__enter__, []

def interrupted(condition):
    result = enter(condition)
    if not sent and threading.get_ident() == threading.main_thread().ident:
        sent.append(signal.raise_signal(signal.SIGTERM))
    return result

with stop_on_signals() as stop:
    threading.Condition.__enter__ = interrupted
    signal.raise_signal(signal.SIGINT)
    assert stop.wait(10)
    assert stop.signal_number == signal.SIGINT
"""


def test_two_signals_at_once_do_not_wait_for_each_other():
    done = subprocess.run(
        [sys.executable, "-c", TWO_SIGNALS], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
