"""Checks of accessors, meshes and the node tree of a glTF file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from facepipe.core.errors import InputError
from facepipe.records import Json
from facepipe_gltf.raw import RawDocument, as_list, as_object, children, is_index, parents
from facepipe_gltf.read.meshopt import EXTENSION
from facepipe_gltf.skin_validation import Problem, attributes

_SUPPORTED = ("KHR_mesh_quantization", EXTENSION)


def primitives(document: RawDocument) -> Iterator[tuple[str, Json]]:
    """Every primitive and where it is."""
    for i, mesh in enumerate(document.items("meshes")):
        for j, one in primitives_of(mesh):
            yield f"/meshes/{i}/primitives/{j}", one


def primitives_of(mesh: Json) -> Iterator[tuple[int, Json]]:
    """The primitives of a mesh, and their numbers."""
    yield from ((j, one) for j, one in enumerate(as_list(mesh.get("primitives"))) if isinstance(one, dict))


def targets(primitive: Json) -> list[Json]:
    """Morph targets of a primitive."""
    return [as_object(one) for one in as_list(primitive.get("targets"))]


def accessors(document: RawDocument) -> Iterator[Problem]:
    """Every accessor stays within its buffer."""
    for i in range(len(document.items("accessors"))):
        try:
            document.accessor(i)
        except InputError as error:
            yield f"/accessors/{i}", ": ".join(filter(None, (error.where.partition(" -> ")[2], error.what)))


def finite(document: RawDocument) -> Iterator[Problem]:
    """No number is NaN or infinite."""
    for i in range(len(document.items("accessors"))):
        values = document.maybe(i)
        if values is not None and not np.isfinite(values).all():
            found = f"{int(np.count_nonzero(~np.isfinite(values)))} of {values.size} numbers are NaN or infinite"
            yield f"/accessors/{i}", f"{found}, expected finite ones"


def bounds(document: RawDocument) -> Iterator[Problem]:
    """min and max of an accessor are those of its values; positions have them."""
    for i, accessor in enumerate(document.items("accessors")):
        values = document.maybe(i)
        if values is None or not np.isfinite(values).all() or accessor.get("normalized") is True:
            continue
        for name, actual in (("min", values.min(axis=0)), ("max", values.max(axis=0))):
            if name in accessor and not _same(accessor[name], actual):
                yield f"/accessors/{i}/{name}", f"{accessor[name]}, expected {[float(f'{x:.6g}') for x in actual]}"
    for where, primitive in primitives(document):
        for place, named in [(where, attributes(primitive)), *_placed(where, primitive)]:
            accessor_ = document.item("accessors", named.get("POSITION"))
            if accessor_ is not None and not {"min", "max"} <= set(accessor_):
                yield f"{place}/POSITION", "no min and max, expected both"


def _placed(where: str, primitive: Json) -> list[tuple[str, Json]]:
    return [(f"{where}/targets/{i}", one) for i, one in enumerate(targets(primitive))]


def _same(declared: Any, actual: Any) -> bool:
    if not isinstance(declared, list) or len(declared) != len(actual):
        return False
    if not all(isinstance(one, int | float) and not isinstance(one, bool) for one in declared):
        return False
    return bool(np.allclose(np.array(declared, dtype=np.float64), actual, rtol=1e-6, atol=1e-30))


def vertex_counts(document: RawDocument) -> Iterator[Problem]:
    """Attributes and targets of a primitive have one count, and indices are below it."""
    for where, primitive in primitives(document):
        position = document.item("accessors", attributes(primitive).get("POSITION"))
        if position is None:
            yield where, "no POSITION accessor, expected one"
            continue
        count = position.get("count")
        for place, named in [(f"{where}/attributes", attributes(primitive)), *_placed(where, primitive)]:
            for name, index in named.items():
                own = document.item("accessors", index)
                if own is None or own.get("count") != count:
                    found = "no accessor" if own is None else f"{own.get('count')} values"
                    yield f"{place}/{name}", f"{found}, expected {count}"
        indices = document.maybe(primitive["indices"]) if "indices" in primitive else None
        if indices is not None and is_index(count) and indices.max() >= count:
            yield f"{where}/indices", f"vertex {indices.max():g}, expected 0 to {count - 1}"


def distinct_target_names(document: RawDocument) -> Iterator[Problem]:
    """The names in extras.targetNames of a mesh are distinct: of two of one name an engine sets only one."""
    for i, mesh in enumerate(document.items("meshes")):
        names = as_list(as_object(mesh.get("extras")).get("targetNames"))
        if len({str(name) for name in names}) != len(names):
            yield f"/meshes/{i}/extras/targetNames", "a name twice, expected each once"


def target_names(document: RawDocument) -> Iterator[Problem]:
    """extras.targetNames, weights and the targets of every primitive of a mesh have one count."""
    for i, mesh in enumerate(document.items("meshes")):
        where = f"/meshes/{i}"
        counts = [len(targets(one)) for _, one in primitives_of(mesh)]
        count = counts[0] if counts else 0
        if len(set(counts)) > 1:
            yield where, f"primitives with {sorted(set(counts))} targets, expected as many on each"
        names = as_object(mesh.get("extras")).get("targetNames")
        if names is None and count:
            yield f"{where}/extras/targetNames", f"no names of {count} targets, expected one each"
        for place, what, listed in (
            ("extras/targetNames", "names", names),
            ("weights", "weights", mesh.get("weights")),
        ):
            if listed is not None and (not isinstance(listed, list) or len(listed) != count):
                count_there = len(listed) if isinstance(listed, list) else "no"
                yield f"{where}/{place}", f"{count_there} {what}, expected {count}"


def asset(document: RawDocument) -> Iterator[Problem]:
    """The file is glTF 2, asks for no extension that readers of plain geometry lack, and holds a mesh."""
    for note in document.notes:
        yield "/", note.partition(": ")[2]
    version = as_object(document.json.get("asset")).get("version")
    if version != "2.0":
        yield "/asset/version", f"{str(version)[:40]}, expected 2.0"
    required = document.json.get("extensionsRequired", [])
    for name in required if isinstance(required, list) else [required]:
        if name not in _SUPPORTED:
            yield "/extensionsRequired", f"{str(name)[:40]}, expected none but {', '.join(_SUPPORTED)}"
    if not document.items("meshes"):
        yield "/meshes", "no mesh, expected one"
    scene, scenes = document.json.get("scene", 0), len(document.items("scenes"))
    if scenes and not (is_index(scene) and scene < scenes):
        yield "/scene", f"{str(scene)[:40]}, expected 0 to {scenes - 1}"


def references(document: RawDocument) -> Iterator[Problem]:
    """The objects that nodes, scenes and skins refer to exist."""
    sizes = {name: len(document.items(name)) for name in ("nodes", "meshes", "skins", "cameras")}
    for i, node in enumerate(document.items("nodes")):
        for key, name in (("mesh", "meshes"), ("skin", "skins"), ("camera", "cameras")):
            if key in node and not (is_index(node[key]) and node[key] < sizes[name]):
                yield f"/nodes/{i}/{key}", f"{str(node[key])[:40]}, expected 0 to {sizes[name] - 1}"
        if any(child >= sizes["nodes"] for child in children(node)):
            yield f"/nodes/{i}/children", f"a child that is not there, expected 0 to {sizes['nodes'] - 1}"
    for i, scene in enumerate(document.items("scenes")):
        found = scene.get("nodes", [])
        if not isinstance(found, list) or any(not is_index(one) or one >= sizes["nodes"] for one in found):
            yield f"/scenes/{i}/nodes", f"a node that is not there, expected 0 to {sizes['nodes'] - 1}"


def node_tree(document: RawDocument) -> Iterator[Problem]:
    """Nodes form trees: one parent at most, no cycle."""
    above = parents(document)
    for child, named_by in sorted(above.items()):
        if len(named_by) > 1:
            yield f"/nodes/{child}", f"child of {len(named_by)} nodes, expected one at most"
    reached: set[int] = set()
    stack = [i for i in range(len(document.items("nodes"))) if i not in above]
    while stack:
        current = stack.pop()
        if current not in reached:
            reached.add(current)
            stack += children(document.item("nodes", current) or {})
    lost = sorted(set(range(len(document.items("nodes")))) - reached)
    if lost:
        yield f"/nodes/{lost[0]}", "its own ancestor, expected no cycle"
