"""The server of the page: 127.0.0.1 alone, a fixed list of files, no folders."""

from __future__ import annotations

import errno
import os
import socketserver
import sys
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from facepipe.errors import FacepipeError, InputError

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


class Server(ThreadingHTTPServer):
    """Gives out `files` by their exact paths, and calls `actions` with what is posted to theirs."""

    daemon_threads = True
    allow_reuse_address = os.name != "nt"  # there it would share a port that is in use

    def __init__(self, port: int, files: Mapping[str, Path], actions: Mapping[str, Action]) -> None:
        """:raises InputError: a port that is in use, or that this user may not take"""
        self.files, self.actions = dict(files), dict(actions)
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

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes away is no error."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: Server
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "facepipe", ""
    timeout = 60  # seconds that a silent connection is kept

    def do_GET(self) -> None:
        """A file of the list."""
        self._answer(self._file)

    do_HEAD = do_GET  # noqa: N815

    def do_POST(self) -> None:
        """An action of the list."""
        self._answer(self._action)

    def log_message(self, *_: object) -> None:
        """Nothing is logged."""

    def _answer(self, find: Callable[[], tuple[int, str, bytes]]) -> None:
        own = {f"{host}:{self.server.server_port}" for host in (HOST, "localhost")}
        if self.headers.get("Host") not in own or self.headers.get("Origin") not in (
            None,
            *(f"http://{one}" for one in own),
        ):
            status, kind, content = 403, "text/plain", b"not for other sites\n"  # a name that others point here
            self.close_connection = True
        else:
            status, kind, content = find()
        self.send_response(status)
        for name, value in {**_HEADERS, "Content-Type": kind, "Content-Length": str(len(content))}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

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
        if action is None or not length.isdecimal() or int(length) > _MOST_BYTES:
            self.close_connection = True  # what was sent is not read
            return (404 if action is None else 413), "text/plain", b"not taken\n"
        sent = self.rfile.read(int(length))
        if self.headers.get_content_type() != "application/json":
            return 415, "text/plain", b"expected application/json\n"
        try:
            return 200, *action(sent)
        except FacepipeError as error:
            return 400, "text/plain; charset=utf-8", str(error).encode()
