"""Pages in headless Chromium, and the viewer's server beside them."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import facepipe_web
import pytest
from facepipe_web import build

HERE = Path(__file__).parent / "js"
PLAYWRIGHT = build.HERE / "node_modules" / "playwright-core" / "index.mjs"
WEBGPU = build.HERE / "node_modules" / "onnxruntime-web" / "dist"
_NAMES = ("chromium", "chromium-browser", "google-chrome")
_PATIENCE = 900  # seconds

Step = dict[str, Any]


@functools.cache
def chromium() -> str:
    """A Chromium, with the viewer's page built; skips the test where there is no Chromium or no node."""
    found = next(filter(None, map(shutil.which, _NAMES)), None)
    if found is None:
        pytest.skip("needs chromium on the PATH")
    built()
    return found


@functools.cache
def built() -> Path:
    """The folder of the runtime and the viewer's page; skips the test where there is no node."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("needs node and npm on the PATH")
    lock = build.HERE / ".building"
    for _ in range(_PATIENCE):  # several test processes may come here at once
        if build.is_built() and PLAYWRIGHT.is_file():
            return build.DIST
        try:
            lock.mkdir()
        except FileExistsError:
            time.sleep(1)
            continue
        try:
            build.build()
        finally:
            lock.rmdir()
    pytest.fail(f"the viewer was not built in {_PATIENCE} s; remove {lock} if no test run is under way")


@contextlib.contextmanager
def viewing(*faces: Path, onnx: Path | None = None) -> Iterator[str]:
    """The URL of a viewer that serves faces."""
    with facepipe_web.view(faces, facepipe_web.Options(), onnx) as page:
        thread = threading.Thread(target=page.serve)
        thread.start()
        try:
            yield page.url
        finally:
            page.close()
            thread.join()


@contextlib.contextmanager
def serving(folder: Path) -> Iterator[str]:
    """The URL of the files in a folder."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def browse(
    url: str, *steps: Step, flags: Sequence[str] = (), before: str = "", webgpu: bool = False, phone: bool = False
) -> tuple[list[Any], list[str]]:
    """What steps on a page give (tests/support/js/browse.mjs), and the page's problems.

    :param webgpu: onnxruntime-web's build for WebGPU is beside the page's scripts, which the viewer does without
    :param phone: a window of 390 x 844, and a fourth of the processor's speed
    """
    request = {"url": url, "steps": steps, "flags": list(flags), "before": before} | (
        {"webgpu": str(WEBGPU)} if webgpu else {}
    )
    request |= {"viewport": [390, 844], "slower": 4} if phone else {}
    command = ["node", str(HERE / "browse.mjs"), str(PLAYWRIGHT), chromium()]
    done = subprocess.run(
        command, input=json.dumps(request), capture_output=True, text=True, encoding="utf-8", check=False,
        env=os.environ | {"NODE_NO_WARNINGS": "1"}, timeout=_PATIENCE,
    )  # fmt: skip
    if done.returncode:
        pytest.fail(f"browse.mjs: {done.stderr[-2000:]}")
    answer = json.loads(done.stdout)
    return answer["results"], answer["problems"]


READY: Step = {"wait": "body[data-state]"}
DRAWN: Step = {"run": "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done())))"}


def run(expression: str) -> Step:
    """A step that evaluates JavaScript, with `face` and `page` at hand."""
    return {"run": f"(async () => {{ const {{ page }} = facepipe, face = facepipe.face(); {expression} }})()"}


def until(condition: str) -> Step:
    """A step that waits for JavaScript to be true."""
    poll = f"for (let i = 0; i < 600 && !({condition}); i++) await new Promise((done) => setTimeout(done, 50));"
    return run(f"{poll} if (!({condition})) throw new Error('did not come')")
