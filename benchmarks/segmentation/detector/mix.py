"""Weights between those of two detectors, number by number (after Wortsman et al., CVPR 2022).

python -m benchmarks.segmentation.detector.mix fish.onnx FIRST.onnx SECOND.onnx --share 0.4
"""

import argparse
from pathlib import Path

import numpy as np
import onnx
from onnx import numpy_helper


def mix(first: Path, second: Path, *, share: float) -> onnx.ModelProto:
    """The first model with `1 - share` of its own weights and `share` of the second's.

    They may be for frames of different sizes: what follows from those is the first one's.
    """
    mixed = onnx.load(first)
    others = {one.name: numpy_helper.to_array(one) for one in onnx.load(second).graph.initializer}
    learnt = {name for node in mixed.graph.node if node.op_type == "Conv" for name in node.input}
    for one in mixed.graph.initializer:
        if one.name in learnt:
            weights = (1 - share) * numpy_helper.to_array(one) + share * others[one.name]
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
