"""Documents as files: .glb, or .gltf with its buffer and images beside."""

from __future__ import annotations

import hashlib
import json
import re
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.atomic import discard_stale, replacing, together, write_bytes
from facepipe.core.errors import ExportError
from facepipe_gltf.buffers import Chunk
from facepipe_gltf.record_format import content_digest

if TYPE_CHECKING:
    from facepipe_gltf.document import Document

Json = dict[str, Any]

_MAGIC, _VERSION, _JSON_CHUNK, _BINARY_CHUNK = b"glTF", 2, b"JSON", b"BIN\0"
_LARGEST = 2**32 - 1
_ALIGNMENT = 4
_BLOCK = 1 << 18  # bytes written at once


def embedded(document: Document) -> tuple[Json, list[Chunk]]:
    """JSON and binary chunk (in pieces) of a GLB: images follow the arrays, each in a buffer view of its own."""
    result = dict(document.json)
    binary = list(document.binary)
    size = sum(map(len, binary))
    views = list(result.get("bufferViews", []))
    images = []
    for entry, image in zip(result.get("images", []), document.images, strict=True):
        padding = bytes(-size % _ALIGNMENT)
        images.append(entry | {"bufferView": len(views)})
        views.append({"buffer": 0, "byteOffset": size + len(padding), "byteLength": len(image.data)})
        binary += [padding, image.data]
        size += len(padding) + len(image.data)
    if images:
        result |= {"images": images, "bufferViews": views}
    if size:
        result["buffers"] = [{"byteLength": size}, *result.get("buffers", [])[1:]]
    return _sealed(result), binary


def separate(document: Document, target: Path) -> tuple[Json, dict[str, bytes]]:
    """JSON of a .gltf at `target`, and its sidecar files by name."""
    result = dict(document.json)
    sidecars: dict[str, bytes] = {}
    if document.binary:
        binary = b"".join(document.binary)
        name = sidecar_name(target, binary, "", ".bin")
        sidecars[name] = binary
        result["buffers"] = [{"byteLength": len(binary), "uri": name}, *result["buffers"][1:]]
    images = []
    for entry, image in zip(result.get("images", []), document.images, strict=True):
        name = sidecar_name(target, image.data, image.name, image.extension)
        sidecars[name] = image.data
        images.append({"name": entry["name"], "uri": name})
    if images:
        result["images"] = images
    return _sealed(result), sidecars


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


def _sealed(document: Json) -> Json:
    """The document, its record with a digest of what it goes along with."""
    record = document.get("extras", {}).get("facepipe")
    if record is None:
        return document
    return document | {"extras": {"facepipe": record | {"digest": content_digest(document)}}}
