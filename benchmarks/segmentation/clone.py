"""Files of a git repository at one commit, read without checking it out."""

import subprocess
import tempfile
from fnmatch import fnmatch
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8


class Clone:
    """A clone `owner+name` in a folder, bare or not, or the folder `repo` in it."""

    def __init__(self, folder: Path, repository: str, commit: str) -> None:
        """Raises FileNotFoundError where there is none."""
        root = folder / repository.replace("/", "+")
        places = [root / "repo" / ".git", root / "repo", root / ".git", root]
        found = [place for place in places if (place / "HEAD").exists()]
        if not found:
            raise FileNotFoundError(f"{root}: expected a clone of {repository}, found none there")
        self._git = ["git", "--git-dir", str(found[0])]
        self._commit = commit

    def paths(self, pattern: str) -> list[str]:
        """The paths that match a pattern, in order; not of files that the clone lacks."""
        command = [*self._git, "ls-tree", "-r", "-z", "--name-only", self._commit]
        listed = subprocess.run(command, check=True, capture_output=True).stdout.decode()
        return self._present(sorted(path for path in listed.split("\0") if fnmatch(path, pattern)))

    def _present(self, paths: list[str]) -> list[str]:
        names = "".join(f"{self._commit}:{path}\n" for path in paths)
        command = [*self._git, "cat-file", "--batch-check=%(objecttype)"]
        lines = subprocess.run(command, check=True, capture_output=True, input=names.encode())
        kinds = lines.stdout.decode().splitlines()
        return [path for path, kind in zip(paths, kinds, strict=True) if kind == "blob"]

    def content(self, path: str) -> bytes:
        """A file's bytes."""
        command = [*self._git, "show", f"{self._commit}:{path}"]
        return subprocess.run(command, check=True, capture_output=True).stdout

    def text(self, path: str) -> str:
        """A file's text; empty where there is none."""
        try:
            return self.content(path).decode()
        except subprocess.CalledProcessError:
            return ""

    def image(self, path: str) -> UInt8[np.ndarray, "H W 3"]:
        """A picture, BGR; of a video the first frame."""
        if path.endswith(".mp4"):
            with tempfile.NamedTemporaryFile(suffix=".mp4") as file:
                file.write(self.content(path))
                file.flush()
                _, image = cv2.VideoCapture(file.name).read()
        else:
            image = cv2.imdecode(np.frombuffer(self.content(path), np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            raise ValueError(f"{path}: expected a picture, but it can't be decoded")
        return image
