"""Checks of the skins of a glTF file."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.records import Json
from facepipe_gltf.raw import RawDocument, as_list, as_object, is_index, local_matrix, parents, world_matrices

Problem = tuple[str, str]  # JSON path, message

_WEIGHT_SUM_TOLERANCE = 1e-3
_REST_TOLERANCE = 1e-3
_COMPARED = 256  # joints of a skin whose matrices are tried against all others'


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
