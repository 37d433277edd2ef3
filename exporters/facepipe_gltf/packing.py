"""Where the buffer and images of a document go: into one container, or into files beside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from facepipe.records.gltf import content_digest
from facepipe_gltf.buffers import Chunk
from facepipe_gltf.document import Document
from facepipe_gltf.files import sidecar_name

Json = dict[str, Any]
_ALIGNMENT = 4


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


def _sealed(document: Json) -> Json:
    """The document, its record with a digest of what it goes along with."""
    record = document.get("extras", {}).get("facepipe")
    if record is None:
        return document
    return document | {"extras": {"facepipe": record | {"digest": content_digest(document)}}}
