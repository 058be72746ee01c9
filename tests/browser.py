"""A page opened in headless Chromium, with a script run in it."""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]


def chromium() -> str:
    """The program; skips where there is none."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        pytest.skip("needs a browser: apt install chromium")
    return browser


def evaluate(page: Path, script: str) -> Any:
    """Run the body of an async function in a copy of the page; what it returns, by JSON.

    An exception there is an error here.
    """
    copy = page.with_name(f"probe-{page.name}")
    before, _, after = page.read_text(encoding="utf-8").rpartition("</body>")
    copy.write_text(f"{before}{in_page(script)}</body>{after}", encoding="utf-8")
    return result_of(dump(copy.absolute().as_uri()))


def in_page(script: str) -> str:
    """The body of an async function as an element that leaves its result in the page."""
    return (
        "<script>(async () => { let result; try { result = await (async () => {"
        + script
        + "})(); } catch (error) { result = { error: String(error) }; }"
        "const place = document.createElement('pre'); place.id = 'probe';"
        "place.textContent = JSON.stringify(result ?? null); document.body.append(place);"
        "})();</script>"
    )


def result_of(dom: str) -> Any:
    """What the script of `in_page` left."""
    found = re.search(r'<pre id="probe">(.*?)</pre>', dom, re.DOTALL)
    assert found is not None, dom[-2000:]
    result = json.loads(html.unescape(found[1]))
    assert not (isinstance(result, dict) and "error" in result), result
    return result


def dump(address: str) -> str:
    """The page's DOM once it has come to rest."""
    command = [chromium(), *FLAGS, "--window-size=1400,1000", "--virtual-time-budget=20000"]
    command += ["--dump-dom", address]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
