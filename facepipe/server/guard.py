"""What every request passes first: of whose page it is, who asks, how often, how much is sent; and what is told of it.

Nothing that could name a face or a person is logged or counted: of a request its method, the pattern of its path, its
status and its time.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import time
from collections import OrderedDict, defaultdict
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from typing import Any

from starlette.exceptions import HTTPException

from facepipe.server.refusals import ForeignError, RefusedError, TooLargeError, TooManyError, UnauthorisedError
from facepipe.server.tables import Database, DatabaseError
from facepipe.server.tenants import tenant_of

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
API = "/api/v1"
_OPEN = (f"{API}/openapi.json",)  # that say nothing of anybody
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self' blob:; "
    "img-src 'self' data: blob:; connect-src 'self' data: blob:; object-src 'none'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Embedder-Policy": "require-corp",  # these two let WebAssembly use threads
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(self), microphone=(), geolocation=()",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
_MOST_JSON = 1 << 20  # bytes
_MOST_PHOTO = 1 << 25
_PATIENCE = 30.0  # seconds for the next piece of a body
_CLIENTS = 10_000  # whose rates are known
_log = logging.getLogger("facepipe.server")


@dataclass(frozen=True, kw_only=True)
class Gate:
    """What a server lets through."""

    hosts: frozenset[str]  # that it is called by, with ports: "127.0.0.1:8000"
    origins: frozenset[str]  # of its own pages: "http://127.0.0.1:8000"
    needs_token: bool
    local: str  # tenant of who needs none
    rate: float  # requests a second of a client
    upload_bytes: int


class Rates:
    """A bucket a client, which holds the requests of some seconds."""

    def __init__(self, rate: float, seconds: float = 10.0) -> None:
        self._rate, self._most = rate, rate * seconds
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, client: str) -> bool:
        """Whether a client may ask now."""
        now = time.monotonic()
        left, since = self._left.pop(client, (self._most, now))
        left = min(self._most, left + (now - since) * self._rate)
        self._left[client] = (max(0.0, left - 1.0), now)
        if len(self._left) > _CLIENTS:
            self._left.popitem(last=False)
        return left >= 1.0


class Metrics:
    """Counts of requests and their seconds, for Prometheus."""

    def __init__(self) -> None:
        self._requests: defaultdict[tuple[str, str, int], list[float]] = defaultdict(lambda: [0, 0.0])

    def add(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count a request."""
        counted = self._requests[method, route, status]
        counted[0] += 1
        counted[1] += seconds

    def text(self, jobs: dict[str, int]) -> str:
        """As Prometheus reads it.

        :param jobs: how many there are by state
        """
        lines = ["# TYPE facepipe_request_seconds summary"]
        for (method, route, status), (count, seconds) in sorted(self._requests.items()):
            said = f'method="{method}",route="{route}",status="{status}"'
            lines.append(f"facepipe_request_seconds_count{{{said}}} {count}")
            lines.append(f"facepipe_request_seconds_sum{{{said}}} {seconds:.6f}")
        lines.append("# TYPE facepipe_jobs gauge")
        lines += [f'facepipe_jobs{{state="{state}"}} {count}' for state, count in sorted(jobs.items())]
        return "\n".join(lines) + "\n"


class Guard:
    """An ASGI application around another."""

    def __init__(self, app: Any, gate: Gate, database: Database, metrics: Metrics) -> None:
        self._app, self._gate, self._database, self._metrics = app, gate, database, metrics
        self._rates = Rates(gate.rate)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through, or say why not."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        start, status = time.perf_counter(), 0
        limit = self._limit(scope["path"])

        async def sent(message: MutableMapping[str, Any]) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                message["headers"] = [*message.get("headers", ()), *_headers(scope["path"])]
            await send(message)

        try:
            self._check_page(scope)
            tenant = await self._tenant(scope)
            if limit is not None and _length(scope) > limit:
                raise TooLargeError("body", f"expected at most {limit} bytes")
            scope.setdefault("state", {}).update(tenant=tenant, tenant_of=self.tenant)
            await self._app(scope, _limited(receive, limit) if limit is not None else receive, sent)
        except (RefusedError, DatabaseError) as error:
            status = getattr(error, "status", 503)
            await _refuse(scope, sent, status, str(error))
        finally:
            if scope["type"] == "http":
                seconds = time.perf_counter() - start
                method = scope["method"] if scope["method"] in ("GET", "POST", "PATCH", "DELETE", "HEAD") else "OTHER"
                route = getattr(scope.get("route"), "path", "none").removeprefix(API)  # which older FastAPIs have in it
                self._metrics.add(method, route, status, seconds)
                told = {"method": method, "route": route, "status": status, "ms": round(seconds * 1e3, 1)}
                _log.info("request", extra={"told": told})

    def _limit(self, path: str) -> int | None:
        """Bytes that may be sent to a path."""
        if path in (f"{API}/faces", f"{API}/files"):
            return self._gate.upload_bytes
        return _MOST_PHOTO if path == f"{API}/photos" else _MOST_JSON

    def _check_page(self, scope: Scope) -> None:
        """A name that others point here is none of ours, and a page of others may not even ask.

        :raises RefusedError: for other sites
        """
        hosts, origins, sites = (_values(scope, name) for name in (b"host", b"origin", b"sec-fetch-site"))
        if len(hosts) != 1 or len(origins) > 1 or hosts[0].lower() not in self._gate.hosts:
            raise ForeignError("Host", "is none of this server's")
        if not {*origins} <= self._gate.origins or not {*sites} <= {"same-origin", "none"}:
            raise ForeignError("Origin", "is none of this server's")

    async def _tenant(self, scope: Scope) -> str | None:
        """Who asks; of a websocket the first message says it, and of a page nobody has to.

        :raises RefusedError: a wrong token, or none where one is needed; or too many requests
        """
        address = (scope.get("client") or ("", 0))[0]
        is_api = scope["path"].startswith(f"{API}/") and scope["path"] not in _OPEN
        given = _values(scope, b"authorization")
        token = given[0].partition(" ")[2].strip() if given and given[0].lower().startswith("bearer ") else None
        client = address if token is None else hashlib.sha256(token.encode()).hexdigest()
        if not self._rates.take(client):
            raise TooManyError("client", "asks too often, expected a pause")
        if scope["type"] == "websocket" or not (is_api or scope["path"] == "/metrics"):
            return None
        return await self.tenant(token)

    async def tenant(self, token: str | None) -> str:
        """The tenant of a token, or who needs none.

        :raises UnauthorisedError: a wrong token, or none where one is needed
        """
        if token is None and not self._gate.needs_token:
            return self._gate.local
        found = None if token is None else await asyncio.to_thread(tenant_of, self._database, token)
        if found is None:
            raise UnauthorisedError("token", "is none of this server's, expected Authorization: Bearer TOKEN")
        return found


def _values(scope: Scope, name: bytes) -> list[str]:
    return [value.decode("latin-1") for key, value in scope["headers"] if key == name]


def _length(scope: Scope) -> int:
    said = _values(scope, b"content-length")
    return int(said[0]) if said and said[0].isdecimal() else 0


def _headers(path: str) -> list[tuple[bytes, bytes]]:
    kept = "no-store" if path.startswith(API) or path in ("/health", "/ready", "/metrics") else "no-cache"
    return [(name.lower().encode(), value.encode()) for name, value in {**_HEADERS, "Cache-Control": kept}.items()]


def _limited(receive: Receive, limit: int) -> Receive:
    """What is sent, as far as it may be: a body whose length nobody has said can be longer, or never end."""
    taken = 0

    async def received() -> MutableMapping[str, Any]:
        nonlocal taken
        if taken < 0:  # all is here: what comes next is the end of the connection, whenever that is
            return await receive()
        try:
            message = await asyncio.wait_for(receive(), _PATIENCE)
        except TimeoutError:
            raise HTTPException(408, f"body: nothing came for {_PATIENCE:g} seconds") from None
        taken += len(message.get("body", b""))
        if taken > limit:
            raise HTTPException(413, f"body: expected at most {limit} bytes")
        if not message.get("more_body"):
            taken = -1
        return message

    return received


async def _refuse(scope: Scope, send: Send, status: int, why: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": "refused"})  # before it is accepted: HTTP's 403
        return
    headers = [(b"content-type", b"application/json")]
    headers += [(b"www-authenticate", b"Bearer")] if status == 401 else []
    headers += [(b"retry-after", b"1")] if status in (429, 503) else []
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": json.dumps({"error": why}).encode()})
