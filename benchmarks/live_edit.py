"""How fast a blend of two people of the built-in head follows its weights, through `facepipe serve`'s websocket.

A server of its own on loopback. First one client that drags: each edit is sent when the one before is answered. Then an
open loop: so many blends, each with a session, and edits at times of their own, however long answers take; from when
one should have been sent to its first answer.

example: python benchmarks/live_edit.py --sessions 16 --rate 4 --seconds 60 --json out.json
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
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from arguments import positive
from tables import aligned
from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol

_EDITS = 100  # that are dragged
_PROTOCOL = Subprotocol("facepipe.1")


def weights(number: int) -> dict[str, Any]:
    """Others for each edit."""
    share = 0.5 + 0.4 * np.sin(number)
    return {"regions": {"mouth": [1 - share, share]}, "default": [share, 1 - share]}


async def answered(socket: ClientConnection, number: int) -> int:
    """Wait for the first answer to an edit; its bytes."""
    while True:
        data = await socket.recv()
        if isinstance(data, bytes) and struct.unpack_from("<I", data)[0] == number:
            return len(data)


async def measured(url: str, sources: list[list[dict[str, Any]]], rate: float, seconds: float) -> dict[str, Any]:
    """Times of one client that drags, and of the open loop."""
    async with AsyncExitStack() as ends:
        sockets = []
        for own in sources:
            socket = await ends.enter_async_context(
                connect(
                    f"ws{url[4:]}api/v1/edit", subprotocols=[Subprotocol("facepipe.1")], max_size=None, open_timeout=300
                )
            )
            await socket.send(json.dumps({"open": {"blend": {"sources": own}}}))
            told = json.loads(await socket.recv())
            assert "opened" in told, told
            sockets.append(socket)
        dragged = []
        for number in range(_EDITS):
            start = time.perf_counter()
            await sockets[0].send(json.dumps({"n": number, "weights": weights(number)}))
            size = await answered(sockets[0], number)
            dragged.append(time.perf_counter() - start)
        rng, begin = np.random.default_rng(0), time.perf_counter()
        times = np.cumsum(rng.exponential(1.0 / rate, round(rate * seconds)))
        locks = [asyncio.Lock() for _ in sockets]

        async def edit(number: int, at: float) -> float:
            await asyncio.sleep(max(0.0, begin + at - time.perf_counter()))
            place = number % len(sockets)
            async with locks[place]:
                await sockets[place].send(json.dumps({"n": _EDITS + number, "weights": weights(number)}))
                await answered(sockets[place], _EDITS + number)
            return time.perf_counter() - begin - at

        loop = await asyncio.gather(*(edit(number, at) for number, at in enumerate(times)))
    return {"bytes": size, "dragged": spread(dragged), "loop": spread(loop)}


def spread(seconds: list[float]) -> dict[str, float]:
    """Milliseconds."""
    p50, p95, p99 = np.percentile(1e3 * np.array(seconds), (50, 95, 99))
    return {"p50": float(p50), "p95": float(p95), "p99": float(p99), "largest": 1e3 * max(seconds)}


def made(client: httpx.Client, seed: int) -> str:
    """A person who is kept there."""
    fields = {"seed": seed, "textures": 0}
    job = client.post("/api/v1/jobs", json={"action": "sample", "fields": fields}).json()
    while job["state"] not in ("done", "failed"):
        time.sleep(0.2)
        job = client.get(f"/api/v1/jobs/{job['id']}").json()
    assert job["state"] == "done", job
    return str(job["face"])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sessions", type=positive, default=16)
    parser.add_argument("--rate", type=float, default=4.0, help="edits a second of all together")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    people = max(2, round((1 + (1 + 4 * given.sessions) ** 0.5) / 2 + 0.5))  # pairs of them are enough
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        line = [sys.executable, "-m", "facepipe", "serve", f"{folder}/faces", "--port", "0"]
        with subprocess.Popen([*line, "--sessions", str(given.sessions)], stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            url = server.stdout.readline().split()[0]
            try:
                with httpx.Client(base_url=url, timeout=300, trust_env=False) as client:
                    faces = [made(client, seed) for seed in range(1, people + 1)]
                pairs = [(a, b) for a in faces for b in faces if a != b][: given.sessions]
                sources = [[{"face": one, "version": 1} for one in pair] for pair in pairs]
                found = asyncio.run(measured(url, sources, given.rate, given.seconds))
            finally:
                server.terminate()
    rows = [(name, "", *(f"{value:.0f}" for value in found[name].values())) for name in ("dragged", "loop")]
    sys.stdout.write("\n".join(aligned([("ms", "", "p50", "p95", "p99", "largest"), *rows])) + "\n")
    if given.json:
        given.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
