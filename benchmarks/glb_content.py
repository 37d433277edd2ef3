"""What a GLB holds, read from its JSON alone: the counts two exporters must agree on, and its size without sparse."""

from __future__ import annotations

import copy
import json
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

Json = dict[str, Any]

_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


def read_json(glb: Path) -> Json:
    """The JSON chunk of a GLB."""
    data = glb.read_bytes()
    length, kind = struct.unpack_from("<I4s", data, 12)
    if data[:4] != b"glTF" or kind != b"JSON":
        raise ValueError(f"{glb}: no GLB with JSON first")
    document: Json = json.loads(data[20 : 20 + length])
    return document


def content(document: Json) -> Json:
    """Counts: meshes with their vertices, triangles and targets by name, totals, distinct shapes, joints."""
    accessors = document["accessors"]
    meshes: Json = {}
    shapes: set[str] = set()
    for mesh in document["meshes"]:
        primitives = mesh["primitives"]
        names = mesh.get("extras", {}).get("targetNames", [])
        shapes |= set(names)
        meshes[mesh["name"]] = {
            "vertices": sum(accessors[primitive["attributes"]["POSITION"]]["count"] for primitive in primitives),
            "triangles": sum(accessors[primitive["indices"]]["count"] for primitive in primitives) // 3,
            "primitives": len(primitives),
            "targets": len(primitives[0].get("targets", [])),
            "target_names": sorted(names),
            "skinned": "JOINTS_0" in primitives[0]["attributes"],
            "target_normals": any("NORMAL" in target for target in primitives[0].get("targets", [])),
        }
    totals = {key: sum(one[key] for one in meshes.values()) for key in ("vertices", "triangles", "primitives")}
    return {
        "meshes": len(meshes),
        **totals,
        "targets": sum(one["targets"] for one in meshes.values()),
        "shapes": len(shapes),
        "joints": max((len(skin["joints"]) for skin in document.get("skins", [])), default=0),
        "of_mesh": meshes,
    }


def differences(ours: Json, theirs: Json) -> list[str]:
    """Where two contents differ, one line each; empty where both files hold the same."""
    lines = [
        f"{key}: {ours[key]} and {theirs[key]}"
        for key in ("meshes", "vertices", "triangles", "primitives", "targets", "shapes", "joints")
        if ours[key] != theirs[key]
    ]
    for name in sorted({*ours["of_mesh"], *theirs["of_mesh"]}):
        own, other = ours["of_mesh"].get(name), theirs["of_mesh"].get(name)
        if own is None or other is None:
            lines.append(f"{name}: in one file only")
        else:
            lines += [f"{name} {key}: {own[key]} and {other[key]}" for key in own if own[key] != other[key]]
    return lines


def reaches(document: Json) -> dict[tuple[str, str], float]:
    """(mesh, target) -> largest component of its offsets in metres; skinned meshes left out.

    It is the same whichever axis points up, and whether the unit is baked into vertices or left in the node above.
    """
    result: dict[tuple[str, str], float] = {}
    for scale, mesh in _placed(document):
        for primitive in mesh["primitives"]:
            targets = primitive.get("targets", [])
            for name, target in zip(mesh.get("extras", {}).get("targetNames", []), targets, strict=True):
                bounds = document["accessors"][target["POSITION"]]
                reach = scale * max(map(abs, (*bounds["min"], *bounds["max"])))
                result[mesh["name"], name] = max(result.get((mesh["name"], name), 0.0), reach)
    return result


def _placed(document: Json) -> Iterator[tuple[float, Json]]:
    """(scale of the world transform, mesh) of every unskinned mesh node."""
    pending = [(index, 1.0) for index in document["scenes"][document.get("scene", 0)].get("nodes", [])]
    while pending:
        index, scale = pending.pop()
        node = document["nodes"][index]
        if "matrix" in node:
            scale *= math.dist(node["matrix"][:3], (0, 0, 0))
        scale *= max(node.get("scale", [1.0]))
        pending += [(child, scale) for child in node.get("children", [])]
        if "mesh" in node and "skin" not in node:
            yield scale, document["meshes"][node["mesh"]]


def dense_bytes(document: Json) -> int:
    """Bytes of the GLB if every morph target stored all of its vertices, and none shared an accessor with another.

    Exact: it is the size of the file rewritten so, its JSON included. For files without animations.
    """
    dense = copy.deepcopy(document)
    accessors = dense["accessors"]
    view, size = len(dense["bufferViews"]), 0
    for primitive in (one for mesh in dense["meshes"] for one in mesh["primitives"]):
        for target in primitive.get("targets", []):
            for attribute, index in target.items():
                accessor = accessors[index]
                if "sparse" not in accessor:
                    continue
                whole = {key: value for key, value in accessor.items() if key not in ("sparse", "bufferView")}
                target[attribute] = len(accessors)
                accessors.append({**whole, "bufferView": view, "byteOffset": size})
                size += accessor["count"] * _stride(accessor)
    if size:
        dense["bufferViews"].append(
            {"buffer": 0, "byteLength": size, "byteOffset": 0, "byteStride": 12, "target": 34962}
        )
    _drop_sparse(dense)
    binary = _place(dense["bufferViews"])
    dense["buffers"] = [{"byteLength": binary}]
    text = json.dumps(dense, separators=(",", ":"), ensure_ascii=False).encode()
    return 12 + 8 + len(text) + -len(text) % 4 + 8 + binary


def _stride(accessor: Json) -> int:
    size = _COMPONENT_BYTES[accessor["componentType"]] * _COMPONENTS[accessor["type"]]
    return size + -size % 4


def _drop_sparse(document: Json) -> None:
    """Remove sparse accessors, the views that only they use, and renumber what is left."""
    kept = [i for i, one in enumerate(document["accessors"]) if "sparse" not in one]
    number = {old: new for new, old in enumerate(kept)}
    document["accessors"] = [document["accessors"][i] for i in kept]
    for primitive in (one for mesh in document["meshes"] for one in mesh["primitives"]):
        primitive["indices"] = number[primitive["indices"]]
        for attributes in (primitive["attributes"], *primitive.get("targets", [])):
            attributes |= {name: number[index] for name, index in attributes.items()}
    for skin in document.get("skins", []):
        skin["inverseBindMatrices"] = number[skin["inverseBindMatrices"]]
    used = {one["bufferView"] for one in document["accessors"]}
    used |= {one["bufferView"] for one in document.get("images", []) if "bufferView" in one}
    order = {old: new for new, old in enumerate(sorted(used))}
    document["bufferViews"] = [document["bufferViews"][i] for i in sorted(used)]
    for one in (*document["accessors"], *(image for image in document.get("images", []) if "bufferView" in image)):
        one["bufferView"] = order[one["bufferView"]]


def _place(views: list[Json]) -> int:
    """Put views one after another, 4-byte aligned; the bytes of all."""
    offset = 0
    for view in views:
        view["byteOffset"] = offset
        offset += view["byteLength"] + -view["byteLength"] % 4
    return offset
