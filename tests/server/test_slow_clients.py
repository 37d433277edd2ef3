"""Clients that ask for little, slowly, or go in the middle: others are answered, and nothing of them is left."""

from __future__ import annotations

import asyncio
import json
import socket
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from served import Serve, Served, kept, saved, sent
from small_sources import made
from websockets.sync.client import connect

from facepipe.server.serve_command import _listening
from facepipe.server.settings import Settings

HEAD = b"Host: %s\r\nX-Facepipe-Consent: 1\r\n"
PATIENCE = 200.0  # seconds; a server waits for 30
GROWTH = 64e6  # bytes
REQUESTS, CLIENTS = 10_000, 20


def opened(served: Served, start: bytes) -> socket.socket:
    """A connection over which a request was begun."""
    url = httpx.URL(served.url)
    one = socket.create_connection((url.host, url.port or 80))
    one.settimeout(PATIENCE)
    one.sendall(start + HEAD % url.netloc)
    return one


def until(holds: Callable[[], bool]) -> None:
    start = time.monotonic()
    while not holds():
        assert time.monotonic() - start < PATIENCE
        time.sleep(0.1)


def test_an_end_of_an_answer_does_not_wait_for_who_reads_its_start() -> None:
    """Between two writes Nagle's algorithm waits for an acknowledgement, which others hold back for 40 ms."""
    told = []

    def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        told.append(writer.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
        writer.close()

    async def served() -> None:
        with _listening(Settings(port=0)) as listening:
            async with await asyncio.start_server(connected, sock=listening):
                reader, writer = await asyncio.open_connection(*listening.getsockname())
                await reader.read()
                writer.close()

    asyncio.run(served())
    assert told[0]


@pytest.mark.slow
def test_ten_thousand_tiny_requests_are_all_answered_and_leave_nothing(serve: Serve) -> None:
    served = serve("--processes", "1", "--rate", "1000000")
    paths = ("/health", "/api/v1/faces", f"/api/v1/jobs/{'0' * 24}", "/none", "/api/v1/actions?x=1", "/api/v1/me")

    def ask(number: int) -> Counter[int]:
        with served.asked_with() as client:
            return Counter(client.get(paths[(number + one) % len(paths)]).status_code for one in range(share))

    def asked() -> Counter[int]:
        with ThreadPoolExecutor(CLIENTS) as pool:
            return sum(pool.map(ask, range(CLIENTS)), Counter())

    process, share = psutil.Process(served.process.pid), REQUESTS // CLIENTS // 10
    asked()
    before, share = process.memory_info().rss, REQUESTS // CLIENTS
    statuses = asked()
    assert set(statuses) == {200, 404}
    assert sum(statuses.values()) == REQUESTS
    assert process.memory_info().rss < before + GROWTH
    assert process.num_fds() < 100


@pytest.mark.slow
def test_who_sends_or_reads_too_slowly_is_shut_out_and_others_are_answered(serve: Serve, heads: list[Path]) -> None:
    """A head without an end, a body that does not come, and an answer that nobody reads."""
    served = serve("--processes", "1", "--rate", "1000")
    large = "/ort-wasm-simd-threaded.wasm"  # more than a connection holds by itself
    assert len(served.client.get(large).content) > 8e6
    process = psutil.Process(served.process.pid)
    before = process.num_fds()
    slow = [opened(served, b"GET /health HTTP/1.1\r\n") for _ in range(20)]
    length = b"Content-Length: 100000\r\n\r\n"
    for path in (b"photos", b"faces", b"files?suffix=.csv"):
        one = opened(served, b"POST /api/v1/%s HTTP/1.1\r\nContent-Type: multipart/form-data; boundary=b\r\n" % path)
        one.sendall(length + b"--b\r\n")
        slow.append(one)
    for _ in range(20):
        one = opened(served, b"GET %s HTTP/1.1\r\n" % large.encode())
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        one.sendall(b"\r\n")
        slow.append(one)
    assert served.client.get("/health").status_code == 200
    assert kept(served.client, heads[1])
    answers = [one.recv(1 << 16) for one in slow[20:23]]
    assert [answer.split()[1] for answer in answers] == [b"408"] * 3
    until(lambda: process.num_fds() <= before + 4)
    assert list((served.folder / "uploads").iterdir()) == []
    for one in slow:
        one.close()


def test_an_upload_that_breaks_off_leaves_nothing(serve: Serve) -> None:
    served = serve("--processes", "1")
    for path in (b"photos", b"files?suffix=.csv", b"faces"):
        one = opened(served, b"POST /api/v1/%s HTTP/1.1\r\nContent-Type: multipart/form-data; boundary=b\r\n" % path)
        one.sendall(
            b'Content-Length: 100000\r\n\r\n--b\r\nContent-Disposition: form-data; name="files"; filename="a.obj"'
        )
        one.sendall(b"\r\n\r\n" + bytes(10_000))
        one.close()
    until(lambda: list((served.folder / "uploads").iterdir()) == [])
    assert served.client.get("/health").status_code == 200


@pytest.mark.slow
def test_browsers_that_are_closed_in_the_middle_take_no_place(serve: Serve, tmp_path: Path) -> None:
    """Of sockets there are 64 at most; a session that nobody waits for any more is used by who comes next."""
    served = serve("--processes", "1", "--rate", "1000", "--sessions", "1")
    faces = [kept(served.client, saved(made(seed), tmp_path / f"{seed}.usdc")) for seed in (1, 2)]
    opening = json.dumps({"open": {"blend": {"sources": [{"face": face, "version": 1} for face in faces]}}})
    url = f"{served.url.replace('http', 'ws', 1)}api/v1/edit"
    edit = json.dumps({"n": 1, "weights": {"default": [0.5, 0.5]}})
    own: Any = {"subprotocols": ["facepipe.1"], "proxy": None, "open_timeout": PATIENCE, "close_timeout": 0.1}
    for number in range(70):
        with connect(url, **own) as page:
            page.send(opening)
            if number % 3:
                page.send(edit)
            if number % 3 == 2:
                assert "opened" in str(page.recv(PATIENCE))
            page.socket.shutdown(socket.SHUT_RDWR)
    with connect(url, **own) as page:
        page.send(opening)
        assert "opened" in str(page.recv(PATIENCE))
        page.send(edit)
        assert isinstance(page.recv(PATIENCE), bytes)
    job = sent(served.client, tmp_path / "1.usdc").json()["job"]["id"]
    with served.client.stream("GET", f"/api/v1/jobs/{job}/events") as events:
        next(events.iter_lines())
    assert '"level": "error"' not in served.log.read_text()
