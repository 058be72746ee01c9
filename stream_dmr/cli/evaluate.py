"""`stream-dmr evaluate`: measured lengths beside known ones, or beside a known histogram."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from stream_dmr.cli.shared_options import OverwriteOption, warn

_NOT_THE_SAME_IDS = (
    "the run numbered its fish in the order in which it found them; where the truth numbers them "
    "differently, different fish are compared: run with the truth's --boxes or --masks, or compare "
    "the distributions only"
)


def evaluate(
    lengths: Annotated[Path, typer.Option(help="lengths.csv of a run.")],
    truth: Annotated[
        Path,
        typer.Option(
            help="truth.csv with track_id,length_mm; or a histogram with bin_low_mm,bin_high_mm "
            "and count or share."
        ),
    ],
    config: Annotated[
        Path | None, typer.Option(help="A config.toml; its [evaluate] has the bins.")
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            help="Where to draw both histograms.",
            show_default="lengths_histogram.png beside lengths",
        ),
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Compare measured lengths with known ones: fish by fish, as intervals, as distributions."""
    from stream_dmr.cli.terminal import print_distributions, print_evaluation
    from stream_dmr.errors import OutputError
    from stream_dmr.evaluation.compare import evaluate, evaluate_histogram
    from stream_dmr.evaluation.histogram_plot import plot_histograms
    from stream_dmr.evaluation.length_tables import is_histogram
    from stream_dmr.results.finished_fish import numbers_its_own
    from stream_dmr.results.own_files import is_made_by, require_writable
    from stream_dmr.running.config import load_config

    settings = load_config(config).evaluate
    if not is_histogram(truth) and numbers_its_own(lengths.parent):
        warn([_NOT_THE_SAME_IDS])
    if is_histogram(truth):
        distributions = evaluate_histogram(lengths, truth, settings=settings)
        print_distributions(distributions)
    else:
        evaluation = evaluate(lengths, truth, settings=settings)
        print_evaluation(evaluation)
        distributions = evaluation.distributions
    if distributions is None:
        print("no histograms: no measured or no true length within the bins of [evaluate]")
        return
    picture = plot or lengths.with_name(f"{lengths.stem}_histogram.png")
    try:
        require_writable(picture, overwrite=overwrite, is_own=is_made_by("evaluate"))
        plot_histograms(picture, distributions)
    except OutputError as error:
        if plot is not None:
            raise
        print(f"not drawn: {error}; choose another place with --plot", file=sys.stderr)
    else:
        print(f"both histograms: {picture}")
