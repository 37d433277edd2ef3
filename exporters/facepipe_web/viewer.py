"""The viewer: faces made ready in a temporary folder, and served with the page."""

from __future__ import annotations

import contextlib
import contextvars
import errno
import http.client
import json
import math
import os
import shutil
import socket
import socketserver
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BufferedIOBase
from pathlib import Path
from typing import TYPE_CHECKING, Any

import facepipe
from facepipe import registry
from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.policy.paths import check_found
from facepipe.core.reading import check_regular
from facepipe.records import Json
from facepipe_web import build
from facepipe_web.options import Options

if TYPE_CHECKING:
    from facepipe.hosting.live_blend import LiveBlend
    from facepipe.parts import FaceParts

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
_PORTS = (0, 65535)
_BASIS = "basis.fpbasis"
_HEAD_BASIS = Path(facepipe.__file__).parent / "heads" / "data" / "head.fpbasis"
_KEPT = 2  # versions of the face that may still be on their way to the page


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
        # a request that is not from our own page
        hosts, origins, lengths = (self.headers.get_all(one, []) for one in ("Host", "Origin", "Content-Length"))
        own = {f"{host}:{self.server.server_port}" for host in (HOST, "localhost")}
        refused: tuple[int, str, bytes] | None = None
        if len(hosts) != 1 or max(len(origins), len(lengths)) > 1 or "Transfer-Encoding" in self.headers:
            refused = 400, "text/plain", b"expected one Host, and at most one Origin and Content-Length\n"
        elif hosts[0] not in own or not {*origins} <= {f"http://{one}" for one in own}:
            refused = 403, "text/plain", b"not for other sites\n"  # a name that others point here
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


def write_assets(
    parts: FaceParts, label: str, folder: Path, url: str, pose: str = "set"
) -> tuple[Json, dict[str, Path]]:
    """Export a face into an empty folder: its entry in viewer.json, and path on the server -> file.

    :param label: what the page calls it
    :param url: folder on the server, without slashes at its ends
    :param pose: the person at rest, as the exporters take it
    :raises ExportError: a face that a format can't hold
    :raises InputError: no such pose
    """
    folder.mkdir(parents=True)
    # what moves is played in the studio; of a face that has poses alone, as fits do, nothing is
    has_clips = any(one.times is not None and len(one.times) > 1 for one in parts.animations)
    notes = _export(parts, folder / "face.glb", pose=pose, morph_normals=True, animations=has_clips)
    if parts.sliders:
        notes += _export(parts, folder / "sliders.onnx", pose=pose, sliders=True)
    path = folder / "regions.bin"
    # the regions' masks, a byte for each point of all meshes, region after region; their names, none without
    import numpy as np

    regions = sorted({name for mesh in parts.meshes for name in mesh.regions})
    if regions:
        rows = [
            np.concatenate([mesh.regions.get(name, np.zeros(len(mesh.points))) for mesh in parts.meshes])
            for name in regions
        ]
        path.write_bytes(np.rint(255 * np.clip(rows, 0, 1)).astype(np.uint8).tobytes())
    joints = None
    if parts.skeleton.joints:  # the axes of their coefficients: the stage's times the skeleton's scale
        axes = parts.gltf_axes
        axes[:3, :3] *= np.cbrt(abs(np.linalg.det(np.asarray(parts.skeleton.transform)[:3, :3])))
        joints = {"paths": list(parts.skeleton.joints), "axes": axes.tolist()}
    details: Json = {
        "joints": joints,
        "meshes": [{"name": mesh.name, "points": len(mesh.points)} for mesh in parts.meshes],
        "notes": list(dict.fromkeys(notes)),
        "regions": {"names": regions, "masks": f"{url}/regions.bin"} if regions else None,
    }
    (folder / "details.json").write_text(json.dumps(details), encoding="utf-8")
    entry = {
        "label": label,
        "glb": f"{url}/face.glb",
        "onnx": f"{url}/sliders.onnx" if parts.sliders else None,
        "details": f"{url}/details.json",
    }
    return entry, {f"/{url}/{file.name}": file for file in folder.iterdir()}


def _export(parts: FaceParts, path: Path, **settings: bool | str) -> list[str]:
    """Write one file; who is at rest where that is set, and what the report warns of."""
    from facepipe.parts import HeldFace

    exporter = registry.exporter(path)
    report = exporter.export(HeldFace(parts), path, exporter.Options(**settings))
    return [*([] if report.pose == "rest" else [f"at rest: {report.pose}"]), *report.warnings]


class Blending:
    """Answers the page; `entry` is the blend's entry in viewer.json."""

    def __init__(self, path: Path, live: LiveBlend, folder: Path, server: Server) -> None:
        self._path, self._live, self._folder, self._server = path, live, folder, server
        self._versions: list[dict[str, Path]] = []
        self._number = 0
        self._lock = threading.Lock()  # of versions
        self.entry: Json = {
            "sources": [source.name for source in live.sources],
            "regions": list(live.regions),
            "weights": live.rows,
            "locked": dict(live.weights.locked),
            "command": f"facepipe blend --edit {path.name} --force",
        }

    def answer(self, sent: bytes) -> Answer:
        """Points (n, 3) of all meshes as float32 in glTF space, or the entry of a new version of the face.

        :param sent: ``{"weights": {region or "default": [...]}, "wanted": "points" or "face"}``
        :raises InputError: other JSON, or weights that can't be blended
        """
        try:
            request = json.loads(sent)
            rows, wanted = dict(request["weights"]), request["wanted"]
        except (ValueError, KeyError, TypeError, RecursionError):
            raise InputError("blend", "no request, expected weights and what is wanted") from None
        if wanted == "points":
            return "application/octet-stream", self._live.points(rows, self._live.base.gltf_axes)
        if wanted == "face":
            with self._lock:  # the page asks for the next version while it still loads the last: some are kept
                face = self._live.face(rows)
                self._number += 1
                name = f"blend{self._number}"
                entry, files = write_assets(face, self._path.name, self._folder / name, f"faces/{name}")
                self._server.files |= files
                self._versions.append(files)
                for old in self._versions[:-_KEPT]:
                    for url, file in old.items():
                        self._server.files.pop(url, None)
                        shutil.rmtree(file.parent, ignore_errors=True)
                del self._versions[:-_KEPT]
                return "application/json", json.dumps(entry).encode()
        raise InputError("blend", "expected points or face as wanted")


def blending_of(path: Path, folder: Path, server: Server) -> Blending | None:
    """The blend behind a face that `facepipe blend` made; None for other faces.

    :raises InputError: a source of its recipe is gone
    """
    from facepipe.hosting.live_blend import LiveBlend

    live = None if path.suffix.lower() in (".glb", ".vrm", ".fbx") else LiveBlend.from_stage(path)
    return None if live is None else Blending(path, live, folder, server)


class Viewer:
    """A page that is served until `close`."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self.url = server.url

    def serve(self) -> None:
        """Answer the browser until `close` or KeyboardInterrupt."""
        self._server.serve_forever(poll_interval=0.2)

    def close(self) -> None:
        """End `serve`, from another thread."""
        self._server.shutdown()


@contextmanager
def view(
    faces: Sequence[Path], options: Options, onnx: Path | None = None, basis: Path | None = None
) -> Iterator[Viewer]:
    """A viewer of a face stage or GLB, and of a second one to compare it with; its files are gone when the block ends.

    :param onnx: sliders of a GLB
    :param basis: of persons that are opened in the page; None: the built-in head's
    :raises InputError: no build, a port that is not free, or files that can't be shown
    :raises SchemaError, ExportError: a stage without a face, or one that a format can't hold
    """
    # never built on the way: that takes node and a network, which a viewer has no business to ask for
    options.check()
    if not build.is_built():
        what = "is older than its sources" if build.DIST.exists() else "is not built"
        raise InputError("viewer", f"{what}, expected `python -m facepipe_web.build` before (needs node 20 and npm)")
    files = build.page_files()
    if basis is not None:
        _check_start(basis, b"FPBA", "a basis that `facepipe basis` wrote")
    files = files | {"/": build.DIST / "index.html", f"/{_BASIS}": basis or _HEAD_BASIS}
    with tempfile.TemporaryDirectory(prefix="facepipe-view-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        server = Server(options.port, files, {})
        try:
            entries = [_entry(path, onnx, folder, number, server, options.pose) for number, path in enumerate(faces)]
            blending = blending_of(faces[0], folder, server)
            content = {"faces": entries, "blend": None if blending is None else blending.entry, "basis": _BASIS}
            file = folder / "viewer.json"
            file.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
            server.files["/viewer.json"] = file
            if blending is not None:
                server.actions["/blend"] = blending.answer
            yield Viewer(server)
        finally:
            server.server_close()


def _entry(path: Path, onnx: Path | None, folder: Path, number: int, server: Server, pose: str) -> Json:
    """Make one face ready."""
    if path.suffix.lower() == ".glb":
        _check_start(path, b"glTF", "a GLB")
        if onnx is not None:
            sidecar = onnx.with_name(f"{onnx.name}.json")
            check_found(sidecar, onnx)
            _check_start(sidecar, b"{", "the sidecar of an ONNX file")
            _check_start(onnx, b"", "an ONNX file")
        url = f"faces/{number}"
        # the same of files that are there: a GLB, and the ONNX of its sliders with its sidecar
        files = {f"/{url}/face.glb": path}
        if onnx is not None:
            files |= {f"/{url}/sliders.onnx": onnx, f"/{url}/sliders.onnx.json": onnx.with_name(f"{onnx.name}.json")}
        entry = {
            "label": path.name,
            "glb": f"{url}/face.glb",
            "onnx": None if onnx is None else f"{url}/sliders.onnx",
            "details": None,
        }
    else:
        if onnx is not None:
            raise InputError(onnx, f"is for a GLB, expected one in place of {path.name}")
        parts = facepipe.read(path).parts()
        entry, files = write_assets(parts, path.name, folder / str(number), f"faces/{number}", pose)
    server.files |= files
    return entry


def _check_start(path: Path, start: bytes, kind: str) -> None:
    check_regular(path)
    try:
        with path.open("rb") as file:
            head = file.read(4)
    except OSError as error:
        raise InputError(path, f"can't be read ({error.strerror}), expected {kind}") from None
    if not head.startswith(start):
        raise InputError(path, f"is not {kind}")
