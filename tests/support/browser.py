"""A page opened in headless Chromium, with scripts run in it."""

import atexit
import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest

FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
    "--disable-renderer-backgrounding",  # else tabs that nobody looks at wait for all others
    "--disable-background-timer-throttling",
    "--disable-backgrounding-occluded-windows",
]


def chromium() -> str:
    """The program; skips where there is none."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        pytest.skip("needs a browser: apt install chromium")
    return browser


def evaluate(page: Path, script: str) -> Any:
    """Run the body of an async function in a page that is a file; what it returns, by JSON.

    An exception there is an error here.
    """
    tab = Tab(page.absolute().as_uri())
    try:
        return tab.run(script)
    finally:
        tab.close()


# Chromium reads from file descriptor 3 and writes to 4.
_ON_3_AND_4 = """
import os, sys
os.dup2(int(sys.argv[1]), 3)
os.dup2(int(sys.argv[2]), 4)
os.execv(sys.argv[3], sys.argv[3:])
"""


class _Browser:
    """Headless Chromium, by the DevTools protocol: JSON both ways, each message ended by a 0."""

    def __init__(self) -> None:
        reads, self._ours = os.pipe()
        self._answers, writes = os.pipe()
        theirs = [fcntl.fcntl(fd, fcntl.F_DUPFD, 10) for fd in (reads, writes)]  # not 3 or 4
        command = [chromium(), *FLAGS, "--remote-debugging-pipe", "about:blank"]
        process = subprocess.Popen(
            [sys.executable, "-c", _ON_3_AND_4, *map(str, theirs), *command],
            pass_fds=theirs,
            stderr=subprocess.DEVNULL,
        )
        atexit.register(process.kill)
        for fd in (reads, writes, *theirs):
            os.close(fd)
        self._text, self._count = b"", 0
        self.asked: list[tuple[str | None, str]] = []  # tab and address of each request

    def send(self, method: str, *, session: str | None = None, **params: Any) -> dict[str, Any]:
        """A command of the protocol, to a tab or to the browser itself; its result."""
        self._count += 1
        said = {"id": self._count, "method": method, "params": params}
        if session is not None:
            said["sessionId"] = session
        os.write(self._ours, json.dumps(said).encode() + b"\0")
        while (answer := self.hear()).get("id") != self._count:
            pass
        assert "error" not in answer, answer
        return answer["result"]

    def hear(self) -> dict[str, Any]:
        """What it says next."""
        while b"\0" not in self._text:
            assert select.select([self._answers], [], [], 120)[0], "the browser says nothing"
            data = os.read(self._answers, 1 << 20)
            assert data, "the browser has ended"
            self._text += data
        text, _, self._text = self._text.partition(b"\0")
        said = json.loads(text)
        if said.get("method") == "Network.requestWillBeSent":
            self.asked.append((said.get("sessionId"), said["params"]["request"]["url"]))
        return said


@cache
def _browser() -> _Browser:
    """One for all tabs of this process, since it takes seconds to start."""
    return _Browser()


# Parts that are wider than the window, and text that its box hides.
_CUT = """
const cut = [];
if (document.documentElement.scrollWidth > innerWidth) cut.push("the page");
const parts = ["button, input, select, canvas, #map svg, .views svg, h1, h2, .tile, dd, dt, li",
  "th, td, small, figcaption, .row, .row > *, #head > *"].join();
for (const one of document.querySelectorAll(parts)) {
  const box = one.getBoundingClientRect();
  const isOutside = box.width > 0 && (box.left < -1 || box.right > innerWidth + 1);
  const hides = getComputedStyle(one).overflow === "hidden" && one.matches(".row, #head > *")
    && (one.scrollWidth > one.clientWidth + 1 || one.scrollHeight > one.clientHeight + 1);
  if (isOutside || hides) cut.push(one.outerHTML.slice(0, 120));
}
return cut;
"""


class Tab:
    """A page of headless Chromium, driven from outside as by a hand: real mouse, real fingers.

    Every tab has cookies and storage of its own.
    """

    def __init__(self, address: str, *, width: int = 1400, height: int = 1000) -> None:
        """Opens the address and waits until it has loaded."""
        browser = self._browser = _browser()
        self._context = browser.send("Target.createBrowserContext")["browserContextId"]
        target = browser.send(
            "Target.createTarget", url="about:blank", browserContextId=self._context
        )["targetId"]
        attached = browser.send("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.send("Emulation.setDeviceMetricsOverride", **size)
        self.send("Page.enable")
        self.send("Network.enable")
        self.send("Page.navigate", url=address)
        loaded = ("Page.loadEventFired", self._session)
        while ((said := browser.hear()).get("method"), said.get("sessionId")) != loaded:
            pass

    def close(self) -> None:
        """With all that it keeps."""
        self._browser.send("Target.disposeBrowserContext", browserContextId=self._context)

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        """A command of the protocol; its result."""
        return self._browser.send(method, session=self._session, **params)

    def run(self, script: str) -> Any:
        """Run the body of an async function in the page; what it returns, by JSON."""
        expression = f"(async () => {{ {script} }})()"
        answer = self.send(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def mouse(self, kind: str, x: float, y: float, *, is_down: bool = True) -> None:
        """`kind`: mousePressed, mouseMoved or mouseReleased, in CSS pixels of the window."""
        held = {"button": "left", "buttons": 1, "clickCount": 1} if is_down else {}
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **held)

    def touch(self, kind: str, *places: tuple[float, float]) -> None:
        """`kind`: touchStart, touchMove or touchEnd; no places where no finger is left."""
        fingers = [{"x": x, "y": y} for x, y in places]
        self.send("Input.dispatchTouchEvent", type=kind, touchPoints=fingers)

    def asked(self) -> list[str]:
        """The addresses that the page has asked for, but for what it holds itself."""
        mine = [url for session, url in self._browser.asked if session == self._session]
        return [url for url in mine if not url.startswith(("data:", "blob:", "file:"))]

    def cut(self) -> list[str]:
        """What is not whole within the window's width, or not within its own box; the page too."""
        return self.run(_CUT)

    def picture(self, path: Path) -> None:
        """A screenshot, as PNG."""
        data = self.send("Page.captureScreenshot")["data"]
        path.write_bytes(base64.b64decode(data))
