"""Opening a user's ONNX file with onnxruntime."""

from pathlib import Path
from typing import Any

from stream_dmr.errors import ModelError

_THREADS = 2  # the other stages want cores as well


def open_session(path: Path) -> Any:
    """The `onnxruntime.InferenceSession` of a file. Raises ModelError where it can't be had."""
    import onnxruntime  # 0.1 s that only those pay who have a model

    if not path.is_file():
        raise ModelError(f"{path}: expected an ONNX file, found none; check the path")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # our one line says it
    options.intra_op_num_threads = _THREADS
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own are no subclasses of anything
        reason = f"{error}".strip().splitlines()[0][:160]
        raise ModelError(
            f"{path}: expected an ONNX model, but it can't be loaded: {reason}"
        ) from None
