"""Mutated inputs: each is read or refused in one line, soon, and nothing is written."""

import random
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import get_args

from stream_dmr.calibration import load_calibration
from stream_dmr.config import load_config
from stream_dmr.errors import UserError
from stream_dmr.messages import Message
from stream_dmr.read_settings import ReadFramesSettings
from stream_dmr.recording.codec import decode
from stream_dmr.recording.opened import open_recordings
from stream_dmr.segmentation.detections import open_annotations
from stream_dmr.template import load_template
from stream_dmr.video import open_source

_SLOW_S = 10.0
_WORDS = [b"nan", b"-1", b"1e308", b"0", b"\x00", b"\xff\xff\xff\xff", b"[[", b"../../x", b"%"]


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Some bytes flipped, cut, doubled, or replaced by words that parsers stumble over."""
    mutant = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 6))):
        at = rng.randrange(len(mutant) + 1)
        match rng.randrange(5):
            case 0 if at < len(mutant):
                mutant[at] ^= 1 << rng.randrange(8)
            case 1:
                del mutant[at : at + rng.randint(1, 64)]
            case 2:
                mutant[at:at] = rng.choice(_WORDS)
            case 3:
                mutant[at:at] = mutant[at : at + rng.randint(1, 64)]
            case _:
                mutant = mutant[: max(1, at)]
    return bytes(mutant)


def read_video(path: Path) -> None:
    """Every frame of it."""
    source = open_source(str(path), ReadFramesSettings(silence_s=5.0))
    try:
        for frame in source:
            assert -(2**63) <= frame.timestamp_ns < 2**63
    finally:
        source.close()


def read_mcap(path: Path) -> None:
    """Every message of it."""
    for kind, payload in open_recordings([path]).payloads(get_args(Message)):
        decode(kind, payload)


def fuzz(folder: Path, clip: Path, recording: Path, *, count: int, seed: int = 0) -> list[dict]:
    """`count` mutants of each input, a twentieth as many of the slow ones; a row a kind."""
    readers: list[tuple[str, Path, Callable[[Path], object], int]] = [
        ("boxes", clip / "boxes.txt", lambda p: open_annotations(boxes=p, masks=None), count),
        ("calibration", clip / "calibration.yaml", load_calibration, count),
        ("config", Path("config.toml"), load_config, count),
        ("template TOML", clip / "species.toml", _template_beside(clip), count // 5),
        ("template mesh", clip / "species.ply", _template, count // 5),
        ("mcap", recording, read_mcap, count // 20),
        ("video", clip / "video.mp4", read_video, count // 20),
    ]
    folder.mkdir(parents=True)
    return [_fuzz_one(folder, *reader, seed=seed) for reader in readers]


def _template(path: Path) -> object:
    return load_template(str(path))


def _template_beside(clip: Path) -> Callable[[Path], object]:
    def read(path: Path) -> object:
        shutil.copy(clip / "species.ply", path.with_suffix(".ply"))
        return load_template(str(path.with_suffix(".ply")))

    return read


def _fuzz_one(
    folder: Path, name: str, path: Path, read: Callable[[Path], object], count: int, *, seed: int
) -> dict:
    rng, original = random.Random(f"{seed} {name}"), path.read_bytes()
    mutant = folder / f"mutant{path.suffix}"
    if path.suffix == ".ply":
        shutil.copy(path.with_suffix(".toml"), mutant.with_suffix(".toml"))
    refused, broken, slowest_s = 0, [], 0.0
    mutant.write_bytes(original)
    read(mutant)  # else all that follows would be refused, and show nothing
    for _ in range(count):
        data = mutated(original, rng)
        mutant.write_bytes(data)
        began = time.monotonic()
        try:
            read(mutant)
        except UserError as error:
            refused += 1
            if "\n" in str(error):
                broken.append(f"two lines: {error}")
        except Exception as error:
            broken.append(f"{type(error).__name__}: {error}")
            (folder / f"broken-{name.replace(' ', '-')}-{len(broken)}").write_bytes(data)
        slowest_s = max(slowest_s, time.monotonic() - began)
    return {
        "input": name,
        "mutants": count,
        "refused": refused,
        "broken": len(broken),
        "first": broken[0][:160] if broken else "",
        "slowest s": round(slowest_s, 2),
        "too slow": slowest_s > _SLOW_S,
    }
