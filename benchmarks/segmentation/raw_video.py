"""The whole chain on the video alone: fish counted, masks, lengths.

    python -m benchmarks.segmentation.raw_video [SCENE...]        a row a scene; --sheet masks.png
    python -m benchmarks.segmentation.raw_video --simulate 6      scenes of our own, every preset

A scene is a folder as `stream-dmr simulate` writes it. Its boxes and masks are used to compare
with, and by a second run that shows what lengths true masks would give; the first run sees the
video alone. Mask IoU is of crops: the mask found against the true one through the same crop camera.
"""

import argparse
import tempfile
import threading
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool

from benchmarks.segmentation.mask_accuracy import iou, write_sheet
from stream_dmr.calibration.calibration_file import load_calibration
from stream_dmr.detection.mask_folder import MaskFolder
from stream_dmr.evaluation.length_tables import read_truth
from stream_dmr.messages import FishCrop, LengthEstimate, Message
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.nodes.read_frames import ReadFrames
from stream_dmr.pipeline.chain import Chain
from stream_dmr.pipeline.config import load_config
from stream_dmr.pipeline.session import Session, Setup
from stream_dmr.segmentation.crop_geometry import frame_from_crop_map
from stream_dmr.simulation.rail_scene import PRESETS
from stream_dmr.simulation.write_scene import simulate
from stream_dmr.template.template_file import load_template
from stream_dmr.tracking.finder import open_finder


class ChainResult(NamedTuple):
    """One run of the chain."""

    crops: list[FishCrop]
    lengths: list[LengthEstimate]


class Row(NamedTuple):
    """One scene: what was found against what is true."""

    name: str
    num_fish: int
    counted: int
    iou: float  # mean over all crops
    error: float  # mean absolute error of the lengths, as a fraction
    error_given: float  # the same with true masks
    measured: int  # fish that got a length


def measure(scene: Path, arguments: argparse.Namespace) -> Row:
    """Run a scene twice, from the video alone and with its masks, and compare."""
    truth = read_truth(scene / "truth.csv")
    folder = scene if (scene / "species.ply").exists() else scene.parent
    template = arguments.template or str(folder / "species.ply")
    raw = chain(scene, arguments.config, template, given=False)
    given = chain(scene, arguments.config, template, given=True)
    pairs, names = _against_masks(raw.crops, MaskFolder(scene / "masks"))
    ious = np.array([iou(crop.mask, true) for crop, true in pairs])
    if arguments.sheet:
        write_sheet(pairs, ious, arguments.sheet.with_stem(f"{arguments.sheet.stem}-{scene.name}"))
    errors = _errors(raw.lengths, truth, names)
    return Row(
        name=scene.name,
        num_fish=len(truth),
        counted=len({length.track_id for length in raw.lengths}),
        iou=float(ious.mean()) if len(ious) else float("nan"),
        error=float(np.mean(errors)) if errors else float("nan"),
        error_given=float(np.mean(_errors(given.lengths, truth, {i: i for i in truth}))),
        measured=len(errors),
    )


def chain(scene: Path, path: Path | None, template: str, *, given: bool) -> ChainResult:
    """The nodes as `run` assembles them, without a recording."""
    config = load_config(path)
    calibration = load_calibration(scene / "calibration.yaml")
    finder = open_finder(
        boxes=scene / "boxes.txt" if given else None,
        masks=scene / "masks" if given else None,
        detect=config.detect_fish,
        track=config.track_fish,
    )
    crop_fish = CropFish(config.crop_fish, camera=calibration.camera, finder=finder)
    later = Session(
        Setup(config=config, template=load_template(template), calibration=calibration)
    ).nodes
    ran = ChainResult([], [])

    def note(message: Message) -> Message:
        if isinstance(message, FishCrop):
            ran.crops.append(message)
        elif isinstance(message, LengthEstimate) and message.is_final:
            ran.lengths.append(message)
        return message

    reader = ReadFrames(str(scene / "video.mp4"), config.read_frames)
    stop = threading.Event()
    Chain(reader, [crop_fish, *later], on_message=note, stop=stop).run()
    reader.close()
    return ran


def _against_masks(
    crops: Iterable[FishCrop], masks: MaskFolder
) -> tuple[list[tuple[FishCrop, Bool[np.ndarray, "S S"]]], dict[int, int]]:
    """Every crop with its true mask, and which true fish each found one mostly is (0: none)."""
    pairs, votes = [], {}
    for crop in crops:
        camera = crop.frame_camera
        labels = masks.labels(crop.frame_index, width=camera.width, height=camera.height)
        if labels is None:
            continue
        x, y = frame_from_crop_map(crop.crop_camera, frame_camera=camera)
        seen = cv2.remap(labels.ids.astype(np.uint16), x, y, cv2.INTER_NEAREST)
        ids = Counter(seen[crop.mask & (seen > 0)].tolist())
        name = ids.most_common(1)[0][0] if ids else 0
        votes.setdefault(crop.track_id, Counter())[name] += 1
        pairs.append((crop, seen == name if name else np.zeros_like(crop.mask)))
    return pairs, {track: count.most_common(1)[0][0] for track, count in votes.items()}


def _errors(
    lengths: Iterable[LengthEstimate], truth: Mapping[int, float], names: Mapping[int, int]
) -> list[float]:
    """How far each measured fish's length is off, as a fraction."""
    return [
        abs(length.length_mm / truth[names[length.track_id]] - 1)
        for length in lengths
        if length.length_mm is not None and names.get(length.track_id, 0) in truth
    ]


def print_rows(rows: Iterable[Row]) -> None:
    """A Markdown table, and what it comes to."""
    print("| scene | fish | counted | measured | mask IoU | length error | with true masks |")
    print("|---|---|---|---|---|---|---|")
    done = []
    for row in rows:
        done.append(row)
        print(
            f"| {row.name} | {row.num_fish} | {row.counted} | {row.measured} | {row.iou:.3f} "
            f"| {row.error:.1%} | {row.error_given:.1%} |",
            flush=True,
        )
    exact = sum(row.counted == row.num_fish for row in done)
    print(
        f"\nexact counts: {exact}/{len(done)}; mask IoU {np.nanmean([r.iou for r in done]):.3f}; "
        f"length error {np.nanmean([r.error for r in done]):.1%}, "
        f"with true masks {np.nanmean([r.error_given for r in done]):.1%}"
    )


def main() -> None:
    """Print what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", type=Path)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--template", default="", help="default: the scene's species.ply")
    parser.add_argument("--simulate", type=int, default=0, help="scenes of every preset")
    parser.add_argument("--seed", type=int, default=900, help="of the first simulated scene")
    parser.add_argument("--sheet", type=Path, help="a picture of masks per scene, named after it")
    arguments = parser.parse_args()
    if arguments.scenes:
        print_rows(measure(scene, arguments) for scene in arguments.scenes)
    if arguments.simulate:
        with tempfile.TemporaryDirectory() as folder:
            print_rows(_simulated(Path(folder), arguments))


def _simulated(folder: Path, arguments: argparse.Namespace) -> Iterable[Row]:
    """Scenes with exact masks; those that `simulate` writes are as ragged as people's."""
    for preset in PRESETS:
        PRESETS[preset] = replace(PRESETS[preset], ragged_px=0.0)
        for seed in range(arguments.seed, arguments.seed + arguments.simulate):
            scene = folder / f"{preset}-{seed}"
            simulate(scene, num_fish=5, num_frames=75, preset=preset, seed=seed)
            yield measure(scene, arguments)


if __name__ == "__main__":
    main()
