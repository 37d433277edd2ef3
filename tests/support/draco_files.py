"""Small GLBs whose meshes Draco compressed, in tests/gltf/draco; as a script, with node, it makes them anew.

Each is the model of `gltf_builder` with vertex colours, 8 influences and 3 morph targets, in one primitive or two.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from gltf_builder import Array, Builder, Json, build, make_model
from node import run_node
from places import REPOSITORY

FOLDER = REPOSITORY / "tests/gltf/draco"
DRACO = "KHR_draco_mesh_compression"
BITS = {"POSITION": 14, "NORMAL": 10, "COLOR": 8, "TEX_COORD": 12, "GENERIC": 12}  # of gltf-transform
FILES: dict[str, tuple[str, Mapping[str, int], int]] = {  # method, bits, primitives
    "sequential": ("SEQUENTIAL", {}, 1),
    "edgebreaker": ("EDGEBREAKER", {}, 1),
    "quantised": ("EDGEBREAKER", BITS, 1),
    "parts": ("EDGEBREAKER", {}, 2),
    "rounded_parts": ("SEQUENTIAL", BITS, 2),
}
_TYPES = {5121: ("u1", "Uint8"), 5123: ("u2", "Uint16"), 5125: ("u4", "Uint32"), 5126: ("f4", "Float32")}
_STORED = ("bufferView", "byteOffset", "sparse")
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_KINDS = {"POSITION": "POSITION", "NORMAL": "NORMAL", "COLOR_0": "COLOR", "TEXCOORD_0": "TEX_COORD"}


def plain(primitives: int = 1) -> Builder:
    """The model uncompressed, its triangles in so many primitives, each with vertices and a material of its own."""
    model = make_model()
    builder = build(model)
    mesh = builder.root["meshes"][0]
    whole = mesh["primitives"][0]
    place = np.unique(model.positions, axis=0, return_inverse=True)[1].ravel()  # one colour on both sides of the seam
    colors = np.random.default_rng(3).integers(0, 256, (len(place), 4))[place]
    whole["attributes"]["COLOR_0"] = builder.array(colors | [0, 0, 0, 255], "u1", normalized=True)
    if primitives == 1:
        return builder
    mesh["primitives"] = []
    cells = model.triangles.reshape(2, -1, 3).transpose(1, 0, 2)  # two triangles each
    for number, triangles in enumerate(np.array_split(cells, primitives)):
        rows, corners = np.unique(triangles, return_inverse=True)
        mesh["primitives"].append(
            {
                "attributes": cut(builder, whole["attributes"], rows),
                "targets": [cut(builder, one, rows) for one in whole["targets"]],
                "indices": builder.array(corners.ravel(), "u2"),
                "material": builder.add("materials", {"name": f"part{number}"}),
            }
        )
    return builder


def cut(builder: Builder, attributes: Json, rows: Array) -> Json:
    """New accessors of some rows of others."""
    return {name: add(builder, builder.root["accessors"][one], rows) for name, one in attributes.items()}


def add(builder: Builder, entry: Json, rows: Array) -> int:
    normalized = entry.get("normalized", False)
    return builder.array(values(builder, entry)[rows], _TYPES[entry["componentType"]][0], normalized=normalized)


def values(builder: Builder, entry: Json) -> Array:
    """(count, width) what an accessor of the builder stores."""
    dtype, count, width = _TYPES[entry["componentType"]][0], entry["count"], _WIDTHS[entry["type"]]

    def stored(part: Json, kind: str, number: int) -> Array:
        at = builder.root["bufferViews"][part["bufferView"]]["byteOffset"]
        return np.frombuffer(builder.binary, f"<{kind}", number, at)

    result = np.zeros((count, width), dtype)
    if "bufferView" in entry:
        result[:] = stored(entry, dtype, count * width).reshape(count, width)
    if (sparse := entry.get("sparse")) is not None:
        rows = stored(sparse["indices"], "u2", sparse["count"])
        result[rows] = stored(sparse["values"], dtype, sparse["count"] * width).reshape(-1, width)
    return result


def request(builder: Builder, primitive: Json, method: str, bits: Mapping[str, int]) -> Json:
    """What node is asked to compress."""
    entries = builder.root["accessors"]
    attributes = [
        {
            "kind": _KINDS.get(name, "GENERIC"),
            "type": _TYPES[entries[one]["componentType"]][1],
            "components": _WIDTHS[entries[one]["type"]],
            "values": values(builder, entries[one]).ravel().tolist(),
        }
        for name, one in primitive["attributes"].items()
    ]
    triangles = values(builder, entries[primitive["indices"]]).ravel().tolist()
    return {"triangles": triangles, "attributes": attributes, "method": method, "bits": dict(bits)}


def compressed(builder: Builder, method: str, bits: Mapping[str, int]) -> Builder:
    """The same document with the primitives of its meshes compressed, and nothing of them uncompressed but targets."""
    result = Builder(root=json.loads(json.dumps(builder.root)) | {"accessors": [], "bufferViews": []})
    primitives = [one for mesh in result.root["meshes"] for one in mesh["primitives"]]
    answers = run_node("draco_encode.mjs", [], json.dumps([request(builder, one, method, bits) for one in primitives]))
    entries = builder.root["accessors"]

    def moved(number: int, rows: Any = slice(None)) -> int:
        entry = entries[number]
        if entry["type"] != "MAT4":
            return result.array(values(builder, entry)[rows], _TYPES[entry["componentType"]][0])
        at = builder.root["bufferViews"][entry["bufferView"]]["byteOffset"]
        return result.array(np.frombuffer(builder.binary, "<f4", 16 * entry["count"], at).reshape(-1, 16))

    for primitive, answer in zip(primitives, answers, strict=True):
        view = result.view(base64.b64decode(answer["packed"]))
        numbers = {name: number for number, name in enumerate(primitive["attributes"])}
        primitive["extensions"] = {DRACO: {"bufferView": view, "attributes": numbers}}
        for name, number in [*primitive["attributes"].items(), ("indices", primitive["indices"])]:
            holder = primitive if name == "indices" else primitive["attributes"]
            kept = {key: one for key, one in entries[number].items() if key not in _STORED}
            count = kept["count"] if name == "indices" else len(answer["order"])
            holder[name] = result.add("accessors", kept | {"count": count})
        for target in primitive["targets"]:
            target.update({name: moved(one, answer["order"]) for name, one in target.items()})
    for skin in result.root["skins"]:
        skin["inverseBindMatrices"] = moved(skin["inverseBindMatrices"])
    result.root |= {"extensionsUsed": [DRACO], "extensionsRequired": [DRACO]}
    return result


def read(name: str) -> tuple[Json, bytes]:
    """The JSON and the binary chunk of one of the files."""
    data = (FOLDER / f"{name}.glb").read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


if __name__ == "__main__":
    for name, (method, bits, primitives) in FILES.items():
        (FOLDER / f"{name}.glb").write_bytes(compressed(plain(primitives), method, bits).glb())
