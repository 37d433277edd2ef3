"""A document as the objects of pygltflib, for callers who change it before it is saved.

Made and written by plain walks over its dataclasses: `GLTF2.from_json` takes many times as long, and `to_json` writes
defaults that a file needn't state. What a file doesn't state is None here, or an empty list or dictionary.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, get_args, get_type_hints

from facepipe.core.errors import ExportError
from facepipe.records import Json
from facepipe_gltf.raw import RawDocument
from facepipe_gltf.validation import errors

if TYPE_CHECKING:
    from pygltflib import GLTF2

OnDocument = Callable[["GLTF2"], object]


def changed(document: Json, on_document: OnDocument, target: Path, buffer: bytes) -> Json:
    """The document as `on_document` leaves it.

    :param buffer: what buffer 0 holds, which stays as it is
    :raises ExportError: what it leaves is no JSON, or `validate` would find an error in it
    """
    from pygltflib import GLTF2

    whole = _object(GLTF2, json.loads(json.dumps(document)))  # a copy: the caller's changes end here
    on_document(whole)
    where = f"{target.name} -> on_document"
    try:
        result: Json = json.loads(json.dumps(whole, default=_stated, allow_nan=False, ensure_ascii=False).encode())
    except (TypeError, ValueError, RecursionError) as error:  # text that is no UTF-8 too
        raise ExportError(where, f"{str(error)[:120]}, expected what JSON can hold") from None
    left = RawDocument.from_json(target, result, buffer)
    if whole.binary_blob() is not None or left.items("buffers")[:1] != document.get("buffers", [])[:1]:
        raise ExportError(where, "changes the first buffer, expected it as it is (others can be data: URIs)")
    same_data = all(result.get(key) == document.get(key) for key in ("accessors", "bufferViews", "meshes"))
    for at, problem in errors(left, data=not same_data):
        raise ExportError(f"{where} -> {at}", problem)
    return result


class _Field(NamedTuple):
    """Of a pygltflib class."""

    name: str
    empty: Callable[[], object] | None  # what it is where nothing is stated; None: None
    inner: Any  # the pygltflib class of its value or of the items in it, if any


@cache
def _fields(kind: Any) -> tuple[_Field, ...]:
    described = []
    hints = get_type_hints(kind)
    for field in fields(kind):
        inner = next((part for part in _parts(hints[field.name]) if part.__module__ == kind.__module__), None)
        empty: Any = field.default_factory if field.default_factory in (list, dict) else None
        described.append(_Field(field.name, empty, inner))
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
    stated = {field.name: getattr(value, field.name) for field in _fields(kind)}
    return {name: one for name, one in stated.items() if one is not None and not _is_empty(one)}


def _is_dataclass(kind: Any) -> bool:
    return hasattr(kind, "__dataclass_fields__")


def _is_empty(value: object) -> bool:
    return isinstance(value, list | dict) and not value
