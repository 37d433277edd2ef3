"""What of a glTF document a face has no place for, one warning a kind."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from facepipe_gltf.read.document import Document
from facepipe_gltf.read.values import Value, members, quote

_KINDS = ("scenes", "nodes", "meshes", "skins", "animations", "materials", "textures", "images", "samplers", "cameras")
_READ = ("facepipe", "targetNames")  # keys of extras
_NEAREST = (9728, 9984, 9986)  # texture filters
_FILTERS = ("magFilter", "minFilter")
_LISTED = 4


def note_losses(document: Document, *, own: bool) -> None:
    """Warn of extras, tangents, cameras and the like that the document has.

    :param own: facepipe wrote it, so that exports compute its tangents anew
    """
    for kind in _KINDS:
        _note_extras(document, kind, document.entries(kind))
    primitives = [one for mesh in document.entries("meshes") for one in members(mesh.get("primitives"))]
    _note_extras(document, "primitives", primitives)
    if not own:
        _note_tangents(document, primitives)
    cameras = len(document.entries("cameras"))
    if cameras:
        document.warn(document.root, f"{_counted(cameras, 'camera')} left out")
    sharp = sum(any(_filter(one, key) in _NEAREST for key in _FILTERS) for one in document.entries("samplers"))
    if sharp:
        document.warn(document.root, f"{_counted(sharp, 'nearest texel filter')} left out: USD has none")


def _filter(sampler: Value, key: str) -> object:
    value = sampler.get(key)
    return None if value is None else value.data


def _note_extras(document: Document, kind: str, values: Sequence[Value]) -> None:
    keys: dict[str, None] = {}
    owners = 0
    for value in values:
        own = list(_extras(value))
        owners += bool(own)
        keys.update(dict.fromkeys(own))
    if owners:
        listed = ", ".join([*list(keys)[:_LISTED], *(["..."] if len(keys) > _LISTED else [])])
        what = kind if owners > 1 else kind.removesuffix("s") if kind != "meshes" else "mesh"
        document.warn(document.root, f"extras of {owners} {what} ({listed}) left out")


def _extras(value: Value) -> Iterator[str]:
    """Keys of an object's extras that nothing reads; extras that are no object as what they are."""
    extras = value.get("extras")
    if extras is None:
        return
    if isinstance(extras.data, dict):
        yield from (quote(key) for key in extras.member_names() if key not in _READ)
    else:
        yield type(extras.data).__name__


def _note_tangents(document: Document, primitives: Sequence[Value]) -> None:
    tangents = sum(one.require("attributes").get("TANGENT") is not None for one in primitives)
    if tangents:
        document.warn(
            document.root,
            f"TANGENT of {_counted(tangents, 'primitive')} left out: exports compute it where a normal map needs it",
        )
    morphs = sum(target.get("TANGENT") is not None for one in primitives for target in members(one.get("targets")))
    if morphs:
        document.warn(document.root, f"tangents of {_counted(morphs, 'morph target')} left out")


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count > 1)}"
