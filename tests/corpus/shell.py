"""Runs `stream-dmr` of one tree in processes of its own, and keeps what it prints."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

_PROGRAM = (sys.executable, "-m", "stream_dmr.cli.main")


class Shell:
    """A folder in which commands of one tree run; paths are relative to it."""

    def __init__(self, tree: Path, folder: Path) -> None:
        self.folder = folder
        self._environment = {
            **os.environ,
            **{"PYTHONPATH": str(tree), "TZ": "UTC", "COLUMNS": "100", "NO_COLOR": "1"},
            **{"LOGNAME": "somebody", "USER": "somebody"},
        }

    def call(self, name: str, *words: str | Path) -> str:
        """Run a command; keep command, exit code and printed text in the file `name`.txt."""
        done = self._run(words)
        path = self.folder / f"{name}.txt"
        path.parent.mkdir(parents=True, exist_ok=True)
        command = shlex.join(map(str, words))
        path.write_text(
            f"$ stream-dmr {command}\nexit code {done.returncode}\n"
            f"--- stdout\n{done.stdout}--- stderr\n{done.stderr}"
        )
        return done.stdout

    def require(self, *words: str | Path) -> None:
        """Run a command whose failure ends all."""
        done = self._run(words)
        if done.returncode:
            raise RuntimeError(f"stream-dmr {shlex.join(map(str, words))}: {done.stderr}")

    @contextmanager
    def review(self, *words: str | Path) -> Iterator["Review"]:
        """Serve a review until the block ends."""
        process = subprocess.Popen(
            [*_PROGRAM, "review", *map(str, words)],
            cwd=self.folder,
            env=self._environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert process.stdout is not None
            printed = iter(process.stdout.readline, "")
            found = next(filter(None, (re.match(r"open (\S+)\?token=(\S+)", x) for x in printed)))
            yield Review(found[1], found[2])
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(timeout=30)

    def _run(self, words: Sequence[str | Path]) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*_PROGRAM, *map(str, words)],
            cwd=self.folder,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )


class Review:
    """The server of a review, as its page talks to it."""

    def __init__(self, address: str, token: str) -> None:
        self._address, self._token = address, token

    def get(self, path: str) -> bytes:
        """The answer to a GET."""
        return self._answer(path, None)

    def post(self, **verdict: object) -> str:
        """Send a verdict; returns it with the answer, two lines."""
        sent = json.dumps(verdict)
        return f"{sent}\n{self._answer('verdict', sent.encode()).decode()}\n"

    def _answer(self, path: str, content: bytes | None) -> bytes:
        headers = {"Authorization": f"Bearer {self._token}", "Content-Type": "application/json"}
        request = urllib.request.Request(self._address + path, content, headers)
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                return answer.read()
        except urllib.error.HTTPError as error:
            with error:
                return f"HTTP {error.code}: ".encode() + error.read()
