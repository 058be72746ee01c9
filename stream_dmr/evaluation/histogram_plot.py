"""The picture of `stream-dmr evaluate`: the measured and the true histogram, as in the paper."""

from pathlib import Path

from stream_dmr.errors import OutputError, reason_of
from stream_dmr.evaluation.compare import Distributions


def plot_histograms(path: Path, distributions: Distributions) -> None:
    """Draw both histograms into a picture; the suffix of `path` is its format, PNG without one.

    Raises OutputError where it can't be written.
    """
    from matplotlib.figure import Figure  # its import takes a quarter of a second

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    predicted, truth, errors = distributions.predicted, distributions.truth, distributions.errors
    axes.stairs(100 * truth.shares, truth.edges_mm, fill=True, color="0.8", label="true")
    axes.stairs(100 * predicted.shares, predicted.edges_mm, color="C0", lw=2, label="measured")
    axes.set(
        xlabel="length, mm",
        ylabel="fish, %",
        title=f"bias {errors.bias_mm:+.1f} mm, EMD {errors.emd_mm:.1f} mm, "
        f"RMSD {100 * errors.rmsd:.1f} %, KL {errors.kl:.2f}",
    )
    axes.legend(frameon=False)
    try:
        figure.savefig(path, dpi=110, metadata=_made_by(path))
    except (OSError, ValueError) as error:  # ValueError: a suffix that matplotlib doesn't know
        raise OutputError(
            f"{path}: expected to write a picture there, got: {reason_of(error)}"
        ) from error


def _made_by(path: Path) -> dict[str, str] | None:
    """By what `evaluate` knows its own pictures; formats have names of their own for it."""
    return {"Software": "stream-dmr evaluate"} if path.suffix in ("", ".png") else None
