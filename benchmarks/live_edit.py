"""How fast a blend of two people of the built-in head follows its weights, through `facepipe serve`'s websocket.

A server of its own on loopback, and one client that drags: each edit is sent when the one before is answered, and timed
to its first answer. How long many clients wait is in `serve_load.py`.

example: python benchmarks/live_edit.py --json out.json
"""

from __future__ import annotations

import argparse
import asyncio
import json
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from arguments import positive
from tables import aligned
from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol


@contextmanager
def serving(*words: object) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """A server in a folder of its own while the block lasts: its address, and its process."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        line = [sys.executable, "-m", "facepipe", "serve", f"{folder}/faces", "--port", "0", *map(str, words)]
        with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
            assert server.stdout is not None
            try:
                yield server.stdout.readline().split()[0], server
            finally:
                server.terminate()


def asking(url: str) -> httpx.Client:
    """A client of a server."""
    return httpx.Client(base_url=url, timeout=300, trust_env=False)


def made(client: httpx.Client, seed: int) -> str:
    """A person who is kept there."""
    fields = {"seed": seed, "textures": 0}
    job = client.post("/api/v1/jobs", json={"action": "sample", "fields": fields}).json()
    while job["state"] not in ("done", "failed"):
        time.sleep(0.2)
        job = client.get(f"/api/v1/jobs/{job['id']}").json()
    assert job["state"] == "done", job
    return str(job["face"])


async def editing(url: str, sources: list[str]) -> ClientConnection:
    """A socket on which a blend of faces is open."""
    address = f"ws{url[4:]}api/v1/edit"
    socket = await connect(address, subprotocols=[Subprotocol("facepipe.1")], max_size=None, open_timeout=300)
    opening = {"blend": {"sources": [{"face": face, "version": 1} for face in sources]}}
    await socket.send(json.dumps({"open": opening}))
    told = json.loads(await socket.recv())
    assert "opened" in told, told
    return socket


async def edited(socket: ClientConnection, number: int) -> int:
    """Send the edit of a number, which has weights of its own, and wait for its first answer; the bytes of that."""
    share = 0.5 + 0.4 * np.sin(number)
    weights = {"regions": {"mouth": [1 - share, share]}, "default": [share, 1 - share]}
    await socket.send(json.dumps({"n": number, "weights": weights}))
    while True:
        data = await socket.recv()
        assert isinstance(data, bytes), data
        if struct.unpack_from("<I", data)[0] == number:
            return len(data)


def spread(seconds: list[float]) -> dict[str, float]:
    """Milliseconds."""
    p50, p95, p99 = np.percentile(1e3 * np.array(seconds), (50, 95, 99))
    return {"p50": float(p50), "p95": float(p95), "p99": float(p99), "largest": 1e3 * max(seconds)}


async def dragged(url: str, sources: list[str], edits: int) -> dict[str, Any]:
    """Times of one client that drags."""
    socket, seconds, size = await editing(url, sources), [], 0
    async with socket:
        for number in range(edits):
            start = time.perf_counter()
            size = await edited(socket, number)
            seconds.append(time.perf_counter() - start)
    return {"bytes": size, **spread(seconds)}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--edits", type=positive, default=100)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    with serving() as (url, _):
        with asking(url) as client:
            faces = [made(client, seed) for seed in (1, 2)]
        found = asyncio.run(dragged(url, faces, given.edits))
    cells = [f"{found[name]:.0f}" for name in ("p50", "p95", "p99", "largest")]
    print("\n".join(aligned([("ms", "", "p50", "p95", "p99", "largest"), ("dragged", "", *cells)])))
    if given.json:
        given.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
