"""The commands `train` and `evaluate`."""

import sys
from pathlib import Path
from typing import Annotated, Literal

from stream_dmr.cli.shared_options import OverwriteOption, command_line, stop_on_signals, warn
from stream_dmr.errors import UserError, requires_extra

Device = Literal["cpu", "cuda"]


def train(
    out: Annotated[Path, "Folder for weights, scores and pictures."] = Path("runs/train"),
    images: Annotated[
        Path | None, "Folder of your own images; without them all pictures are simulated."
    ] = None,
    masks: Annotated[
        Path | None, "Folder of a .png per image, values are fish ids; or a COCO .json."
    ] = None,
    backgrounds: Annotated[
        Path | None, "Folder of photographs without fish, to put fish before."
    ] = None,
    init: Annotated[
        Path | None, "Weights to start from; with --images the shipped ones unless given."
    ] = None,
    config: Annotated[Path | None, "A config.toml; its [train] is used."] = None,
    device: Annotated[Device, "Where to compute."] = "cpu",
    resume: Annotated[bool, "Continue the training in --out after its last epoch."] = False,
    overwrite: OverwriteOption = False,
) -> None:
    """Train the network that finds masks, on simulated pictures or on your own as well.

    Writes unet.onnx, unet.pt, scores.json, curve.png and worst.png into --out after every epoch;
    use it by [crop_fish] segmenter = "OUT/unet.onnx". Ctrl-C ends it; --resume continues.
    """
    if (images is None) != (masks is None):
        raise UserError("--images and --masks belong together: give both or neither")
    if backgrounds is not None and images is None:
        raise UserError("--backgrounds needs your own fish: give --images and --masks")
    with stop_on_signals() as stop:
        from stream_dmr.evidence.own_files import require_writable
        from stream_dmr.pipeline.config import load_config

        with requires_extra("torch", "a training"):
            from stream_dmr.cli.train_display import TrainDisplay
            from stream_dmr.training.train_unet import TRAINING_FILES, TrainRequest, train_unet

        if not resume and not (out / "last.pt").exists():  # else it refuses the earlier training
            require_writable(*(out / name for name in TRAINING_FILES), overwrite=overwrite)
        settings = load_config(config).train
        request = TrainRequest(
            out=out,
            settings=settings,
            images=images,
            masks=masks,
            backgrounds=backgrounds,
            init=init,
            device=device,
            resume=resume,
            command=command_line(),
        )
        with TrainDisplay(settings) as display:
            best = train_unet(request, stop=stop, observer=display)
    if best is not None:
        print(f"best: epoch {best.epoch}, mean IoU {best.iou:.3f}; {out / 'unet.onnx'}")
    stop.exit("; --resume continues" if (out / "last.pt").exists() else "; nothing was trained yet")


_NOT_THE_SAME_IDS = (
    "the run numbered its fish in the order in which it found them; where the truth numbers them "
    "differently, different fish are compared: run with the truth's --boxes or --masks, or compare "
    "the distributions only"
)


def evaluate(
    lengths: Annotated[Path, "lengths.csv of a run."],
    truth: Annotated[
        Path,
        "truth.csv with track_id,length_mm; or a histogram with bin_low_mm,bin_high_mm "
        "and count or share.",
    ],
    config: Annotated[Path | None, "A config.toml; its [evaluate] has the bins."] = None,
    plot: Annotated[
        Path | None, "Where to draw both histograms.", "lengths_histogram.png beside lengths"
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Compare measured lengths with known ones: fish by fish, as intervals, as distributions."""
    from stream_dmr.cli.terminal import print_distributions, print_evaluation
    from stream_dmr.evaluation.compare import (
        evaluate,
        evaluate_histogram,
        plot_histograms,
        unit_of_truth,
    )
    from stream_dmr.evaluation.length_tables import is_histogram
    from stream_dmr.evidence.own_files import is_made_by, require_writable
    from stream_dmr.pipeline.config import load_config
    from stream_dmr.store.fish import assigns_ids

    settings = load_config(config).evaluate
    if not is_histogram(truth) and assigns_ids(lengths.parent):
        warn([_NOT_THE_SAME_IDS])
    if is_histogram(truth):
        distributions = evaluate_histogram(lengths, truth, settings=settings)
        print_distributions(distributions)
    else:
        evaluation = evaluate(lengths, truth, settings=settings)
        print_evaluation(evaluation)
        if unit := unit_of_truth(evaluation):
            warn([f"{truth}: expected length_mm in mm, got what seems to be {unit}; convert it"])
        distributions = evaluation.distributions
    if distributions is None:
        print("no histograms: no measured or no true length within the bins of [evaluate]")
        return
    picture = plot or lengths.with_name(f"{lengths.stem}_histogram.png")
    try:
        require_writable(picture, overwrite=overwrite, is_own=is_made_by("evaluate"))
        plot_histograms(picture, distributions)
    except UserError as error:
        if plot is not None:
            raise
        print(f"not drawn: {error}", file=sys.stderr)
    else:
        print(f"both histograms: {picture}")
