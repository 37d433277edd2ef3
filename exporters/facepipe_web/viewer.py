"""The viewer: faces made ready in a temporary folder, and served with the page."""

from __future__ import annotations

import json
import shutil
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import facepipe
from facepipe import registry
from facepipe.core.errors import InputError
from facepipe.core.policy.paths import check_found
from facepipe.core.reading import check_regular
from facepipe.records import Json
from facepipe_web import build
from facepipe_web.options import Options
from facepipe_web.server import Answer, Server

if TYPE_CHECKING:
    from facepipe.hosting.live_blend import LiveBlend
    from facepipe.parts import FaceParts

_PORTS = (0, 65535)
_KEPT = 2  # versions of the face that may still be on their way to the page


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
    notes = _export(parts, folder / "face.glb", pose=pose, morph_normals=True)
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

    live = None if path.suffix.lower() == ".glb" else LiveBlend.from_stage(path)
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
def view(faces: Sequence[Path], options: Options, onnx: Path | None = None) -> Iterator[Viewer]:
    """A viewer of a face stage or GLB, and of a second one to compare it with; its files are gone when the block ends.

    :param onnx: sliders of a GLB
    :raises InputError: no build, a port that is not free, or files that can't be shown
    :raises SchemaError, ExportError: a stage without a face, or one that a format can't hold
    """
    # never built on the way: that takes node and a network, which a viewer has no business to ask for
    options.check()
    if not build.is_built():
        what = "is older than its sources" if build.DIST.exists() else "is not built"
        raise InputError("viewer", f"{what}, expected `python -m facepipe_web.build` before (needs node 20 and npm)")
    files = {f"/{file.relative_to(build.DIST).as_posix()}": file for file in build.DIST.rglob("*") if file.is_file()}
    files = files | {"/": build.DIST / "index.html"}
    with tempfile.TemporaryDirectory(prefix="facepipe-view-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        server = Server(options.port, files, {})
        try:
            entries = [_entry(path, onnx, folder, number, server, options.pose) for number, path in enumerate(faces)]
            blending = blending_of(faces[0], folder, server)
            content = {"faces": entries, "blend": None if blending is None else blending.entry}
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
