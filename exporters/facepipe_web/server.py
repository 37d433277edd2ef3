"""The server of the page: 127.0.0.1 alone, a fixed list of files, no folders."""

from __future__ import annotations

import contextlib
import contextvars
import errno
import http.client
import math
import os
import socket
import socketserver
import sys
import threading
import time
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BufferedIOBase
from pathlib import Path
from typing import Any

from facepipe.core.errors import FacepipeError, InputError

HOST = "127.0.0.1"
Answer = tuple[str, bytes]  # MIME type and content
Action = Callable[[bytes], Answer]

_TYPES = {
    ".bin": "application/octet-stream",
    ".css": "text/css; charset=utf-8",
    ".glb": "model/gltf-binary",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".mjs": "text/javascript; charset=utf-8",
    ".onnx": "application/octet-stream",
    ".ts": "text/plain; charset=utf-8",
    ".txt": "text/plain; charset=utf-8",
    ".wasm": "application/wasm",
}
_HEADERS = {
    "Cache-Control": "no-cache",
    "Content-Security-Policy": "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self' blob:; "
    "img-src 'self' data: blob:; connect-src 'self' data: blob:; object-src 'none'; frame-ancestors 'none'",
    "Cross-Origin-Embedder-Policy": "require-corp",  # these two let WebAssembly use threads
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
}
_MOST_BYTES = 1 << 20  # of what a page may send
_MOST_HEAD = 1 << 16  # bytes of a request's headers
MOST_CONNECTIONS = 32  # at once: browsers open six for a page
PATIENCE = 30.0  # seconds that a request may take to arrive, and a connection to wait for the next


class Server(ThreadingHTTPServer):
    """Gives out `files` by their exact paths, and calls `actions` with what is posted to theirs.

    Connections are few, each with a thread: where there are too many, the one that has stood still longest is closed
    for a new one.
    """

    daemon_threads = True
    request_queue_size = 128
    allow_reuse_address = os.name != "nt"  # there it would share a port that is in use

    def __init__(self, port: int, files: Mapping[str, Path], actions: Mapping[str, Action]) -> None:
        """:raises InputError: a port that is in use, or that this user may not take"""
        self.files, self.actions = dict(files), dict(actions)
        self._lock = threading.Lock()
        self._context = contextvars.copy_context()  # of who made it: its policy towards files counts in all threads
        self._waiting: dict[socket.socket, float] = {}  # since when for a request, infinity: it is being answered
        try:
            super().__init__((HOST, port), _Handler)
        except (OSError, OverflowError) as error:
            used = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
            what = "is in use" if used else f"can't be taken ({getattr(error, 'strerror', None) or error})"
            raise InputError(f"--port {port}", f"{what}, expected a free one (0 takes any)") from None

    def server_bind(self) -> None:
        """Bind without asking for the machine's name, which can take seconds."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = HOST, self.socket.getsockname()[1]

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self.server_port}/"

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a connection in a thread, in place of another where there are too many."""
        with self._lock:
            if len(self._waiting) >= MOST_CONNECTIONS:
                self._end(next(iter(self._waiting)))
            self._waiting[request] = time.monotonic()
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer in this thread."""
        self._context.copy().run(super().process_request_thread, request, client_address)

    def went_on(self, connection: socket.socket, *, waiting: bool) -> None:
        """Note that a connection has read a request, or answered one and is `waiting` for the next."""
        with self._lock:
            if self._waiting.pop(connection, None) is not None:
                self._waiting[connection] = time.monotonic() if waiting else math.inf  # the last now

    def service_actions(self) -> None:
        """Close the connections whose request has not come in time."""
        with self._lock:
            latest = time.monotonic() - PATIENCE
            for late in [one for one, since in self._waiting.items() if since < latest]:
                self._end(late)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            self._waiting.pop(request, None)
        super().shutdown_request(request)

    def _end(self, connection: socket.socket) -> None:
        """Let the thread of a connection find it closed."""
        del self._waiting[connection]
        with contextlib.suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes away is no error."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: Server
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "facepipe", ""
    timeout = PATIENCE

    def do_GET(self) -> None:
        """A file of the list."""
        self._answer(self._file)

    do_HEAD = do_GET  # noqa: N815

    def do_POST(self) -> None:
        """An action of the list."""
        self._answer(self._action)

    def log_message(self, *_: object) -> None:
        """Nothing is logged."""

    def parse_request(self) -> bool:
        """Read the headers, as many bytes as they may have."""
        whole, self.rfile = self.rfile, _Head(self.rfile)  # type: ignore[assignment]
        try:
            return super().parse_request()
        finally:
            self.rfile = whole

    def _answer(self, find: Callable[[], tuple[int, str, bytes]]) -> None:
        refused = self._refused()
        status, kind, content = refused or find()
        if refused or (self.command != "POST" and "Content-Length" in self.headers):
            self.close_connection = True  # what was sent is not read
        self.server.went_on(self.connection, waiting=False)
        self.send_response(status)
        for name, value in {**_HEADERS, "Content-Type": kind, "Content-Length": str(len(content))}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)
        self.server.went_on(self.connection, waiting=True)

    def _refused(self) -> tuple[int, str, bytes] | None:
        """The answer to a request that is not from our own page."""
        hosts, origins, lengths = (self.headers.get_all(one, []) for one in ("Host", "Origin", "Content-Length"))
        if len(hosts) != 1 or max(len(origins), len(lengths)) > 1 or "Transfer-Encoding" in self.headers:
            return 400, "text/plain", b"expected one Host, and at most one Origin and Content-Length\n"
        own = {f"{host}:{self.server.server_port}" for host in (HOST, "localhost")}
        if hosts[0] not in own or not {*origins} <= {f"http://{one}" for one in own}:
            return 403, "text/plain", b"not for other sites\n"  # a name that others point here
        return None

    def _file(self) -> tuple[int, str, bytes]:
        file = self.server.files.get(self.path.partition("?")[0])
        if file is None:
            return 404, "text/plain", b"no such file\n"
        try:
            content = file.read_bytes()
        except OSError:
            return 404, "text/plain", b"the file is gone\n"
        return 200, _TYPES.get(file.suffix.lower(), "application/octet-stream"), content

    def _action(self) -> tuple[int, str, bytes]:
        action = self.server.actions.get(self.path)
        length = self.headers.get("Content-Length", "")
        if action is None or not length.isdecimal() or len(length) > 9 or int(length) > _MOST_BYTES:
            self.close_connection = True  # what was sent is not read
            return (404 if action is None else 413), "text/plain", b"not taken\n"
        sent = self.rfile.read(int(length))
        self.server.went_on(self.connection, waiting=False)
        if self.headers.get_content_type() != "application/json":
            return 415, "text/plain", b"expected application/json\n"
        try:
            return 200, *action(sent)
        except FacepipeError as error:
            return 400, "text/plain; charset=utf-8", str(error).encode()


class _Head:
    """The lines of a request's headers, up to `_MOST_HEAD` bytes."""

    def __init__(self, file: BufferedIOBase) -> None:
        self._file, self._left = file, _MOST_HEAD

    def readline(self, limit: int) -> bytes:
        line = self._file.readline(limit)
        self._left -= len(line)
        if self._left < 0:
            raise http.client.LineTooLong("headers")
        return line
