"""Weights between those of two detectors, number by number (after Wortsman et al., CVPR 2022).

python -m benchmarks.segmentation.detector.mix fish.onnx FIRST.onnx SECOND.onnx --share 0.4
"""

import argparse
from pathlib import Path

import numpy as np
import onnx
from onnx import numpy_helper


def mix(first: Path, second: Path, *, share: float) -> onnx.ModelProto:
    """The first model with `1 - share` of its own weights and `share` of the second's."""
    mixed = onnx.load(first)
    others = {one.name: numpy_helper.to_array(one) for one in onnx.load(second).graph.initializer}
    for one in mixed.graph.initializer:
        own = numpy_helper.to_array(one)
        if own.dtype == np.float32:
            weights = (1 - share) * own + share * others[one.name]
            one.CopyFrom(numpy_helper.from_array(weights.astype(np.float32), one.name))
    return mixed


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("first", type=Path)
    parser.add_argument("second", type=Path)
    parser.add_argument("--share", type=float, required=True, help="of the second")
    arguments = parser.parse_args()
    mixed = mix(arguments.first, arguments.second, share=arguments.share)
    arguments.out.write_bytes(mixed.SerializeToString())


if __name__ == "__main__":
    main()
