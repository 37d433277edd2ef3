"""`facepipe serve` in a process of its own, asked by a real client."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import httpx
from places import REPOSITORY

from facepipe.parts import FaceParts
from facepipe.stage import save_parts

PATIENCE = 240.0  # seconds: machines of tests are busy


class Served:
    """A server on a free port, until `stop` or `kill`."""

    def __init__(
        self,
        folder: Path,
        *words: object,
        environment: dict[str, str] | None = None,
        command: Sequence[str] = ("serve",),
    ) -> None:
        self.folder, self.log = folder, folder.with_name(f"{folder.name}.log")
        line = [sys.executable, "-m", "facepipe", *command, str(folder), "--port", "0", *map(str, words)]
        with self.log.open("ab") as log:
            own: Any = {"stdout": subprocess.PIPE, "stderr": log, "cwd": REPOSITORY}
            self.process = subprocess.Popen(line, env={**os.environ, **(environment or {})}, **own)
        assert self.process.stdout is not None
        first = self.process.stdout.readline().decode()
        assert "://" in first, self.log.read_text()
        self.url = first.split()[0]
        self.client = self.asked_with()

    def asked_with(self, token: str | None = None, **more: Any) -> httpx.Client:
        """A client, with a token."""
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        return httpx.Client(base_url=self.url, timeout=PATIENCE, headers=headers, trust_env=False, **more)

    def stop(self) -> int:
        """End it as an operator does; its exit code."""
        return self._ended(signal.SIGTERM)

    def kill(self) -> None:
        """End it as the system does that has no memory left."""
        self._ended(signal.SIGKILL)

    def _ended(self, how: signal.Signals) -> int:
        self.client.close()
        self.process.send_signal(how)
        code = self.process.wait(60)
        assert self.process.stdout is not None
        self.process.stdout.close()
        return code


def ended(client: httpx.Client, job: str) -> dict[str, Any]:
    """A job, once it has ended."""
    until = time.monotonic() + PATIENCE
    while True:
        answer = client.get(f"/api/v1/jobs/{job}")
        found: dict[str, Any] = answer.json()
        assert answer.status_code == 200, found
        if found["state"] not in ("queued", "running"):
            return found
        assert time.monotonic() < until, found
        time.sleep(0.1)


Serve = Callable[..., Served]  # the fixture that starts servers


def sent(client: httpx.Client, *files: Path, name: str | None = None) -> httpx.Response:
    """The answer to an upload of a face."""
    parts = [("files", (one.name, one.read_bytes())) for one in files]
    return client.post("/api/v1/faces", files=parts, data={} if name is None else {"name": name})


def kept(client: httpx.Client, file: Path, name: str | None = None) -> str:
    """The id of a face that was sent and taken in."""
    answer = sent(client, file, name=name)
    assert answer.status_code == 202, answer.text
    job = ended(client, answer.json()["job"]["id"])
    assert job["state"] == "done", job
    return str(job["face"])


def saved(parts: FaceParts, file: Path) -> Path:
    """A face on disk."""
    save_parts(parts, file)
    return file


def done(client: httpx.Client, action: str, fields: dict[str, Any], **more: Any) -> dict[str, Any]:
    """A job that was asked for and has done its work."""
    answer = client.post("/api/v1/jobs", json={"action": action, "fields": fields, **more})
    assert answer.status_code == 202, answer.text
    job = ended(client, answer.json()["id"])
    assert job["state"] == "done", job
    return job
