"""Open an ONNX file with onnxruntime."""

from pathlib import Path
from typing import Any

from stream_dmr.errors import ModelError

_NUM_THREADS = 2  # the other stages need cores as well


def open_session(path: Path, *, content: bytes | None = None, threads: int = _NUM_THREADS) -> Any:
    """The `onnxruntime.InferenceSession` of a file, or of its `content` where that is at hand.

    Raises ModelError for no or another file.
    """
    import onnxruntime  # takes 0.1 s, needed with a network only

    if content is None and not path.is_file():
        raise ModelError(f"{path}: expected an ONNX file, found none; check the path")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # our error message has what it would log
    options.intra_op_num_threads = threads
    try:
        return onnxruntime.InferenceSession(
            content or str(path), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # onnxruntime's errors share no base class
        reason = f"{error}".strip().splitlines()[0][:160]
        raise ModelError(
            f"{path}: expected an ONNX model, but it can't be loaded: {reason}"
        ) from None
