import subprocess
import sys

# What a run needs not, in MB and seconds: torch 200 and 1, pandas 40 and 0.2, matplotlib 15, 0.2;
# onnx for training and the paper's solver alone.
UNNEEDED = ["torch", "onnx", "pandas", "matplotlib", "ray", "trimesh.viewer"]

CODE = """
import sys
import stream_dmr.cli.main as program

sys.argv = ["stream-dmr", "--version"]
try:
    program.main()
except SystemExit:
    pass
import stream_dmr.pipeline.measure_source, stream_dmr.cli.terminal, stream_dmr.web.watch_observer
import stream_dmr.segmentation.open_segmenter as segmenters
segmenters.open_segmenter("unet")
print([name for name in sys.argv[1:] + {unneeded} if name in sys.modules])
"""


def test_a_run_imports_only_what_it_needs():
    code = CODE.replace("{unneeded}", repr(UNNEEDED))
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.stdout.splitlines()[-1:] == ["[]"], answer.stderr


def test_what_looks_whether_pandas_is_there_goes_on_without_it():
    code = """
import importlib.util, sys
import stream_dmr.cli.main as program
sys.argv = ["stream-dmr", "--version"]
try:
    program.main()
except SystemExit:
    pass
importlib.util.find_spec("pandas")  # as torch does
try:
    import pandas
except ModuleNotFoundError:
    print("hidden")
"""
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.stdout.splitlines()[-1:] == ["hidden"], answer.stderr
