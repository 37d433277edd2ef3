"""What a glTF file is made of: how much of everything is in it, and how its bytes are spread."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.records import Json
from facepipe_gltf.buffers import DRACO, MESHOPT
from facepipe_gltf.read.accessors import element
from facepipe_gltf.read.document import Document, Value, given_name, open_document

Use = tuple[str, str]  # the part of a file that uses bytes, and as what
GEOMETRY, TARGETS = "geometry", "targets"


def contents(source: Path) -> Json:
    """Counts of a file, and its bytes, those of a .gltf with the files beside it.

    ``parts`` has for each mesh vertices, triangles, primitives and targets, and the bytes of ``geometry`` and of
    ``target_bytes``; ``textures``, ``animations``, ``skins`` and ``json`` are bytes too, ``other`` all that glTF itself
    doesn't use: padding, and facepipe's record of what it has no place for. Bytes that several share count for who
    comes first; those of a compressed view are spread by what it unfolds to. All together they are ``bytes``.

    :raises InputError: no glTF, or references to what isn't there
    """
    document = open_document(source)
    bytes_of, parts = _bytes_of(document), _parts(document)
    textures = sum(_image_bytes(document))
    whole = document.whole_length  # after every buffer and image was looked for
    for name, part in parts.items():
        part |= {GEOMETRY: bytes_of[name, GEOMETRY], "target_bytes": bytes_of[name, TARGETS]}
    spread = {
        "textures": textures,
        "animations": bytes_of["", "animations"],
        "skins": bytes_of["", "skins"],
        "json": document.length - len(document.binary or b""),
    }
    used = sum(spread.values()) + sum(part[GEOMETRY] + part["target_bytes"] for part in parts.values())
    counts = ("vertices", "triangles", "primitives", "targets")
    return {
        "bytes": whole,
        **{key: sum(part[key] for part in parts.values()) for key in counts},
        **{key: len(document.entries(key)) for key in ("materials", "images")},
        **spread,
        "other": max(whole - used, 0),  # views of other exporters may overlap
        "parts": parts,
    }


def _parts(document: Document) -> dict[str, Json]:
    """Mesh -> its counts; meshes of one name together."""
    parts: dict[str, Json] = {}
    for number, mesh in enumerate(document.entries("meshes")):
        part = parts.setdefault(
            _name(mesh, number), dict.fromkeys(("vertices", "triangles", "primitives", "targets"), 0)
        )
        targets = 0
        for primitive in mesh.require("primitives").items():
            vertices = _count(document, primitive.require("attributes").require("POSITION"))
            indices = primitive.get("indices")
            corners = vertices if indices is None else _count(document, indices)
            part["vertices"] += vertices
            part["triangles"] += corners // 3
            part["primitives"] += 1
            targets = len(primitive.get_or("targets", []).items())
        part["targets"] += targets
    return parts


def _name(mesh: Value, number: int) -> str:
    return given_name(mesh) or f"mesh {number}"


def _count(document: Document, reference: Value) -> int:
    return document.entry("accessors", reference).require("count").integer(1)


def _bytes_of(document: Document) -> Counter[Use]:
    """The bytes of every use but textures."""
    sizes: dict[int, Counter[Use]] = defaultdict(Counter)  # of a view, unfolded
    seen: set[int] = set()
    for use, reference in _accessors(document):
        number = document.index("accessors", reference)
        if number not in seen:
            seen.add(number)
            for view, size in _spans(document, document.entries("accessors")[number]):
                sizes[view][use] += size
    for use, view in _packed(document):
        sizes[view][use] += 1
    found: Counter[Use] = Counter()
    for view, uses in sizes.items():
        left, unfolded = _view_bytes(document, view), uses.total()
        for use, size in uses.items():  # whole bytes, and all of them
            share = left * size // unfolded
            found[use] += share
            left, unfolded = left - share, unfolded - size
    return found


def _accessors(document: Document) -> Iterator[tuple[Use, Value]]:
    """Every use of an accessor: of geometry before that of targets, which may share it."""
    for number, mesh in enumerate(document.entries("meshes")):
        for primitive in mesh.require("primitives").items():
            attributes = primitive.require("attributes")
            for name in attributes.member_names():
                yield (_name(mesh, number), GEOMETRY), attributes.require(name)
            if (indices := primitive.get("indices")) is not None:
                yield (_name(mesh, number), GEOMETRY), indices
    for number, mesh in enumerate(document.entries("meshes")):
        for primitive in mesh.require("primitives").items():
            for target in primitive.get_or("targets", []).items():
                for name in target.member_names():
                    yield (_name(mesh, number), TARGETS), target.require(name)
    for animation in document.entries("animations"):
        for sampler in animation.get_or("samplers", []).items():
            yield ("", "animations"), sampler.require("input")
            yield ("", "animations"), sampler.require("output")
    for skin in document.entries("skins"):
        if (matrices := skin.get("inverseBindMatrices")) is not None:
            yield ("", "skins"), matrices


def _packed(document: Document) -> Iterator[tuple[Use, int]]:
    """Views that Draco decodes, each a primitive's."""
    for number, mesh in enumerate(document.entries("meshes")):
        for primitive in mesh.require("primitives").items():
            if (packed := primitive.extension(DRACO)) is not None:
                yield (_name(mesh, number), GEOMETRY), document.index("bufferViews", packed.require("bufferView"))


def _spans(document: Document, accessor: Value) -> Iterator[tuple[int, int]]:
    """View and bytes, unfolded, of an accessor's values, and of what it replaces sparsely."""
    dtype, components = element(accessor)
    size = dtype.itemsize * components
    if (view := accessor.get("bufferView")) is not None:
        yield document.index("bufferViews", view), accessor.require("count").integer(1) * size
    if (sparse := accessor.get("sparse")) is not None:
        count, at = sparse.require("count").integer(1), sparse.require("indices")
        width = element(Value({**at.members(), "type": "SCALAR"}, at.trail))[0].itemsize
        yield document.index("bufferViews", at.require("bufferView")), count * width
        yield document.index("bufferViews", sparse.require("values").require("bufferView")), count * size


def _view_bytes(document: Document, number: int) -> int:
    view = document.entries("bufferViews")[number]
    stored = view.extension(MESHOPT) or view
    document.buffer(stored.require("buffer"))
    return stored.require("byteLength").integer(1)


def _image_bytes(document: Document) -> list[int]:
    """Of every image; 0 of one that can't be read, which faces do without."""
    found = []
    for image in document.entries("images"):
        try:
            if (view := image.get("bufferView")) is not None:
                found.append(_view_bytes(document, document.index("bufferViews", view)))
            else:
                found.append(len(document.content(image.require("uri"))))
        except InputError:
            found.append(0)
    return found
