"""`stream-dmr train`: weights of the U-Net that finds masks, also for one's own vessel."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from stream_dmr.cli.shared_options import OverwriteOption, command_line, stop_on_signals
from stream_dmr.errors import UserError

Device = Literal["cpu", "cuda"]


def train(
    out: Annotated[Path, typer.Option(help="Folder for weights, scores and pictures.")] = Path(
        "runs/train"
    ),
    images: Annotated[
        Path | None,
        typer.Option(help="Folder of your own images; without them all pictures are simulated."),
    ] = None,
    masks: Annotated[
        Path | None,
        typer.Option(help="Folder of a .png per image, values are fish ids; or a COCO .json."),
    ] = None,
    backgrounds: Annotated[
        Path | None,
        typer.Option(help="Folder of photographs without fish, to put your own fish before."),
    ] = None,
    init: Annotated[
        Path | None,
        typer.Option(help="Weights to start from; with --images the shipped ones by themselves."),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="A config.toml; its [train] is used.")] = None,
    device: Annotated[Device, typer.Option(help="Where to compute.")] = "cpu",
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Continue the training in --out after its last epoch."),
    ] = False,
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
        from stream_dmr.cli.train_display import TrainDisplay
        from stream_dmr.results.own_files import require_writable
        from stream_dmr.running.config import load_config
        from stream_dmr.segmentation.training.train_unet import (
            TRAINING_FILES,
            TrainRequest,
            train_unet,
        )

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
    stop.exit("; --resume continues")
