"""What a day of players takes of servers: a queueing model on measured service times, simulated request by request.

Players come by the hour, a Poisson process in each. Each fetches the persons of others; some send a photo; some edit
sliders, whose session is opened cold and then kept warm as long as memory lasts. Three stations answer them:

- servers: one process each, to which requests go at random, one after another;
- cores of sessions, that take openings and edits in the order in which they come; of more sessions than memory holds
  the one that was used least lately is closed, and its next edit opens it again;
- workers for photos, which are lost now and then: the photo starts again on another when that is noticed.

Machines are bought for the busiest hour at a load of --load; then the day is simulated, and the busiest hours again
with more and more players on the same machines, to see which aim is missed first, and when. Times come from
`serve_load.py --json`, or from the table below. tests/house/test_serve_model.py holds the queues to M/M/c and M/D/1.

example: python benchmarks/serve_model.py --measured load.json --players 1000000
"""

from __future__ import annotations

import argparse
import heapq
import json
import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from arguments import positive
from numpy.typing import NDArray
from tables import aligned

Times = NDArray[np.float64]
HOUR = 3600.0
# share of a day's players by hour: an evening of a game whose players live in one region, 1.9 times the mean at most
_DAY = [28, 18, 12, 9, 8, 10, 15, 22, 28, 33, 37, 41, 45, 46, 47, 50, 56, 64, 72, 78, 79, 74, 64, 44]
DAY = np.array(_DAY) / sum(_DAY)
BREAKS = (1.0, 1.25, 1.5, 1.75, 2.0)  # times the players


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Seconds of a processor, MB and bytes; the defaults are of a machine that others used too."""

    payload: float = 0.0055  # of a server: a kept payload
    edit: float = 0.012  # of a server: a slider edit
    photo: float = 0.05  # of a server: a photo, its job and what is asked about it
    session_edit: float = 0.5  # of a session: sliders -> payload
    session_open: float = 2.5
    fit: float = 9.8  # of a worker: docs/benchmarks.md
    server_mb: float = 110.0
    session_mb: float = 280.0
    worker_mb: float = 1100.0
    person_bytes: float = 602.0
    face_bytes: float = 13e6  # a person that is kept with its textures

    @classmethod
    def of(cls, load: dict[str, Any]) -> Measured:
        """From the JSON of `serve_load.py`."""
        one = load["alone"]
        photos = [job["report"] for job in load["photos"] if job["state"] == "done"]
        found = {
            "payload": one["payload"]["server_ms"] / 1e3,
            "edit": one["sliders"]["server_ms"] / 1e3,
            "session_edit": one["sliders"]["sessions_ms"] / 1e3,
            "session_open": float(np.median(load["cold"]["sliders"])),
            "session_mb": load["session_mb"],
        }
        if photos:
            found |= {"fit": float(np.median([report["seconds"] for report in photos]))}
            found |= {"worker_mb": max(report["peak_mb"] for report in photos)}
        return cls(**found)


@dataclass(frozen=True, kw_only=True)
class Habits:
    """What a player does in a day."""

    payloads: int = 20  # persons of others
    photo: float = 0.2  # share of players
    edits: float = 0.1  # share of players who edit sliders on the server
    edits_each: int = 10
    pause: float = 4.0  # seconds between edits, on average


@dataclass(frozen=True, kw_only=True)
class Machines:
    """What is bought."""

    servers: int
    session_cores: int
    sessions: int  # that memory holds
    workers: int
    mtbf: float = 24 * HOUR  # of a worker
    notice: float = 60.0  # seconds until a lost worker's photo starts again
    away: float = 300.0  # until there is another worker


# seconds in which 99 of a hundred are to be answered; an opening is the first edit of a session
AIMS = {"payload": 0.25, "edit": 0.25, "opening": 10.0, "photo": 60.0}


def one_server(arrivals: Times, services: Times) -> Times:
    """Waits (n,) at one server that takes the first first: Lindley's recursion, summed up, so that it is one pass.

    A departure is S_n + max over k <= n of (A_k - S_(k-1)), with S the sum of services.
    """
    done = np.cumsum(services)
    departures = done + np.maximum.accumulate(arrivals - (done - services))
    return np.maximum(0.0, departures - services - arrivals)


def many_servers(
    arrivals: Sequence[float],
    services: Sequence[float],
    count: int,
    rng: np.random.Generator | None = None,
    machines: Machines | None = None,
) -> Times:
    """Waits (n,) until the last start, at servers that take the first first.

    :param arrivals: in order
    :param machines: when servers are lost, and what happens then; None: they never are
    """
    free = [0.0] * count
    again: list[tuple[float, int]] = []
    waits, number, total = np.zeros(len(arrivals)), 0, len(arrivals)
    while number < total or again:
        if again and (number == total or again[0][0] <= arrivals[number]):
            at, job = heapq.heappop(again)
        else:
            at, job = arrivals[number], number
            number += 1
        start = max(at, heapq.heappop(free))
        waits[job] = start - arrivals[job]
        end = start + services[job]
        if machines is not None and rng is not None:
            lost = start + rng.exponential(machines.mtbf)
            if lost < end:
                heapq.heappush(again, (lost + machines.notice, job))
                end = lost + machines.away
        heapq.heappush(free, end)
    return waits


def players_in(rng: np.random.Generator, players: float, hours: Sequence[int]) -> Times:
    """When players come, in order."""
    counts = [rng.poisson(players * DAY[hour]) for hour in hours]
    times = [HOUR * (hour + rng.random(count)) for hour, count in zip(hours, counts, strict=True)]
    return np.sort(np.concatenate(times))


def edits_of(rng: np.random.Generator, begins: Times, habits: Habits) -> tuple[Times, NDArray[np.int64]]:
    """When edits come, in order, and of which player each is."""
    pauses = rng.exponential(habits.pause, (len(begins), habits.edits_each))
    times = (begins[:, None] + np.cumsum(pauses, axis=1)).ravel()
    order = np.argsort(times)
    return times[order], (order // habits.edits_each).astype(np.int64)


def is_cold(owners: NDArray[np.int64], room: int) -> NDArray[np.bool_]:
    """(n,) edits that find no open session; the one used least lately makes room."""
    warm: OrderedDict[int, None] = OrderedDict()
    cold = np.zeros(len(owners), bool)
    for number, owner in enumerate(owners.tolist()):
        cold[number] = owner not in warm
        warm[owner] = None
        warm.move_to_end(owner)
        if len(warm) > room:
            warm.popitem(last=False)
    return cold


def simulate(
    measured: Measured, habits: Habits, machines: Machines, players: float, hours: Sequence[int], seed: int = 0
) -> dict[str, Any]:
    """Seconds from request to answer by kind, and how busy stations are, over some hours of a day."""
    rng = np.random.default_rng(seed)
    came = players_in(rng, players, hours)
    spread = rng.random((len(came), habits.payloads)) * 600.0  # over ten minutes of play
    payloads = (came[:, None] + spread).ravel()
    photos = np.sort(came[rng.random(len(came)) < habits.photo] + 5.0)
    edits, owners = edits_of(rng, came[rng.random(len(came)) < habits.edits], habits)
    cold = is_cold(owners, machines.sessions)
    at = np.concatenate([payloads, photos, edits])
    kinds = np.repeat(np.arange(3), [len(payloads), len(photos), len(edits)])
    order = np.argsort(at)
    at, kinds = at[order], kinds[order]
    service = np.array([measured.payload, measured.photo, measured.edit])[kinds]
    waits, where = np.zeros(len(at)), rng.integers(0, machines.servers, len(at))
    for server in range(machines.servers):
        own = np.flatnonzero(where == server)
        waits[own] = one_server(at[own], service[own])
    through = waits + service
    on_session = np.where(cold, measured.session_open, 0.0) + measured.session_edit
    edit_waits = many_servers(edits.tolist(), on_session.tolist(), machines.session_cores)
    edited = through[kinds == 2] + edit_waits + on_session
    fits = np.full(len(photos), measured.fit)
    photo_waits = many_servers(photos.tolist(), fits.tolist(), machines.workers, rng, machines)
    seconds = HOUR * len(hours)
    return {
        "players": len(came),
        "seconds": {
            "payload": through[kinds == 0],
            "edit": edited[~cold],
            "opening": edited[cold],
            "photo": through[kinds == 1] + photo_waits + fits,
        },
        "cold": float(cold.mean()) if len(cold) else 0.0,
        "busy": {
            "servers": service.sum() / seconds / machines.servers,
            "session cores": on_session.sum() / seconds / machines.session_cores,
            "workers": fits.sum() / seconds / machines.workers,
        },
    }


def bought(measured: Measured, habits: Habits, players: float, load: float) -> Machines:
    """Machines that are busy to a share of their time in the busiest hour."""
    rate = players * DAY.max() / HOUR
    edits = rate * habits.edits * habits.edits_each
    server = rate * (habits.payloads * measured.payload + habits.photo * measured.photo) + edits * measured.edit
    session = edits * measured.session_edit + rate * habits.edits * measured.session_open
    open_at_once = rate * habits.edits * habits.edits_each * habits.pause
    return Machines(
        servers=math.ceil(server / load),
        session_cores=math.ceil(session / load),
        sessions=math.ceil(1.5 * open_at_once),  # half as many again: those that are left stay until others need room
        workers=math.ceil(rate * habits.photo * measured.fit / load),
    )


def missed(found: dict[str, Any]) -> list[str]:
    """What waits longer than it should."""
    return [kind for kind, aim in AIMS.items() if np.percentile(found["seconds"][kind], 99) > aim]


def lines(measured: Measured, habits: Habits, machines: Machines, day: dict[str, Any], steps: Any) -> list[str]:
    """The tables."""
    rows = [("seconds", "", "median", "99 %", "largest", "aim of 99 %")]
    for kind, one in day["seconds"].items():
        p50, p99 = np.percentile(one, (50, 99))
        rows.append((kind, f"{len(one):,}", f"{p50:.3f}", f"{p99:.3f}", f"{one.max():.1f}", f"{AIMS[kind]:g}"))
    memory = machines.servers * measured.server_mb + machines.sessions * measured.session_mb
    memory += machines.workers * measured.worker_mb
    cores = machines.servers + machines.session_cores + machines.workers
    players = day["players"]
    used = habits.payloads * measured.payload + habits.photo * (measured.photo + measured.fit)
    used += habits.edits * (measured.session_open + habits.edits_each * (measured.edit + measured.session_edit))
    sent = habits.payloads * measured.person_bytes + habits.photo * measured.face_bytes
    told = aligned(rows)
    per_face, kept = measured.photo + measured.fit, measured.face_bytes * habits.photo * players
    told += [
        f"{machines.servers} servers, {machines.session_cores} cores for {machines.sessions} sessions, "
        f"{machines.workers} workers: {cores} cores, {memory / 1e3:,.0f} GB of memory",
        "busy over the day: " + ", ".join(f"{name} {share:.0%}" for name, share in day["busy"].items()),
        f"edits that open a session: {day['cold']:.1%}",
        f"a player: {used:.2f} s of a core, {sent / 1e3:,.0f} kB sent; a thousand players: "
        f"{24e3 * cores / players:.2f} core hours",
        f"a face of a photo: {per_face:.1f} s of a core, {measured.face_bytes / 1e6:.0f} MB of disk; "
        f"{kept / 1e12:.1f} TB a day where all are kept",
    ]
    for factor, late in steps:
        how = f"missed: {', '.join(late)}" if late else "held"
        told.append(f"{factor:g} times the players in the busiest hours: {how}")
    return told


def main() -> None:
    """Buy, simulate, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--players", type=positive, default=1_000_000, help="a day")
    parser.add_argument("--load", type=float, default=0.7, help="of machines in the busiest hour")
    parser.add_argument("--measured", type=Path, metavar="JSON", help="of serve_load.py")
    for one in fields(Habits):
        kind: Any = type(one.default)
        text = f"(default {one.default})"
        parser.add_argument(f"--{one.name.replace('_', '-')}", type=kind, default=one.default, help=text)
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    given = parser.parse_args()
    measured = Measured.of(json.loads(given.measured.read_text())) if given.measured else Measured()
    habits = replace(Habits(), **{one.name: getattr(given, one.name) for one in fields(Habits)})
    machines = bought(measured, habits, given.players, given.load)
    day = simulate(measured, habits, machines, given.players, range(24))
    peak, steps = int(np.argmax(DAY)), []
    for factor in BREAKS:
        late = missed(simulate(measured, habits, machines, factor * given.players, range(peak - 1, peak + 2)))
        steps.append((factor, late))
    print("\n".join(lines(measured, habits, machines, day, steps)))
    if given.json:
        spread = {kind: np.percentile(one, (50, 95, 99)).tolist() for kind, one in day["seconds"].items()}
        told = {"machines": asdict(machines), "measured": asdict(measured), "habits": asdict(habits), "seconds": spread}
        told |= {name: day[name] for name in ("players", "cold", "busy")} | {"steps": steps}
        given.json.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
