"""The viewer: faces made ready in a temporary folder, and served with the page."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import facepipe
from facepipe.core.errors import InputError
from facepipe.core.policy.paths import check_found
from facepipe.core.reading import check_regular
from facepipe.records import Json
from facepipe_web import build
from facepipe_web.assets import given_assets, write_assets
from facepipe_web.blending import Blending, blending_of
from facepipe_web.options import Options
from facepipe_web.server import Server


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
def view(faces: Sequence[Path], options: Options, onnx: Path | None = None) -> Iterator[Viewer]:
    """A viewer of a face stage or GLB, and of a second one to compare it with; its files are gone when the block ends.

    :param onnx: sliders of a GLB
    :raises InputError: no build, a port that is not free, or files that can't be shown
    :raises SchemaError, ExportError: a stage without a face, or one that a format can't hold
    """
    options.check()
    files = _page_files()
    with tempfile.TemporaryDirectory(prefix="facepipe-view-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        server = Server(options.port, files, {})
        try:
            entries = [_entry(path, onnx, folder, number, server, options.pose) for number, path in enumerate(faces)]
            blending = blending_of(faces[0], folder, server)
            _write_content(folder, server, entries, blending)
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
        entry, files = given_assets(path.name, path, onnx, f"faces/{number}")
    else:
        if onnx is not None:
            raise InputError(onnx, f"is for a GLB, expected one in place of {path.name}")
        parts = facepipe.open(path).parts()
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


def _write_content(folder: Path, server: Server, entries: Sequence[Json], blending: Blending | None) -> None:
    """viewer.json, the list of faces for the page."""
    content = {"faces": entries, "blend": None if blending is None else blending.entry}
    file = folder / "viewer.json"
    file.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
    server.files["/viewer.json"] = file
    if blending is not None:
        server.actions["/blend"] = blending.answer


def _page_files() -> dict[str, Path]:
    """Path on the server -> file, of the page and all that it loads.

    :raises InputError: nothing built, or from other sources
    """
    if not build.is_built():
        what = "is older than its sources" if build.DIST.exists() else "is not built"
        raise InputError("viewer", f"{what}, expected `python -m facepipe_web.build` before (needs node 20 and npm)")
    files = {f"/{file.relative_to(build.DIST).as_posix()}": file for file in build.DIST.rglob("*") if file.is_file()}
    return files | {"/": build.DIST / "index.html"}
