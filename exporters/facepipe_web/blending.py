"""Live blends: the weights that the page sends, answered with points or with the whole face."""

from __future__ import annotations

import json
import shutil
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError
from facepipe.records import Json
from facepipe_web.assets import write_assets
from facepipe_web.server import Answer, Server

if TYPE_CHECKING:
    from facepipe.hosting.live_blend import LiveBlend

_KEPT = 2  # versions of the face that may still be on their way to the page


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
            with self._lock:
                return "application/json", json.dumps(self._version(rows)).encode()
        raise InputError("blend", "expected points or face as wanted")

    def _version(self, rows: Json) -> Json:
        parts = self._live.face(rows)
        self._number += 1
        name = f"blend{self._number}"
        entry, files = write_assets(parts, self._path.name, self._folder / name, f"faces/{name}")
        self._server.files |= files
        self._versions.append(files)
        for old in self._versions[:-_KEPT]:
            for url, file in old.items():
                self._server.files.pop(url, None)
                shutil.rmtree(file.parent, ignore_errors=True)
        del self._versions[:-_KEPT]
        return entry


def blending_of(path: Path, folder: Path, server: Server) -> Blending | None:
    """The blend behind a face that `facepipe blend` made; None for other faces.

    :raises InputError: a source of its recipe is gone
    """
    from facepipe.hosting.live_blend import LiveBlend

    live = None if path.suffix.lower() == ".glb" else LiveBlend.from_stage(path)
    return None if live is None else Blending(path, live, folder, server)
