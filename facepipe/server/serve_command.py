"""Keep faces and work on them for browsers and devices: library, edits, photos, an API with live sessions.

FOLDER has all that is kept; --demo takes a temporary one with sample heads. Served is this machine alone, unless --host
says more: then every request needs a token, which `token add` prints. docs/serve.md has the API, what is kept, and how
to run it for many.

examples:
  facepipe serve --demo
  facepipe serve faces
  facepipe serve token add studio faces
  facepipe serve faces --host 0.0.0.0 --tls-cert cert.pem --tls-key key.pem
  facepipe serve faces --database postgresql+psycopg://db/faces --artefacts s3://studio/faces
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import logging
import os
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from facepipe.cli.parser import add_options, options_from
from facepipe.cli.show import emit, note
from facepipe.core.errors import InputError
from facepipe.core.policy.paths import check_written
from facepipe.core.reading import check_input
from facepipe.server.settings import Settings

if TYPE_CHECKING:
    from facepipe.server.app import Address
    from facepipe.server.services import Services

_PATIENCE = 30.0  # seconds for the head of a request
_GRACE = 10  # seconds for requests that are being answered as it ends
_MOST_CONNECTIONS = 1000
_MOST_HEAD = _MOST_TEXT = 1 << 16  # bytes of a request's head, and of a websocket's message
_WILD = ("0.0.0.0", "::")
_DEMO = (1, 2, 3)  # seeds
_TOKEN = "token"


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    help = "where all is kept; or: token add|revoke TENANT [FOLDER], token list [FOLDER]"
    parser.add_argument("words", nargs="*", metavar="FOLDER", help=help)
    parser.add_argument("--demo", action="store_true", help="in a temporary folder, with sample heads")
    parser.add_argument("--json", action="store_true", help="of token list: as JSON")
    add_options(parser, Settings, "how it is run")
    parser.set_defaults(ready=lambda url: None)  # `facepipe view --edit` opens a browser


def run(arguments: argparse.Namespace) -> int:
    """Serve until it is ended, or give out a token."""
    for name in ("fastapi", "sqlalchemy", "uvicorn"):
        if importlib.util.find_spec(name) is None:
            raise InputError("facepipe serve", f"needs {name}: pip install 'facepipe[server]'")
    settings: Settings = options_from(arguments, Settings)
    if arguments.words[:1] == [_TOKEN]:
        return _token(arguments, settings)
    if len(arguments.words) != (0 if arguments.demo else 1):
        raise InputError("FOLDER", f"{len(arguments.words)} words, expected one folder, or --demo alone")
    if (settings.tls_cert is None) != (settings.tls_key is None):
        raise InputError("--tls-cert", "expected --tls-key too, or neither")
    with contextlib.ExitStack() as ends:
        if arguments.demo:
            folder = Path(
                ends.enter_context(tempfile.TemporaryDirectory(prefix="facepipe-", ignore_cleanup_errors=True))
            )
        else:
            folder = _folder(arguments.words[0])
        with contextlib.suppress(KeyboardInterrupt):
            _serve(folder, settings, demo=arguments.demo, ready=arguments.ready)
    return 0


def _folder(word: str) -> Path:
    """:raises InputError: a URL, or a place outside the roots"""
    check_input(Path(word))
    check_written(Path(word))
    return Path(word).absolute()


def _token(arguments: argparse.Namespace, settings: Settings) -> int:
    """Give out, list or take back tokens."""
    from facepipe.server import tenants
    from facepipe.server.app import database_of

    what, *rest = arguments.words[1:] or [""]
    named = {"add": 1, "revoke": 1, "list": 0}
    if what not in named or not named[what] <= len(rest) <= named[what] + 1:
        raise InputError(_TOKEN, "expected add TENANT FOLDER, revoke TENANT FOLDER, or list FOLDER")
    folder = _folder(rest[named[what]]) if len(rest) > named[what] else None
    if folder is None and settings.database is None:
        raise InputError(_TOKEN, "no FOLDER, expected one, or --database")
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    with contextlib.closing(database_of(settings, folder or Path())) as database:
        if what == "add":
            emit({}, tenants.add_token(database, rest[0]), as_json=False)
            note("nobody can show it again: what is kept is its digest")
        elif what == "revoke":
            emit({}, f"{rest[0]}: {tenants.revoke(database, rest[0])} token(s) taken back", as_json=False)
        else:
            found = tenants.tenants(database)
            emit(found, "\n".join(f"{name}: {count} token(s)" for name, count in found.items()), as_json=arguments.json)
    return 0


def _serve(folder: Path, settings: Settings, *, demo: bool, ready: Callable[[str], object]) -> None:
    """:raises InputError: a port, folder, database or cluster that can't be used"""
    import uvicorn

    from facepipe.core.locks import locked
    from facepipe.server.app import create_app, services_in
    from facepipe.server.connection import Connection

    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    with contextlib.ExitStack() as ends:
        ends.enter_context(locked(folder / "server", patience=0.0))
        listening = ends.enter_context(_listening(settings))
        address = _address(settings, listening.getsockname()[1])
        ends.enter_context(_temporary_in(folder / "work"))
        services = services_in(folder, settings)
        ends.callback(services.library.database.close)
        ends.callback(services.runner.close)
        _check_tokens(services, address, settings)
        app = create_app(services, address, settings)
        if demo:
            _add_heads(services)
        own: Any = {"ssl_certfile": settings.tls_cert, "ssl_keyfile": settings.tls_key}
        limits: Any = {"h11_max_incomplete_event_size": _MOST_HEAD, "limit_concurrency": _MOST_CONNECTIONS}
        limits |= {"ws_max_size": _MOST_TEXT}
        quiet: Any = {"log_config": None, "access_log": False, "server_header": False, "proxy_headers": False}
        times: Any = {"timeout_graceful_shutdown": _GRACE, "timeout_keep_alive": int(_PATIENCE)}
        config = uvicorn.Config(app, http=Connection, loop="asyncio", **own, **limits, **quiet, **times)
        _log_lines()
        url = _shown(settings, listening.getsockname()[1])
        emit({}, f"{url}  (Ctrl-C ends)", as_json=False)
        sys.stdout.flush()
        ready(url)
        uvicorn.Server(config).run(sockets=[listening])


@contextlib.contextmanager
def _temporary_in(folder: Path) -> Iterator[None]:
    """Temporary files of this process, and of those that it starts, lie where a server clears them away."""
    before, own = os.environ.get("TMPDIR"), tempfile.tempdir
    os.environ["TMPDIR"] = tempfile.tempdir = str(folder)
    try:
        yield
    finally:
        tempfile.tempdir = own
        if before is None:
            del os.environ["TMPDIR"]
        else:
            os.environ["TMPDIR"] = before


@contextlib.contextmanager
def _listening(settings: Settings) -> Iterator[socket.socket]:
    """:raises InputError: a host or port that can't be taken"""
    where = f"--host {settings.host} --port {settings.port}"
    try:
        family, kind, _, _, place = socket.getaddrinfo(settings.host, settings.port, type=socket.SOCK_STREAM)[0]
        # asyncio sends at once from sockets that say so alone; others hold an answer's end back for 40 ms
        listening = socket.socket(family, kind, socket.IPPROTO_TCP)
    except (OSError, UnicodeError) as error:
        raise InputError(where, f"is no address here ({getattr(error, 'strerror', error)})") from None
    with listening:
        try:
            if os.name != "nt":  # there it would share a port that is in use
                listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind(place)
            listening.listen(_MOST_CONNECTIONS)  # who comes early waits
        except OSError as error:
            raise InputError(where, f"can't be taken ({error.strerror}), expected a free port (0 takes any)") from None
        yield listening


def _address(settings: Settings, port: int) -> Address:
    """What it may be called by: its own names, exactly."""
    from facepipe.server.app import Address

    scheme = "http" if settings.tls_cert is None else "https"
    names = {"localhost", "127.0.0.1", "::1"}
    is_loopback = settings.host in names
    if settings.host in _WILD:
        own = socket.gethostname()
        names |= {own, socket.getfqdn()}
        with contextlib.suppress(OSError):
            names |= {str(one[4][0]).partition("%")[0] for one in socket.getaddrinfo(own, None)}
    elif not is_loopback:
        names = {settings.host}
    shown = [f"[{name}]" if ":" in name else name.lower() for name in names]
    hosts = {f"{name}:{port}" for name in shown}
    if port == {"http": 80, "https": 443}[scheme]:
        hosts |= set(shown)
    origins = {f"{scheme}://{one}" for one in hosts}
    for given in settings.origin:
        parts = urlsplit(given.rstrip("/"))
        if parts.scheme not in ("http", "https") or not parts.netloc or parts.path or "@" in parts.netloc:
            raise InputError(f"--origin {given[:80]}", "expected one like https://faces.example.com")
        origins.add(f"{parts.scheme}://{parts.netloc.lower()}")
        hosts.add(parts.netloc.lower())
    return Address(frozenset(hosts), frozenset(origins), is_loopback and not settings.origin)


def _shown(settings: Settings, port: int) -> str:
    name = socket.gethostname() if settings.host in _WILD else settings.host
    return f"http{'' if settings.tls_cert is None else 's'}://{f'[{name}]' if ':' in name else name}:{port}/"


def _check_tokens(services: Services, address: Address, settings: Settings) -> None:
    """:raises InputError: nobody could ask"""
    from facepipe.server import tenants

    if not address.is_loopback and not any(tenants.tenants(services.library.database).values()):
        raise InputError(f"--host {settings.host}", "nobody has a token, expected `facepipe serve token add` before")


def _add_heads(services: Services) -> None:
    """Sample heads in the library of who asks on this machine."""
    from facepipe.server.jobs import Asked
    from facepipe.server.library import new_id
    from facepipe.server.tenants import LOCAL, tenant_named

    tenant = tenant_named(services.library.database, LOCAL)
    for seed in _DEMO:
        asked = Asked(action="sample", fields={"seed": seed}, face=new_id(), base=None, name=f"Head {seed}")
        services.jobs.add(tenant, asked)
        services.runner.wake()


class _Lines(logging.Formatter):
    """A line of JSON for each record; of errors their kind alone: their texts may name faces."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        told = {"time": round(record.created, 3), "level": record.levelname.lower(), "event": str(record.msg)[:80]}
        if record.exc_info and record.exc_info[0]:
            last = record.exc_info[2]
            while last is not None and last.tb_next is not None:
                last = last.tb_next
            told["error"] = record.exc_info[0].__name__
            told["at"] = "" if last is None else f"{Path(last.tb_frame.f_code.co_filename).name}:{last.tb_lineno}"
        return json.dumps({**told, **getattr(record, "told", {})})


def _log_lines() -> None:
    lines = logging.StreamHandler(sys.stderr)
    lines.setFormatter(_Lines())
    for name, level in (("facepipe.server", logging.INFO), ("uvicorn.error", logging.WARNING)):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [lines], False
        logger.setLevel(level)
