"""Checks of accessors, meshes, skins and the node tree of a glTF file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.records import Json
from facepipe_gltf.buffers import DRACO, MESHOPT
from facepipe_gltf.materials import BASIS, WEBP
from facepipe_gltf.raw import RawDocument, as_list, as_object, children, is_index, local_matrix, parents, world_matrices

Problem = tuple[str, str]  # JSON path, message

_WEIGHT_SUM_TOLERANCE = 1e-3
_REST_TOLERANCE = 1e-3
_COMPARED = 256  # joints of a skin whose matrices are tried against all others'
_SUPPORTED = ("KHR_mesh_quantization", DRACO, MESHOPT, WEBP, BASIS)


def joints_of(skin: Json) -> list[int]:
    """The node of every joint; -1 for what is no index."""
    return [one if is_index(one) else -1 for one in as_list(skin.get("joints"))]


def skinned(document: RawDocument) -> Iterator[tuple[str, Json, list[int]]]:
    """Every primitive that nodes show with a skin, once: where, the primitive, the skin's joints."""
    shown: dict[tuple[object, object], None] = {}
    for node in document.items("nodes"):
        skin, mesh = document.item("skins", node.get("skin")), document.item("meshes", node.get("mesh"))
        if skin is None or mesh is None or (node["skin"], node["mesh"]) in shown:
            continue
        shown[node["skin"], node["mesh"]] = None
        for i, primitive in enumerate(as_list(mesh.get("primitives"))):
            if isinstance(primitive, dict):
                yield f"/meshes/{node['mesh']}/primitives/{i}", primitive, joints_of(skin)


def attributes(primitive: Json) -> dict[str, object]:
    """Attribute name -> accessor index."""
    return as_object(primitive.get("attributes"))


def joint_indices(document: RawDocument) -> Iterator[Problem]:
    """JOINTS_n are in range of the skin's joints."""
    for where, primitive, joints in skinned(document):
        for name, accessor in attributes(primitive).items():
            values = document.maybe(accessor) if name.startswith("JOINTS_") else None
            if values is not None and len(values) and values.max() >= len(joints):
                yield f"{where}/attributes/{name}", f"joint {values.max():g}, expected 0 to {len(joints) - 1}"


def weights_sum(document: RawDocument) -> Iterator[Problem]:
    """The weights of a vertex sum to 1, none of them negative."""
    for where, primitive, _ in skinned(document):
        sets = [document.maybe(one) for name, one in sorted(attributes(primitive).items()) if name[:8] == "WEIGHTS_"]
        if not sets or any(one is None or one.shape != sets[0].shape for one in sets):  # type: ignore[union-attr]
            continue
        weights = np.concatenate([one for one in sets if one is not None], axis=1)
        sums = weights.sum(axis=1)
        wrong = np.flatnonzero(~(np.abs(sums - 1) <= _WEIGHT_SUM_TOLERANCE))
        if len(wrong):
            found = f"{len(wrong)} of {len(sums)} vertices have weights that sum to other than 1"
            yield f"{where}/attributes/WEIGHTS_0", f"{found} (vertex {wrong[0]}: {sums[wrong[0]]:.6g}), expected 1"
        elif weights.min() < 0:
            yield f"{where}/attributes/WEIGHTS_0", f"weight {weights.min():g}, expected 0 or above"


def inverse_binds(document: RawDocument) -> Iterator[Problem]:
    """There is an affine, invertible inverse bind matrix for every joint, and every joint is a node, once."""
    for i, skin in enumerate(document.items("skins")):
        joints, nodes = joints_of(skin), len(document.items("nodes"))
        if not joints or min(joints) < 0 or max(joints) >= nodes or len(set(joints)) != len(joints):
            yield f"/skins/{i}/joints", f"{len(joints)} joints, expected distinct nodes from 0 to {nodes - 1}"
        matrices = _inverse_binds(document, skin)
        if matrices is None:
            continue
        if len(matrices) < len(joints):
            yield f"/skins/{i}/inverseBindMatrices", f"{len(matrices)} matrices, expected {len(joints)}"
        elif np.isfinite(matrices).all():
            wrong = np.abs(matrices[:, 3] - (0, 0, 0, 1)).max(axis=1) > 1e-6
            wrong |= np.abs(np.linalg.det(matrices[:, :3, :3])) < 1e-30
            if wrong.any():
                found = f"{int(wrong.sum())} matrices that can't be inverted or are not affine"
                yield f"/skins/{i}/inverseBindMatrices", f"{found}, expected invertible ones"


def _inverse_binds(document: RawDocument, skin: Json) -> FloatArray | None:
    values = document.maybe(skin["inverseBindMatrices"]) if "inverseBindMatrices" in skin else None
    if values is None or values.shape[1] != 16:
        return None
    return values.reshape(-1, 4, 4).transpose(0, 2, 1)


def joint_order(document: RawDocument) -> Iterator[Problem]:
    """skin.joints is in the order of its inverse bind matrices.

    At rest, world matrix times inverse bind matrix is one matrix for all joints; where it isn't, but is with other
    joints of the skin, they were permuted. A rest pose that is not the bind pose passes. Files written here have
    their joints in ascending node order.
    """
    by_facepipe = str(as_object(document.json.get("asset")).get("generator")).startswith("facepipe ")
    for i, skin in enumerate(document.items("skins")):
        joints, matrices = joints_of(skin), _inverse_binds(document, skin)
        if min(joints, default=-1) < 0 or max(joints) >= len(document.items("nodes")):
            continue
        # the matrices alone can't tell joints apart that rest in one place
        if by_facepipe and sorted(joints) != joints:
            late = next(a for a, b in zip(joints[1:], joints, strict=False) if a < b)
            yield f"/skins/{i}/joints", f"node {late} stands after a later one, expected the order they were written in"
        elif matrices is not None and len(matrices) == len(joints) and np.isfinite(matrices).all():
            worlds = np.stack(world_matrices(document, joints))
            permuted = _permuted_joints(worlds, matrices)
            if permuted.any():
                names = [
                    str((document.item("nodes", joints[k]) or {}).get("name", joints[k]))
                    for k in np.flatnonzero(permuted)
                ]
                found = f"joints {', '.join(names[:5])} fit inverse bind matrices of each other"
                yield f"/skins/{i}/joints", f"{found}, expected the order of inverseBindMatrices"


def _permuted_joints(worlds: FloatArray, inverse_binds: FloatArray) -> npt.NDArray[np.bool_]:
    """(j,) which joints stand in the place of others; none where another reason explains the matrices as well."""
    at_rest = worlds @ inverse_binds
    reach = max(float(np.ptp(worlds[:, :3, 3], axis=0).max()), float(np.abs(inverse_binds[:, :3, 3]).max()), 1e-9)
    weight = np.ones((4, 4))
    # translations as shares of the rig's size: one tolerance then holds for them and for rotations, in any unit
    weight[:3, 3] = 1 / reach

    def close(one: FloatArray, other: FloatArray) -> npt.NDArray[np.bool_]:
        return np.asarray((np.abs(one - other) * weight).max(axis=(-1, -2)) < _REST_TOLERANCE)

    some = at_rest[:: -(-len(at_rest) // _COMPARED)]
    agreeing = [int(close(at_rest, one).sum()) for one in some]
    for common in (np.eye(4), some[int(np.argmax(agreeing))]):
        wrong = ~close(at_rest, common)
        if not wrong.any():
            return wrong
        places = np.flatnonzero(wrong)
        if len(places) <= _COMPARED and all(close(worlds[places] @ inverse_binds[k], common).any() for k in places):
            return wrong
    return np.zeros(len(worlds), dtype=bool)


def skinned_nodes(document: RawDocument) -> Iterator[Problem]:
    """Nodes of skinned meshes stand at the scene root without a transform: engines differ on what one does."""
    above = parents(document)
    for i, node in enumerate(document.items("nodes")):
        if "skin" in node and (i in above or not np.allclose(local_matrix(node), np.eye(4))):
            yield f"/nodes/{i}", "a skinned mesh below another node or with a transform, expected neither"


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
        if i in document.unpacked:  # as they were before Draco rounded them
            continue
        columns = np.ascontiguousarray(values.T)  # over rows of three numbers it takes ten times as long
        for name, actual in (("min", columns.min(axis=1)), ("max", columns.max(axis=1))):
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
    # whole numbers beyond float64 are none that float32 data have
    if not all(isinstance(one, int | float) and not isinstance(one, bool) and abs(one) < 1e300 for one in declared):
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
