"""`python -m tests.corpus --base REV`: are all outputs of this checkout those of a revision?"""

import argparse
import hashlib
import shutil
import subprocess
import sys
from pathlib import Path

from tests.corpus.compare import differences
from tests.corpus.recipe import RUNS, make_corpus
from tests.corpus.scenes import draw_scenes
from tests.corpus.shell import Shell

ROOT = Path(__file__).parents[2]
_CACHE = ROOT / "build" / "corpus"
_RECIPE = ("recipe", "scenes", "shell")  # what a base that was made depends on, beside its commit


def main() -> int:
    """Make both corpora and compare them; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.corpus", description=__doc__)
    parser.add_argument("--base", default="main", help="revision to compare with")
    parser.add_argument("--only", choices=RUNS, action="append", help="this run; may be repeated")
    asked = parser.parse_args()
    names = asked.only or list(RUNS)
    commit = _git("rev-parse", "--verify", f"{asked.base}^{{commit}}")
    here = Path(__file__).parent
    recipe = b"".join((here / f"{name}.py").read_bytes() for name in _RECIPE)
    base = _CACHE / f"{commit[:12]}-{hashlib.sha256(recipe).hexdigest()[:8]}"
    _make_base(commit, base, names)
    print("this checkout", flush=True)
    ours = _CACHE / "checkout"
    _make(ROOT, base / "scenes", ours, names)
    found = [line for name in names for line in differences(base / name, ours / name)]
    for line in found:
        print(line)
    print(f"{len(found)} differences from {asked.base} in {', '.join(names)}")
    return 1 if found else 0


def _make_base(commit: str, base: Path, names: list[str]) -> None:
    """Scenes and the runs that are not there yet, by the code of a commit."""
    missing = [name for name in names if not (base / name).exists()]
    if not missing and (base / "scenes").exists():
        return
    print(f"base {commit[:12]}", flush=True)
    tree = base / "tree"
    if not tree.exists():
        _git("worktree", "prune")
        _git("worktree", "add", "--detach", str(tree), commit)
    try:
        if not (base / "scenes").exists():
            drawing = base / "drawing"
            shutil.rmtree(drawing, ignore_errors=True)
            drawing.mkdir()
            draw_scenes(Shell(tree, drawing))
            (drawing / "scenes").rename(base / "scenes")
            drawing.rmdir()
        _make(tree, base / "scenes", base, missing)
    finally:
        _git("worktree", "remove", "--force", str(tree))


def _make(tree: Path, scenes: Path, folder: Path, names: list[str]) -> None:
    """Each run in a folder of its own, which is there only once it is whole."""
    for name in names:
        shutil.rmtree(folder / name, ignore_errors=True)
        part = folder / f"{name}.part"
        shutil.rmtree(part, ignore_errors=True)
        make_corpus(tree, scenes, part, [name])
        part.rename(folder / name)


def _git(*words: str) -> str:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"git {' '.join(words)}: {done.stderr.strip()}")
    return done.stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
