"""Where the buffer and images of a document go: into one container, or into files beside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from facepipe_gltf.document import Document
from facepipe_gltf.files import sidecar_name

Json = dict[str, Any]
_ALIGNMENT = 4


def embedded(document: Document) -> tuple[Json, bytes]:
    """JSON and binary chunk of a GLB: images follow the arrays, each in a buffer view of its own."""
    result = dict(document.json)
    binary = bytearray(document.binary)
    views = list(result.get("bufferViews", []))
    images = []
    for entry, image in zip(result.get("images", []), document.images, strict=True):
        binary += bytes(-len(binary) % _ALIGNMENT)
        images.append(entry | {"bufferView": len(views)})
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(image.data)})
        binary += image.data
    if images:
        result |= {"images": images, "bufferViews": views}
    if binary:
        result["buffers"] = [{"byteLength": len(binary)}]
    return result, bytes(binary)


def separate(document: Document, target: Path) -> tuple[Json, dict[str, bytes]]:
    """JSON of a .gltf at `target`, and its sidecar files by name."""
    result = dict(document.json)
    sidecars: dict[str, bytes] = {}
    if document.binary:
        name = sidecar_name(target, document.binary, "", ".bin")
        sidecars[name] = document.binary
        result["buffers"] = [{"byteLength": len(document.binary), "uri": name}]
    images = []
    for entry, image in zip(result.get("images", []), document.images, strict=True):
        name = sidecar_name(target, image.data, image.name, image.extension)
        sidecars[name] = image.data
        images.append({"name": entry["name"], "uri": name})
    if images:
        result["images"] = images
    return result, sidecars
