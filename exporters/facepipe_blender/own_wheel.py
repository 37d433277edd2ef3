"""facepipe's own wheel, made of the files of this installation: without build tool and network, always the same."""

from __future__ import annotations

import base64
import hashlib
import importlib
import re
from importlib.metadata import entry_points
from pathlib import Path

from facepipe import registry
from facepipe.core import __version__

from .plain_zip import write_zip

PACKAGES = ("facepipe", "facepipe_schemas", "facepipe_gltf", "facepipe_onnx")
_WHEEL = "Wheel-Version: 1.0\nGenerator: facepipe\nRoot-Is-Purelib: true\nTag: py3-none-any\n"


def write_own_wheel(folder: Path) -> Path:
    """Write the wheel into a folder; its path.

    :raises InputError: the folder can't be written
    """
    files: dict[str, bytes] = {}
    for package in PACKAGES:
        root = Path(str(importlib.import_module(package).__file__)).parent
        for file in sorted(one for one in root.rglob("*") if one.is_file() and "__pycache__" not in one.parts):
            files[f"{package}/{file.relative_to(root).as_posix()}"] = file.read_bytes()
    info = f"facepipe-{__version__}.dist-info"
    files[f"{info}/METADATA"] = f"Metadata-Version: 2.1\nName: facepipe\nVersion: {__version__}\n".encode()
    files[f"{info}/WHEEL"] = _WHEEL.encode()
    files[f"{info}/entry_points.txt"] = _entry_points().encode()
    rows = [f"{name},sha256={_digest(data)},{len(data)}" for name, data in files.items()]
    files[f"{info}/RECORD"] = "\n".join([*rows, f"{info}/RECORD,,", ""]).encode()
    path = folder / f"facepipe-{__version__}-py3-none-any.whl"
    write_zip(path, files)
    return path


def _entry_points() -> str:
    """The exporters and importers that are in the wheel."""
    lines = []
    for group in (registry.EXPORTERS, registry.IMPORTERS):
        found = sorted({(one.name, one.value) for one in entry_points(group=group)})
        own = [f"{name} = {value}" for name, value in found if re.split(r"[.:]", value)[0] in PACKAGES]
        lines += [f"[{group}]", *own, ""]
    return "\n".join(lines)


def _digest(data: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(data).digest()).decode().rstrip("=")
