"""What a server of faces bears: times of many who ask at once, the rate at which it is saturated, and its memory.

A server of its own on loopback. Three kinds are asked for: `payload`, the person of a face; `sliders`, the payload of a
face with other values of its sliders; `blend`, an edit of one of some blends over its websocket, to its first answer.
Beside them one photo is being fitted, as long as they are asked for (needs the extra [train], and a photo below
../shared/data/photos).

`alone`: one request after another, with processor time; first openings, and memory of what is kept open.
`open`: requests are due at times of a Poisson process of a fixed seed, however long answers take, and their times count
from when they were due: a server that stops for a second is charged for all who would have asked meanwhile.
`ramp`: the same at one and a half times the rate, and so on, until a request of a hundred waits longer than --limit
or less than 95 % are answered in time.
`memory`: so many requests of the same mix as fast as the server takes them, of --clients at once; proportional set
sizes of all its processes: the median of the last tenth over that of the second.

The clients take processor time of the same machine. Exit code 1: an error, or memory that grew by more than 5 %.

example: python benchmarks/serve_load.py --seconds 60 --step 20 --requests 100000 --json load.json
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import json
import os
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil
from arguments import positive
from live_edit import asking, edited, editing, made, serving, spread
from tables import aligned

RATES = {"payload": 10.0, "sliders": 6.0, "blend": 4.0}  # a second
PHOTO = Path(__file__).resolve().parents[2] / "shared" / "data" / "photos" / "astronaut.png"
GROUPS = {"facepipe.server.session_program": "sessions", "facepipe.server.program": "jobs"}  # else the server itself
PATIENCE = 60.0  # seconds, after which a request is an error
IN_TIME, GROWTH = 0.95, 1.05
Ask = Callable[[int], Awaitable[object]]


class Load:
    """Clients of one server, and what it works on."""

    def __init__(self, url: str, faces: list[str], sessions: int) -> None:
        self._url, self._faces = url, faces
        self._pairs = list(itertools.permutations(faces, 2))[:sessions]
        self._sockets: list[Any] = []
        self._locks: list[asyncio.Lock] = []
        limits = httpx.Limits(max_connections=None, max_keepalive_connections=None)
        self._client = httpx.AsyncClient(base_url=url, timeout=PATIENCE, limits=limits, trust_env=False)
        self.asks: dict[str, Ask] = {"payload": self._payload, "sliders": self._sliders, "blend": self._blend}

    async def open(self) -> dict[str, list[float]]:
        """Ask for all once, which opens sessions; seconds that each took."""
        seconds = defaultdict(list)
        for number in range(len(self._faces)):
            for kind in ("payload", "sliders"):
                seconds[kind].append(await timed(self.asks[kind](number)))
        for pair in self._pairs:
            start = time.perf_counter()
            self._sockets.append(await editing(self._url, list(pair)))
            self._locks.append(asyncio.Lock())
            seconds["blend"].append(time.perf_counter() - start)
        return dict(seconds)

    async def _payload(self, number: int) -> None:
        face = self._faces[number % len(self._faces)]
        (await self._client.get(f"/api/v1/faces/{face}/versions/1/face.fpb")).raise_for_status()

    async def _sliders(self, number: int) -> None:
        face = self._faces[number % len(self._faces)]
        values = {"values": {"noseWidth": float(np.sin(number)), "jawWidth": float(np.cos(number))}}
        (await self._client.post(f"/api/v1/faces/{face}/versions/1/sliders", json=values)).raise_for_status()

    async def _blend(self, number: int) -> None:
        place = number % len(self._sockets)
        async with self._locks[place]:  # a page has one edit on its way
            await edited(self._sockets[place], number % 2**32)

    async def fit_photos(self, jobs: list[dict[str, Any]]) -> None:
        """One photo after another, until it is cancelled."""
        job: dict[str, Any] = {}
        try:
            while True:
                head = {"X-Facepipe-Consent": "benchmark"}
                sent = await self._client.post("/api/v1/photos", content=PHOTO.read_bytes(), headers=head)
                fields = {"photos": [sent.raise_for_status().json()["artefact"]]}
                asked = {"action": "fit-photo", "fields": fields}
                job = (await self._client.post("/api/v1/jobs", json=asked)).raise_for_status().json()
                jobs.append(job)
                while job["state"] in ("queued", "running"):
                    await asyncio.sleep(0.5)
                    job = (await self._client.get(f"/api/v1/jobs/{job['id']}")).json()
                    jobs[-1] = job
                if job["state"] == "failed":
                    return
        finally:
            if job:
                await self._client.delete(f"/api/v1/jobs/{job['id']}")

    async def close(self) -> None:
        """End all connections."""
        for socket in self._sockets:
            await socket.close()
        await self._client.aclose()


async def timed(what: Awaitable[object]) -> float:
    """Seconds that it took."""
    start = time.perf_counter()
    await what
    return time.perf_counter() - start


def processes(server: subprocess.Popen[str]) -> Iterator[tuple[str, psutil.Process]]:
    """The processes of a server, and what they are for."""
    one = psutil.Process(server.pid)
    for process in (one, *one.children(recursive=True)):
        with contextlib.suppress(psutil.Error):
            words = process.cmdline()
            yield next((group for name, group in GROUPS.items() if name in " ".join(words)), "server"), process


def processor(server: subprocess.Popen[str]) -> Counter[str]:
    """Processor seconds so far, by what for."""
    found: Counter[str] = Counter()
    for group, process in processes(server):
        with contextlib.suppress(psutil.Error):
            found[group] += sum(process.cpu_times()[:2])
    return found


def memory(server: subprocess.Popen[str]) -> dict[str, float]:
    """MB by what for; pages that processes share count once."""
    found: Counter[str] = Counter()
    for group, process in processes(server):
        with contextlib.suppress(psutil.Error):
            found[group] += process.memory_full_info().pss / 1e6
    return {**found, "all": sum(found.values())}


async def alone(load: Load, server: subprocess.Popen[str], count: int) -> dict[str, Any]:
    """Milliseconds of one request after another, and of processors for each."""
    found = {}
    for kind, ask in load.asks.items():
        before = processor(server)
        seconds = [await timed(ask(number)) for number in range(count)]
        used = processor(server)
        of_each = {f"{group}_ms": 1e3 * (used[group] - before[group]) / count for group in ("server", "sessions")}
        found[kind] = {**spread(seconds), **of_each}
    return found


async def open_loop(load: Load, rates: dict[str, float], seconds: float) -> dict[str, Any]:
    """Times and errors by kind, where requests are due whatever the server does."""
    rng, rate = np.random.default_rng(0), sum(rates.values())
    due = np.cumsum(rng.exponential(1.0 / rate, round(rate * seconds)))
    kinds = rng.choice(list(rates), len(due), p=np.array(list(rates.values())) / rate)
    times: defaultdict[str, list[float]] = defaultdict(list)
    errors: Counter[str] = Counter()
    begin = time.perf_counter()

    async def one(number: int) -> None:
        await asyncio.sleep(max(0.0, begin + due[number] - time.perf_counter()))
        try:
            await asyncio.wait_for(load.asks[kinds[number]](number), PATIENCE)
        except Exception as error:
            errors[f"{kinds[number]}: {type(error).__name__}"] += 1
        times[kinds[number]].append(time.perf_counter() - begin - due[number])

    await asyncio.gather(*(one(number) for number in range(len(due))))
    return {
        "rate": rate,
        "answered": len(due) / max(time.perf_counter() - begin, due[-1]),
        "errors": dict(errors),
        "kinds": {kind: {"count": len(times[kind]), **spread(times[kind])} for kind in rates if times[kind]},
        "all": spread([one for of_kind in times.values() for one in of_kind]),
    }


async def ramp(load: Load, rates: dict[str, float], seconds: float, limit: float) -> dict[str, Any]:
    """Open loops at higher and higher rates; `saturation`: the last rate that was borne."""
    steps, borne, factor = [], 0.0, 1.0
    while True:
        step = await open_loop(load, {kind: factor * rate for kind, rate in rates.items()}, seconds)
        steps.append(step)
        if step["errors"] or step["all"]["p99"] > limit or step["answered"] < IN_TIME * step["rate"]:
            return {"saturation": borne, "steps": steps}
        borne, factor = step["rate"], 1.5 * factor


async def closed_loop(
    load: Load, server: subprocess.Popen[str], rates: dict[str, float], count: int, clients: int
) -> dict[str, Any]:
    """Memory over so many requests, as fast as they are answered."""
    kinds = np.random.default_rng(1).choice(list(rates), count, p=np.array(list(rates.values())) / sum(rates.values()))
    numbers, errors, samples = iter(range(count)), Counter[str](), []
    every = max(20, count // 100)  # a look takes as long as some requests
    begin = time.perf_counter()

    async def client() -> None:
        for number in numbers:
            if number % every == 0:
                samples.append(await asyncio.to_thread(memory, server))
            try:
                await asyncio.wait_for(load.asks[kinds[number]](number), PATIENCE)
            except Exception as error:
                errors[f"{kinds[number]}: {type(error).__name__}"] += 1

    await asyncio.gather(*(client() for _ in range(clients)))
    tenth = max(1, len(samples) // 10)

    def median(of: list[dict[str, float]], group: str) -> float:
        return float(np.median([one.get(group, 0.0) for one in of]))

    groups = sorted({group for one in samples for group in one})
    warm = {group: median(samples[tenth : 2 * tenth] or samples, group) for group in groups}
    last = {group: median(samples[-tenth:], group) for group in groups}
    rate = count / (time.perf_counter() - begin)
    return {"requests": count, "rate": rate, "errors": dict(errors), "warm": warm, "last": last, "samples": samples}


async def measured(url: str, server: subprocess.Popen[str], faces: list[str], given: Any) -> dict[str, Any]:
    """All parts."""
    rates = dict(zip(RATES, given.rates, strict=True))
    load = Load(url, faces, given.sessions)
    photos: list[dict[str, Any]] = []
    found: dict[str, Any] = {"cores": os.cpu_count(), "load": os.getloadavg(), "rates": rates, "photos": photos}

    def part(name: str) -> None:
        print(f"{time.strftime('%H:%M:%S')}  {name}", file=sys.stderr, flush=True)

    try:
        before = memory(server)
        part("opening")
        found["cold"] = await load.open()
        count = len(faces) + given.sessions
        found["session_mb"] = (memory(server)["sessions"] - before.get("sessions", 0.0)) / count
        part("alone")
        found["alone"] = await alone(load, server, given.alone)
        fitting = asyncio.create_task(load.fit_photos(photos)) if given.photo else None
        if given.photo:  # it is at work before others ask
            await asyncio.sleep(5.0)
        part("open")
        found["open"] = await open_loop(load, rates, given.seconds)
        if given.step:
            part("ramp")
            found["ramp"] = await ramp(load, rates, given.step, given.limit)
        if given.requests:
            part("memory")
            found["memory"] = await closed_loop(load, server, rates, given.requests, given.clients)
        if fitting is not None:
            fitting.cancel()
            await asyncio.gather(fitting, return_exceptions=True)
    finally:
        await load.close()
    return found


def lines(found: dict[str, Any]) -> list[str]:
    """The table, and lines below it."""
    rows = [("ms", "", "p50", "p95", "p99", "largest", "processor")]

    def add(part: str, kind: str, one: dict[str, float]) -> None:
        used = one.get("server_ms", 0.0) + one.get("sessions_ms", 0.0)
        cells = [f"{one[name]:.0f}" for name in ("p50", "p95", "p99", "largest")]
        rows.append((part, kind, *cells, f"{used:.1f}" if used else ""))

    for kind, one in found["alone"].items():
        add("alone", kind, one)
    for kind, one in found["open"]["kinds"].items():
        add(f"open, {found['open']['rate']:.0f}/s", kind, one)
    for step in found.get("ramp", {}).get("steps", ()):
        add("ramp", f"{step['rate']:.0f}/s, {step['answered']:.0f}/s answered", step["all"])
    told = [*aligned(rows), f"opening: {', '.join(f'{k} {np.median(v):.2f} s' for k, v in found['cold'].items())}"]
    told += [f"a session: {found['session_mb']:.0f} MB", f"errors: {errors_of(found) or 'none'}"]
    done = [one for one in found["photos"] if one["state"] == "done"]
    if done:
        told.append(f"photos: {len(done)}, {np.median([one['report']['seconds'] for one in done]):.1f} s each")
    told += [f"photo failed: {one['error']}" for one in found["photos"] if one["state"] == "failed"]
    if "ramp" in found:
        told.append(
            f"saturation: {found['ramp']['saturation']:.0f}/s and more, less than {rows[-1][1].split('/')[0]}/s"
        )
    if "memory" in found:
        one = found["memory"]
        change = ", ".join(f"{group} {one['warm'][group]:.0f} -> {one['last'][group]:.0f} MB" for group in one["warm"])
        told.append(f"memory: {one['requests']:,} requests at {one['rate']:.0f}/s: {change}")
    return told


def errors_of(found: dict[str, Any]) -> dict[str, int]:
    """All errors, by kind; those of the last step of the ramp are what ended it."""
    parts = [found["open"], *found.get("ramp", {}).get("steps", ())[:-1], found.get("memory", {"errors": {}})]
    return dict(sum((Counter(part["errors"]) for part in parts), Counter()))


def main() -> int:
    """Measure and print; 1 where an aim that has no clock was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = [kind.upper() for kind in RATES]
    parser.add_argument("--rates", type=float, nargs=3, metavar=kinds, default=list(RATES.values()), help="a second")
    parser.add_argument("--sessions", type=positive, default=16, help="blends that are edited")
    parser.add_argument("--alone", type=positive, default=100, metavar="N", help="requests of each kind")
    parser.add_argument("--seconds", type=float, default=60.0, help="of the open loop")
    parser.add_argument(
        "--step", type=float, default=0.0, metavar="SECONDS", help="of each step of the ramp (default none)"
    )
    parser.add_argument("--limit", type=float, default=250.0, metavar="MS", help="that p99 may be in the ramp")
    parser.add_argument("--requests", type=int, default=0, help="over which memory is watched")
    parser.add_argument("--clients", type=positive, default=32, help="at once, meanwhile")
    parser.add_argument("--no-photo", dest="photo", action="store_false", help="no photo is fitted beside")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    given = parser.parse_args()
    if given.photo and not PHOTO.exists():
        given.photo = False
        print(f"skipped: photos ({PHOTO} is not there)")
    people = next(n for n in itertools.count(2) if n * (n - 1) >= given.sessions)  # pairs of them are enough
    with serving("--rate", 1e6, "--sessions", given.sessions + people, "--sessions-mb", 1e6) as (url, server):
        with asking(url) as client:
            faces = [made(client, seed) for seed in range(1, people + 1)]
        found = asyncio.run(measured(url, server, faces, given))
    print("\n".join(lines(found)))
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    growth = found["memory"]["last"]["all"] / found["memory"]["warm"]["all"] if "memory" in found else 1.0
    return int(bool(errors_of(found)) or growth > GROWTH)


if __name__ == "__main__":
    sys.exit(main())
