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
        paths = sorted(path for path in listed.split("\0") if fnmatch(path, pattern))
        return [path for path in paths if self._has(path)]

    def _has(self, path: str) -> bool:
        command = [*self._git, "cat-file", "-e", f"{self._commit}:{path}"]
        return subprocess.run(command, check=False, capture_output=True).returncode == 0

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
