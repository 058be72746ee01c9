"""Open an ONNX file with onnxruntime, on the execution providers that are installed."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stream_dmr.errors import ModelError, first_line

_NUM_THREADS = 2  # the other stages need cores as well
_CPU = "CPUExecutionProvider"
# The first sends pictures to a server, the second compiles for minutes at each start.
_NOT_TAKEN = ("AzureExecutionProvider", "TensorrtExecutionProvider")
_NOISE_PX = 128  # sides of a test picture if the input's size is free


def providers() -> list[str]:
    """The execution providers of the installed onnxruntime, the preferred one first."""
    import onnxruntime  # takes 0.1 s, needed with a network only

    return [name for name in onnxruntime.get_available_providers() if name not in _NOT_TAKEN]


def providers_in_use() -> str:
    """`providers`, joined by commas; "" as long as no network was opened in this process."""
    return ",".join(providers()) if "onnxruntime" in sys.modules else ""


def open_session(
    path: Path,
    *,
    content: bytes | None = None,
    threads: int = _NUM_THREADS,
    by: Sequence[str] | None = None,
) -> Any:
    """The `onnxruntime.InferenceSession` of a file, or of its `content` if that is given.

    `by` are execution providers, default `providers()`. Raises ModelError for no or another file.
    """
    import onnxruntime

    if content is None and not path.is_file():
        raise ModelError(f"{path}: expected an ONNX file, found none; check the path")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # our error message has what it would log
    options.intra_op_num_threads = threads
    by = providers() if by is None else by
    # OpenVINO has threads of its own.
    own = [{"num_of_threads": str(threads)} if "OpenVINO" in name else {} for name in by]
    try:
        return onnxruntime.InferenceSession(
            content or str(path), options, providers=[*zip(by, own, strict=True)]
        )
    except Exception as error:  # onnxruntime's errors share no base class
        reason = first_line(error, most=160)
        raise ModelError(
            f"{path}: expected an ONNX model, but it can't be loaded: {reason}"
        ) from None


def provider_notice(path: Path) -> str:
    """How far a network's outputs on noise are from the CPU's; "" if it runs on the CPU."""
    by = providers_in_use()
    if by in ("", _CPU):
        return ""
    rng = np.random.default_rng(0)
    session, on_cpu = open_session(path), open_session(path, by=[_CPU])
    feed = {
        given.name: rng.integers(0, 256, _shape_of(given)).astype(
            np.uint8 if given.type == "tensor(uint8)" else np.float32
        )
        for given in session.get_inputs()
    }
    pairs = zip(session.run(None, feed), on_cpu.run(None, feed), strict=True)
    off = max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs)
    return f"networks run by {by} of onnxruntime, within {off:.2%} of the CPU on a test picture"


def _shape_of(given: Any) -> list[int]:
    """The shape of an input; free sizes are those of one picture of `_NOISE_PX`."""
    free = [1, *[_NOISE_PX] * (len(given.shape) - 1)]
    return [n if isinstance(n, int) else free[k] for k, n in enumerate(given.shape)]
