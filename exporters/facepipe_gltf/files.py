"""Documents as files: .glb, or .gltf with its buffer and images beside."""

from __future__ import annotations

import hashlib
import json
import re
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from facepipe.atomic import discard_stale, replacing, together, write_bytes
from facepipe.errors import ExportError
from facepipe_gltf.buffers import Chunk

Json = dict[str, Any]

_MAGIC, _VERSION, _JSON_CHUNK, _BINARY_CHUNK = b"glTF", 2, b"JSON", b"BIN\0"
_LARGEST = 2**32 - 1
_BLOCK = 1 << 18  # bytes written at once


def json_bytes(document: Json) -> bytes:
    """The document's JSON: compact, keys sorted, no NaN."""
    return json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()


def glb_chunks(document: Json, binary: Sequence[Chunk]) -> list[Chunk]:
    """A GLB container (glTF 2.0, section 4), in pieces as `binary` is."""
    text = json_bytes(document)
    text += b" " * (-len(text) % 4)
    chunks: list[Chunk] = [struct.pack("<I4s", len(text), _JSON_CHUNK), text]
    size = sum(map(len, binary))
    if size:
        padding = bytes(-size % 4)
        chunks += [struct.pack("<I4s", size + len(padding), _BINARY_CHUNK), *binary, padding]
    total = 12 + sum(map(len, chunks))
    if total > _LARGEST:
        raise ExportError(document["asset"]["generator"], f"{total} bytes, a GLB holds at most {_LARGEST}: use .gltf")
    return [struct.pack("<4sII", _MAGIC, _VERSION, total), *chunks]


def write_glb(target: Path, document: Json, binary: Sequence[Chunk]) -> list[Path]:
    """Write .glb; its path."""
    chunks = glb_chunks(document, binary)
    with replacing(target) as temporary, temporary.open("wb", buffering=_BLOCK) as file:
        file.writelines(chunks)
    return [target]


def sidecar_name(target: Path, data: bytes, label: str, extension: str) -> str:
    """A name made of URI-safe characters and the content's digest.

    New content gets a new name, so the files that an older .gltf needs stay whole until the new one is in place.
    """
    parts = [re.sub(r"[^A-Za-z0-9_-]+", "_", part) for part in (target.stem, label) if part]
    return ".".join([*parts, hashlib.sha256(data).hexdigest()[:8]]) + extension


def write_gltf(target: Path, document: Json, sidecars: Mapping[str, bytes]) -> list[Path]:
    """Write .gltf and sidecars, all or none, then remove the sidecars of the file that was there before."""
    with together(target):
        stale = _own_sidecars(target) - set(sidecars)
        for name, data in sidecars.items():
            path = target.with_name(name)
            if not (path.is_file() and path.read_bytes() == data):
                write_bytes(path, data)
        write_bytes(target, json_bytes(document))
        for name in sorted(stale):
            discard_stale(target.with_name(name))
    return [target, *(target.with_name(name) for name in sidecars)]


def _own_sidecars(target: Path) -> set[str]:
    """File names that an existing .gltf at `target` refers to and that this writer has named."""
    stem = re.sub(r"[^A-Za-z0-9_-]+", "_", target.stem)
    named = re.compile(rf"{re.escape(stem)}(\.[A-Za-z0-9_-]+)?\.[0-9a-f]{{8}}\.(bin|png|jpg)")
    try:
        document = json.loads(target.read_bytes())
        entries = [*document.get("buffers", []), *document.get("images", [])]
        uris = [entry.get("uri", "") for entry in entries]
    except (OSError, ValueError, AttributeError, TypeError):
        return set()
    return {uri for uri in uris if isinstance(uri, str) and named.fullmatch(uri)}
