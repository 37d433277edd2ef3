"""A store that speaks S3 over HTTP on this machine (moto), counts what it is asked, and can cut connections."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import make_server


class S3Server:
    """The application, with a gate before it."""

    def __init__(self) -> None:
        self._application = DomainDispatcherApplication(create_backend_app)
        self.address = ""
        self.asked: list[str] = []  # "GET /show/heads/ada.bin"
        self.cuts: dict[str, Callable[[], bool]] = {}  # request -> whether it loses its connection

    def __call__(self, environ: dict[str, Any], start_response: Any) -> Any:
        request = f"{environ['REQUEST_METHOD']} {environ['PATH_INFO']}"
        self.asked.append(request)
        if request in self.cuts and self.cuts[request]():
            environ["werkzeug.socket"].shutdown(socket.SHUT_RDWR)
            raise ConnectionAbortedError
        return self._application(environ, start_response)


@contextlib.contextmanager
def serving() -> Iterator[S3Server]:
    """The server, while the block lasts."""
    server = S3Server()
    http = make_server("127.0.0.1", 0, server, threaded=True)
    server.address = f"http://127.0.0.1:{http.server_port}"
    threading.Thread(target=http.serve_forever, daemon=True).start()
    try:
        yield server
    finally:
        http.shutdown()
