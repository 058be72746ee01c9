"""Open a user's ONNX file with onnxruntime."""

from pathlib import Path
from typing import Any

from stream_dmr.errors import ModelError

_NUM_THREADS = 2  # the other stages need cores as well


def open_session(path: Path) -> Any:
    """The `onnxruntime.InferenceSession` of a file. Raises ModelError for no or another file."""
    import onnxruntime  # takes 0.1 s, needed with a user's model only

    if not path.is_file():
        raise ModelError(f"{path}: expected an ONNX file, found none; check the path")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # our error message has what it would log
    options.intra_op_num_threads = _NUM_THREADS
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors share no base class
        reason = f"{error}".strip().splitlines()[0][:160]
        raise ModelError(
            f"{path}: expected an ONNX model, but it can't be loaded: {reason}"
        ) from None
