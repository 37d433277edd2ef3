"""Writes a face as .glb, or .gltf with files beside, all or none; changes that callers make to the document before."""

from __future__ import annotations

import hashlib
import json
import os
import re
import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from facepipe.core.atomic import discard_stale, replacing, together, write_bytes
from facepipe.core.errors import ExportError, InputError
from facepipe.core.policy.paths import check_written
from facepipe.core.reading import read_json_object
from facepipe.core.reports import ExportReport
from facepipe.parts import FaceParts, HasParts
from facepipe.records import Json
from facepipe.rig import SetFace, set_face
from facepipe_gltf.buffers import Chunk
from facepipe_gltf.document import Document, lower_levels, write
from facepipe_gltf.options import Options
from facepipe_gltf.record_format import content_digest

if TYPE_CHECKING:
    from pygltflib import GLTF2

OnDocument = Callable[["GLTF2"], object]
_MAGIC, _VERSION, _JSON_CHUNK, _BINARY_CHUNK = b"glTF", 2, b"JSON", b"BIN\0"
_LARGEST = 2**32 - 1
_ALIGNMENT = 4
_MOST_BYTES = 1 << 28  # of the JSON of a document that is replaced
_BLOCK = 1 << 18  # bytes written at once


def _changed(document: Json, on_document: OnDocument | None, target: Path, binary: Sequence[Chunk]) -> Json:
    """The document as `on_document` leaves it.

    :param binary: what buffer 0 holds, which stays as it is
    :raises ExportError: what it leaves is no JSON, or `validate` would find an error in it
    """
    if on_document is None:
        return document
    from pygltflib import GLTF2

    from facepipe_gltf.raw import RawDocument
    from facepipe_gltf.validation import errors

    whole = _object(GLTF2, json.loads(json.dumps(document)))  # a copy: the caller's changes end here
    on_document(whole)
    where = f"{target.name} -> on_document"
    try:
        result: Json = json.loads(json.dumps(whole, default=_stated, allow_nan=False, ensure_ascii=False).encode())
    except (TypeError, ValueError, RecursionError) as error:  # text that is no UTF-8 too
        raise ExportError(where, f"{str(error)[:120]}, expected what JSON can hold") from None
    left = RawDocument.from_json(target, result, b"".join(binary))
    if whole.binary_blob() is not None or left.items("buffers")[:1] != document.get("buffers", [])[:1]:
        raise ExportError(where, "changes the first buffer, expected it as it is (others can be data: URIs)")
    same_data = all(result.get(key) == document.get(key) for key in ("accessors", "bufferViews", "meshes"))
    for at, problem in errors(left, data=not same_data):
        raise ExportError(f"{where} -> {at}", problem)
    return result


@cache
def _fields(kind: Any) -> tuple[tuple[str, Callable[[], object] | None, Any], ...]:
    """Of each field of a pygltflib class: name, what makes it where nothing is stated, and the class in its value."""
    described = []
    hints = get_type_hints(kind)
    for field in fields(kind):
        inner = next((part for part in _parts(hints[field.name]) if part.__module__ == kind.__module__), None)
        empty: Any = field.default_factory if field.default_factory in (list, dict) else None
        described.append((field.name, empty, inner))
    return tuple(described)


def _parts(hint: Any) -> list[Any]:
    """The innermost types of a type hint: int and None for ``Optional[List[int]]``."""
    inner = get_args(hint)
    return [part for one in inner for part in _parts(one)] if inner else [hint]


def _object(kind: Any, data: Json) -> Any:
    """The object of a pygltflib class with the content of `data`."""
    if not _is_dataclass(kind):  # attributes of a primitive, of any name
        return kind(**data)
    values = dict(data)
    for name, empty, inner in _fields(kind):
        value = values.get(name)
        if value is None:
            values[name] = None if empty is None else empty()
        elif isinstance(value, dict) and inner is not None:
            values[name] = _object(inner, value)
        elif _is_dataclass(inner):  # morph targets stay dictionaries, as pygltflib reads them
            values[name] = [_object(inner, one) for one in value]
    return kind(**values)


def _stated(value: Any) -> Json:
    """The fields that an object of pygltflib states: JSON, or further objects.

    :raises TypeError: an object of another kind
    """
    kind: Any = type(value)
    if kind.__module__ != "pygltflib":
        raise TypeError(f"{kind.__name__} {str(value)[:40]!r}")
    if not _is_dataclass(kind):
        return {name: one for name, one in vars(value).items() if one is not None}
    stated = {name: getattr(value, name) for name, _, _ in _fields(kind)}
    return {
        name: one for name, one in stated.items() if one is not None and not (isinstance(one, list | dict) and not one)
    }


def _is_dataclass(kind: Any) -> bool:
    return hasattr(kind, "__dataclass_fields__")


def export(
    face: HasParts,
    path: str | os.PathLike[str],
    options: Options | None = None,
    *,
    on_document: OnDocument | None = None,
) -> ExportReport:
    """Write a face as glTF 2.0, to .glb or .gltf by the suffix of `path`.

    :param on_document: gets the document as a `pygltflib.GLTF2`, to change it before it is saved
    :raises ExportError: a face that glTF can't hold: NaN or infinity, counts that don't fit, no skin weights; or
        `on_document` leaves a document that is damaged
    :raises InputError: another suffix, a folder that does not exist, a shape glob that matches nothing, no such pose,
        or no levels of detail where they are asked for
    """
    start = time.perf_counter()
    target = _target(path)
    options = options or Options()
    delivered = set_face(face.parts(), options.pose)
    levels: tuple[FaceParts, ...] = lower_levels(face) if options.lods else ()
    # levels are set as the face is: a template's would show as another person from afar
    parts, chosen = delivered.parts, tuple[str, ...]()
    levels = tuple(set_face(level, options.pose).parts for level in levels)
    if options.purpose is not None:
        from facepipe_gltf.purpose import purposed

        parts, levels, options, chosen = purposed(options.purpose, parts, levels, options)
    if options.texture_size or options.texture_format not in (None, "kept"):
        from facepipe_gltf.images import repacked

        parts, *levels_ = (repacked(one, options.texture_format, options.texture_size) for one in (parts, *levels))
        levels = tuple(levels_)
    document = write(parts, options, levels=levels)
    report = report_of(document, save(document, target, on_document=on_document), delivered, start)
    return replace(report, chosen=(*chosen, *document.chosen))


def report_of(
    document: Document, files: Sequence[Path], delivered: SetFace, start: float, added: tuple[str, ...] = ()
) -> ExportReport:
    """The report of a document that was written as `files`, by a run that began at `start` (`time.perf_counter`)."""
    return ExportReport(
        path=files[0],
        files=tuple(files),
        counts=document.counts,
        bytes=sum(file.stat().st_size for file in files),
        seconds=time.perf_counter() - start,
        warnings=document.warnings,
        dropped=document.dropped,
        added=added,
        error_mm=document.error_mm,
        pose=delivered.pose,
        pose_error=None if delivered.error is None else asdict(delivered.error),
    )


def outputs(path: str | os.PathLike[str]) -> tuple[Path, ...]:
    """The files that `export` to `path` writes whatever the face holds.

    :raises InputError: another suffix than .glb and .gltf
    """
    return (_target(path),)


def save(document: Document, path: str | os.PathLike[str], *, on_document: OnDocument | None = None) -> list[Path]:
    """Write a document; the paths of all files, the .glb or .gltf first.

    :param on_document: as of `export`
    :raises ExportError: `on_document` leaves a document that is damaged
    """
    target = _target(path)
    if target.suffix.lower() == ".glb":
        json, binary = embedded(document)
        return write_glb(target, _changed(json, on_document, target, binary), binary)
    result = dict(document.json)
    sidecars: dict[str, bytes] = {}
    if document.binary:
        data = b"".join(document.binary)
        name = _sidecar_name(target, data, "", ".bin")
        sidecars[name] = data
        result["buffers"] = [{"byteLength": len(data), "uri": name}, *result["buffers"][1:]]
    # beside the file, never as data: URIs, a third larger and decoded by readers in one piece
    images = []
    for entry, image in zip(result.get("images", []), document.images, strict=True):
        name = _sidecar_name(target, image.data, image.name, image.extension)
        sidecars[name] = image.data
        images.append({"name": entry["name"], "uri": name})
    if images:
        result["images"] = images
    finished = _changed(_sealed(result), on_document, target, document.binary)
    with together(target):  # all or none, and then without the sidecars of the file that was there before
        # stale are those that this writer has named, and no others: the file may refer to a user's own
        stem = re.sub(r"[^A-Za-z0-9_-]+", "_", target.stem)
        own = re.compile(rf"{re.escape(stem)}(\.[A-Za-z0-9_-]+)?\.[0-9a-f]{{8}}\.(bin|png|jpg|webp|ktx2)")
        try:
            before: Json = read_json_object(target, _MOST_BYTES)
            uris = [entry.get("uri", "") for entry in [*before.get("buffers", []), *before.get("images", [])]]
        except (InputError, AttributeError, TypeError):
            uris = []
        stale = {uri for uri in uris if isinstance(uri, str) and own.fullmatch(uri)} - set(sidecars)
        for name, data in sidecars.items():
            sidecar = target.with_name(name)
            check_written(sidecar)
            if not (sidecar.is_file() and sidecar.read_bytes() == data):
                write_bytes(sidecar, data)
        write_bytes(target, _json_bytes(finished))
        for name in sorted(stale):
            discard_stale(target.with_name(name))
    return [target, *(target.with_name(name) for name in sidecars)]


def _target(path: str | os.PathLike[str]) -> Path:
    target = Path(path)
    if target.suffix.lower() not in (".glb", ".gltf"):
        raise InputError(target, f"suffix '{target.suffix}', expected .glb or .gltf")
    return target


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


def _json_bytes(document: Json) -> bytes:
    """The document's JSON: compact, keys sorted, no NaN."""
    return json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()


def write_glb(target: Path, document: Json, binary: Sequence[Chunk]) -> list[Path]:
    """Write .glb; its path."""
    # A GLB container (glTF 2.0, section 4), in pieces as `binary` is
    text = _json_bytes(document)
    text += b" " * (-len(text) % 4)
    chunks: list[Chunk] = [struct.pack("<I4s", len(text), _JSON_CHUNK), text]
    size = sum(map(len, binary))
    if size:
        padding = bytes(-size % 4)
        chunks += [struct.pack("<I4s", size + len(padding), _BINARY_CHUNK), *binary, padding]
    total = 12 + sum(map(len, chunks))
    if total > _LARGEST:
        raise ExportError(document["asset"]["generator"], f"{total} bytes, a GLB holds at most {_LARGEST}: use .gltf")
    chunks = [struct.pack("<4sII", _MAGIC, _VERSION, total), *chunks]
    with replacing(target) as temporary, temporary.open("wb", buffering=_BLOCK) as file:
        file.writelines(chunks)
    return [target]


def _sidecar_name(target: Path, data: bytes, label: str, extension: str) -> str:
    """A name made of URI-safe characters and the content's digest.

    New content gets a new name, so the files that an older .gltf needs stay whole until the new one is in place.
    """
    parts = [re.sub(r"[^A-Za-z0-9_-]+", "_", part) for part in (target.stem, label) if part]
    return ".".join([*parts, hashlib.sha256(data).hexdigest()[:8]]) + extension


def _sealed(document: Json) -> Json:
    """The document, with a digest of its content in its record."""
    record = document.get("extras", {}).get("facepipe")
    if record is None:
        return document
    return document | {"extras": {"facepipe": record | {"digest": content_digest(document)}}}
