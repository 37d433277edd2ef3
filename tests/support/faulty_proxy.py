"""A proxy between a client of HTTP and its server, both on this machine, which spoils chosen requests."""

from __future__ import annotations

import contextlib
import re
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import IO
from urllib.parse import urlsplit

Spoil = Callable[["Exchange"], None]
_ANSWER = b"HTTP/1.1 %d Spoilt\r\nContent-Type: application/xml\r\nContent-Length: %d\r\nConnection: close\r\n\r\n%s"


@dataclass
class Exchange:
    """A request whose head has arrived, and both ends."""

    client: socket.socket
    sent: IO[bytes]  # by the client
    head: bytes
    server: tuple[str, int]

    @property
    def length(self) -> int:
        """Bytes of the request's body."""
        return _length(self.head)

    def body(self) -> bytes:
        """All that the client sends."""
        if b"\nexpect: 100-continue" in self.head.lower():
            self.client.sendall(b"HTTP/1.1 100 Continue\r\n\r\n")
        return self.sent.read(self.length)

    def answer(self) -> tuple[bytes, bytes]:
        """Head and body of what the server answers to the whole request."""
        lines = [one for one in self.head.split(b"\r\n") if not one.lower().startswith((b"expect:", b"connection:"))]
        lines.insert(1, b"Connection: close")
        with socket.create_connection(self.server) as upstream:
            upstream.sendall(b"\r\n".join(lines) + self.body())
            with upstream.makefile("rb") as read:
                head = _head(read)
                return head, b"" if self.head.startswith(b"HEAD ") else read.read(_length(head))


def passed(one: Exchange) -> None:
    """As it is."""
    one.client.sendall(b"".join(one.answer()))


def body_cut(one: Exchange) -> None:
    """The server gets half the body, and both lose the connection."""
    if b"\nexpect: 100-continue" in one.head.lower():
        one.client.sendall(b"HTTP/1.1 100 Continue\r\n\r\n")
    half = one.sent.read(one.length // 2)
    with socket.create_connection(one.server) as upstream:
        upstream.sendall(one.head.replace(b"100-continue", b"") + half)
        upstream.shutdown(socket.SHUT_WR)
        while upstream.recv(1 << 16):
            pass


def answer_lost(one: Exchange) -> None:
    """The server has done it, and the client never hears."""
    one.answer()


def answer_cut(one: Exchange) -> None:
    """Half the body of the answer, and the end of the connection."""
    head, body = one.answer()
    one.client.sendall(head + body[: len(body) // 2])


def answer_cut_unseen(one: Exchange) -> None:
    """The same, without a length in the head: the end of the connection is that of the body."""
    head, body = one.answer()
    lines = (line for line in head.split(b"\r\n") if not line.lower().startswith((b"content-length:", b"x-amz-check")))
    one.client.sendall(b"\r\n".join(lines) + body[: len(body) // 2])


def refused(status: int, code: str) -> Spoil:
    """An error of the store."""

    def spoil(one: Exchange) -> None:
        one.body()
        text = f"<Error><Code>{code}</Code><Message>spoilt</Message></Error>".encode()
        text = b"" if one.head.startswith(b"HEAD ") else text
        one.client.sendall(_ANSWER % (status, len(text), text))

    return spoil


class FaultyProxy:
    """One request a connection."""

    def __init__(self, server: str) -> None:
        """:param server: its address"""
        found = urlsplit(server)
        self._server = str(found.hostname), int(found.port or 80)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self.faults: dict[str, list[Spoil]] = {}  # pattern of "PUT /show/ada.bin" -> for the first such requests
        self._lock, self.over = threading.Lock(), threading.Event()
        threading.Thread(target=self._listen, daemon=True).start()

    def close(self) -> None:
        """Take no more, and let go of what waits."""
        self.over.set()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def hung(self, one: Exchange) -> None:
        """Nothing is read nor answered, until the proxy is closed."""
        self.over.wait()

    def _listen(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with contextlib.suppress(OSError), client, client.makefile("rb") as sent:
            head = _head(sent)
            if not head:
                return
            method, path = head.decode("latin-1").split(" ", 2)[:2]
            with self._lock:
                faults = [one for pattern, one in self.faults.items() if re.fullmatch(pattern, f"{method} {path}")]
                spoil = next((one.pop(0) for one in faults if one), passed)
            spoil(Exchange(client, sent, head, self._server))


def _head(read: IO[bytes]) -> bytes:
    lines = []
    for line in read:
        lines.append(line)
        if line == b"\r\n":
            return b"".join(lines)
    return b""


def _length(head: bytes) -> int:
    named = (line.partition(b":") for line in head.split(b"\r\n"))
    return next((int(value) for name, _, value in named if name.lower() == b"content-length"), 0)


@contextlib.contextmanager
def spoiling(server: str) -> Iterator[FaultyProxy]:
    """The proxy, while the block lasts."""
    proxy = FaultyProxy(server)
    try:
        yield proxy
    finally:
        proxy.close()
