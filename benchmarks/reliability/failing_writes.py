"""A measurement whose Nth write fails: with ENOSPC or EIO, once, for a while, or from then on.

    python -m benchmarks.reliability.failing_writes --cases 300     # loads disturb.c into itself

Each case is a whole run over a folder of clips, in a fork of a process in which all is imported.
"""

import argparse
import ctypes
import errno
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import traceback
from collections import Counter
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

FAILING_FRAMES = 40  # after which writing works again, of 80
_PATIENCE_S = 120.0
_MODES = ("once", "for a while", "from then on")
_ERRORS = (errno.ENOSPC, errno.EIO)


@dataclass(frozen=True, kw_only=True)
class Case:
    """Which write fails, how, and for how long."""

    at: int  # 0: none
    error: int = errno.ENOSPC
    mode: str = "once"


def build(folder: Path) -> Path | None:
    """The library that lets writes fail; None where there is no compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        return None
    library, source = folder / "disturb.so", Path(__file__).with_name("disturb.c")
    command = [compiler, "-shared", "-fPIC", "-O2", "-o", str(library), str(source), "-ldl"]
    subprocess.run(command, check=True)
    return library


def failing_writes(folder: Path, *, cases: int) -> dict[str, object]:
    """Figures of so many cases, from a process of its own; why not, where that can't be."""
    folder.mkdir(parents=True)
    library = build(folder)
    if library is None:
        return {"skipped": "needs a C compiler: apt install gcc"}
    command = [
        sys.executable,
        "-m",
        "benchmarks.reliability.failing_writes",
        "--cases",
        str(cases),
        "--folder",
        str(folder),
    ]
    environment = os.environ | {"LD_PRELOAD": str(library), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Run the cases; their figures are the last line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cases", type=int, default=300)
    parser.add_argument("--folder", type=Path, default=None)
    parser.add_argument("--at", type=int, default=None, help="this one case alone")
    parser.add_argument("--mode", choices=_MODES, default="once")
    parser.add_argument("--error", default="ENOSPC")
    arguments = parser.parse_args()
    folder = arguments.folder or Path(tempfile.mkdtemp(prefix="failing-writes-"))
    if not hasattr(ctypes.CDLL(None), "disturb_writes"):
        folder.mkdir(exist_ok=True)
        os.environ["LD_PRELOAD"] = str(build(folder))
        os.execv(sys.executable, sys.orig_argv)
    from benchmarks.reliability import failing_run

    failing_run.prepare(folder)
    whole = failing_run.measure(Case(at=0))
    if arguments.at is not None:
        chosen = [Case(at=arguments.at, error=getattr(errno, arguments.error), mode=arguments.mode)]
    else:
        chosen = cases_over(whole["writes"], arguments.cases)
    figures = Counter[str]()
    broken: list[str] = []
    for case in chosen:
        found = in_a_fork(case)
        for problem in judge(case, found, whole):
            figures[problem] += 1
            broken.append(f"{asdict(case)}: {problem}: {found.get('said', '')}")
            print(broken[-1], file=sys.stderr, flush=True)
    summary = {"cases": len(chosen), "writes of a run": whole["writes"], "fish": len(whole["fish"])}
    print(json.dumps(summary | {"problems": dict(figures), "first": broken[:3]}), flush=True)


def cases_over(num_writes: int, count: int) -> list[Case]:
    """The first 20 writes, and others evenly over the run; each way of failing in turn."""
    at = [*range(1, 21), *(21 + (num_writes - 21) * k // max(1, count) for k in range(count))]
    ways = [(error, mode) for mode in _MODES for error in _ERRORS]
    return [
        Case(at=n, error=ways[k % len(ways)][0], mode=ways[k % len(ways)][1])
        for k, n in enumerate(at[:count])
    ]


def in_a_fork(case: Case) -> dict:
    """What came of a case; `said` alone where it hung or broke down."""
    from benchmarks.reliability import failing_run

    fork = multiprocessing.get_context("fork")
    ours, theirs = fork.Pipe()

    def child() -> None:
        try:
            theirs.send(failing_run.measure(case))
        except BaseException:
            theirs.send({"said": traceback.format_exc()[-900:]})

    process = fork.Process(target=child, daemon=True)
    process.start()
    theirs.close()
    found = {"said": "it hung"}
    with suppress(EOFError):
        if ours.poll(_PATIENCE_S):
            found = ours.recv()
    process.kill()
    process.join()
    return found


def judge(case: Case, found: dict, whole: dict) -> list[str]:
    """What is not as it is to be."""
    if "fish" not in found:
        return ["broke down"]
    problems = []
    if found["refused"] and case.mode != "from then on":
        problems.append("ended with an error though the disk worked again")
    if found["num_frames"] != whole["num_frames"]:
        problems.append("frames not measured")
    if case.mode != "from then on":
        if found["fish"] != whole["fish"]:
            problems.append("lengths lost")
        if found["rows"] != found["fish"]:
            problems.append("lengths.csv is not what lengths.db holds")
        if found["parts"]:
            problems.append("an unfinished recording stayed")
        if found["recorded"] < whole["num_frames"]:
            problems.append("recording did not go on")
    if found["unreadable"]:
        problems.append("a recording can't be read")
    return problems


if __name__ == "__main__":
    sys.modules["failing_writes"] = sys.modules["__main__"]
    main()
