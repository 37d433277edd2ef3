"""A small glTF writer for tests, independent of the exporter, and a face-like model with known ground truth."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Json = dict[str, Any]

_CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_NODE_NAMES = ("armature", "root", "offset", "jaw", "skull", "eye", "eye", "brow", "lip", "chin", "tip")
PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010802000000907753de"
    "0000000c49444154789c63f8cfc0000003010100c9fe92ef0000000049454e44ae426082"
)


@dataclass
class Builder:
    """Collects JSON and binary data."""

    root: Json = field(default_factory=lambda: {"asset": {"version": "2.0"}})
    binary: bytearray = field(default_factory=bytearray)

    def add(self, kind: str, entry: Json) -> int:
        """Append to one of the document's lists."""
        entries = self.root.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1

    def view(self, data: bytes, stride: int | None = None) -> int:
        self.binary += b"\0" * (-len(self.binary) % 4)
        entry: Json = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)}
        if stride is not None:
            entry["byteStride"] = stride
        self.binary += data
        return self.add("bufferViews", entry)

    def array(self, values: Array, dtype: str = "f4", *, normalized: bool = False, stride: int | None = None) -> int:
        """An accessor of (n,) or (n, c) values."""
        rows = np.asarray(values).reshape(len(values), -1).astype(f"<{dtype}")
        data = rows.tobytes()
        if stride is not None:
            padded = np.full((len(rows), stride), 0xEE, np.uint8)
            padded[:, : rows.shape[1] * rows.itemsize] = rows.view(np.uint8).reshape(len(rows), -1)
            data = padded.tobytes()
        return self.add("accessors", self._entry(rows, normalized) | {"bufferView": self.view(data, stride)})

    def sparse(self, values: Array, base: Array | None = None) -> int:
        """An accessor that stores only the rows of (n, c) `values` that differ from `base` (None: from zero)."""
        rows = values.astype("<f4")
        below = np.zeros_like(rows) if base is None else base.astype("<f4")
        changed = np.flatnonzero(np.any(rows != below, axis=1))
        entry = self._entry(rows, False)
        entry["sparse"] = {
            "count": len(changed),
            "indices": {"bufferView": self.view(changed.astype("<u2").tobytes()), "componentType": 5123},
            "values": {"bufferView": self.view(rows[changed].tobytes())},
        }
        if base is not None:
            entry["bufferView"] = self.view(below.tobytes())
        return self.add("accessors", entry)

    def glb(self) -> bytes:
        """The whole as a GLB."""
        if self.binary:
            self.root["buffers"] = [{"byteLength": len(self.binary)}]
        return glb(self.root, bytes(self.binary))

    @staticmethod
    def _entry(rows: Array, normalized: bool) -> Json:
        entry: Json = {
            "componentType": _CODES[rows.dtype.str[1:]],
            "count": len(rows),
            "type": _TYPES[rows.shape[1]],
        }
        return entry | {"normalized": True} if normalized else entry


def glb(root: Json | bytes, binary: bytes = b"") -> bytes:
    """A GLB of a JSON chunk and a BIN chunk."""
    text = root if isinstance(root, bytes) else json.dumps(root).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    if binary:
        padded = binary + b"\0" * (-len(binary) % 4)
        chunks += struct.pack("<II", len(padded), 0x004E4942) + padded
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def matrix(translation: Array, rotation: Array, scale: Array) -> Array:
    """(4, 4) from translation, quaternion x y z w and scale."""
    x, y, z, w = np.asarray(rotation, np.float64) / np.linalg.norm(rotation)
    result = np.eye(4)
    result[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    result[:3, :3] *= np.asarray(scale)
    result[:3, 3] = translation
    return result


def quaternion(generator: np.random.Generator) -> Array:
    value = generator.normal(size=4)
    return value / np.linalg.norm(value)


@dataclass
class Model:
    """A patch of 8 x 6 vertices with a UV seam, skinned with 8 influences to 9 joints, with 3 morph targets.

    Node 0 is an armature (moved and scaled, no joint), 2 a moved node between joints, 11 the mesh.
    """

    positions: Array
    triangles: Array
    uvs: Array
    joints: Array  # (n, 8) into the skin's joints
    weights: Array  # (n, 8)
    targets: list[Array]  # (n, 3) each
    normals: Array
    trs: list[tuple[Array, Array, Array]]  # of nodes 0 to 10
    inverse_binds: Array  # (9, 4, 4)

    parents = (-1, 0, 1, 2, 2, 4, 4, 4, 3, 3, 8)
    joint_nodes = (1, 3, 4, 5, 6, 7, 8, 9, 10)
    names = ("jawOpen", "browUp", "eyeBlink_L")

    def worlds(self, trs: list[tuple[Array, Array, Array]]) -> Array:
        """(11, 4, 4) world matrices of the nodes."""
        result: list[Array] = []
        for parent, parts in zip(self.parents, trs, strict=True):
            local = matrix(*parts)
            result.append(local if parent < 0 else result[parent] @ local)
        return np.array(result)

    def evaluate(self, weights: Array, trs: list[tuple[Array, Array, Array]]) -> Array:
        """(n, 3) vertices by the glTF formula: morph, then skin."""
        morphed = self.positions + sum(w * target for w, target in zip(weights, self.targets, strict=True))
        matrices = self.worlds(trs)[list(self.joint_nodes)] @ self.inverse_binds
        blended = np.einsum("nk,nkij->nij", self.weights, matrices[self.joints])
        return np.einsum("nij,nj->ni", blended[:, :3, :3], morphed) + blended[:, :3, 3]


def make_model(seed: int = 1) -> Model:
    generator = np.random.default_rng(seed)
    columns, rows = 8, 6
    x, y = np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float))
    flat = np.stack([x.ravel(), y.ravel(), np.sin(x.ravel())], axis=1) * 0.03
    # the column x = 4 is a UV seam: its vertices come twice, at the same place with other UVs
    seam = np.flatnonzero(x.ravel() == 4)
    source = np.concatenate([np.arange(columns * rows), seam])
    twin = np.full(columns * rows, -1)
    twin[seam] = columns * rows + np.arange(rows)
    cells = [(r * columns + c) for r in range(rows - 1) for c in range(columns - 1)]
    quads = np.array([[i, i + 1, i + columns + 1, i + columns] for i in cells])
    right = quads[:, 0] % columns >= 4
    quads[right] = np.where(twin[quads[right]] >= 0, twin[quads[right]], quads[right])
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    count = columns * rows
    uvs = np.concatenate([np.stack([x.ravel() / 20, y.ravel() / 8], 1), np.stack([np.full(rows, 0.7), y[:, 4] / 8], 1)])
    joints = np.argsort(generator.random((count, 9)), axis=1)[:, :8]
    weights = generator.random((count, 8))
    weights = (weights / weights.sum(1, keepdims=True)).astype(np.float32)
    targets = []
    for shape in range(3):
        moved = generator.normal(size=(count, 3)) * 0.01 * (generator.random((count, 1)) < (0.2, 0.4, 1.0)[shape])
        targets.append(moved.astype(np.float32)[source])
    trs = [
        (generator.normal(size=3) * 0.05, quaternion(generator), np.full(3, 1.0) if i else np.full(3, 2.0))
        for i in range(11)
    ]
    normals = generator.normal(size=(count, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True))[source]
    model = Model(
        flat.astype(np.float32)[source], triangles, uvs.astype(np.float32), joints[source], weights[source],
        targets, normals.astype(np.float32), trs, np.zeros((9, 4, 4)),
    )  # fmt: skip
    worlds = model.worlds(trs)[list(model.joint_nodes)]
    model.inverse_binds = np.linalg.inv(worlds).astype(np.float32).astype(np.float64)
    return model


def build(model: Model, *, encoding: str = "plain") -> Builder:
    """The model as a document; `encoding` "odd": strides, normalised and sparse accessors wherever they may be."""
    builder = Builder()
    odd = encoding == "odd"
    attributes = {
        "POSITION": builder.array(model.positions, stride=20 if odd else None),
        "NORMAL": builder.array(model.normals, stride=16 if odd else None),
        "TEXCOORD_0": builder.array(model.uvs),
    }
    for number in range(2):
        columns = slice(4 * number, 4 * number + 4)
        attributes[f"JOINTS_{number}"] = builder.array(
            model.joints[:, columns], "u1" if odd else "u2", stride=12 if odd else None
        )
        attributes[f"WEIGHTS_{number}"] = builder.array(model.weights[:, columns])
    base = np.where(np.arange(len(model.positions))[:, None] % 3 == 0, model.targets[1], 0.5).astype(np.float32)
    targets = [
        {"POSITION": builder.sparse(model.targets[0])},
        {"POSITION": builder.sparse(model.targets[1], base) if odd else builder.array(model.targets[1])},
        {"POSITION": builder.array(model.targets[2])},
    ]
    primitive = {
        "attributes": attributes,
        "indices": builder.array(model.triangles.ravel(), "u1" if odd else "u4"),
        "targets": targets,
        "material": builder.add("materials", {"name": "skin", "doubleSided": True}),
    }
    builder.add("meshes", {"name": "head", "primitives": [primitive], "extras": {"targetNames": list(model.names)}})
    for number, (translation, rotation, scale) in enumerate(model.trs):
        node: Json = {
            "name": _NODE_NAMES[number],
            "translation": translation.tolist(),
            "rotation": rotation.tolist(),
            "scale": scale.tolist(),
        }
        children = [i for i, parent in enumerate(model.parents) if parent == number]
        builder.add("nodes", node | ({"children": children} if children else {}))
    builder.add("nodes", {"name": "head", "mesh": 0, "skin": 0, "translation": [9.0, 9.0, 9.0]})
    binds = builder.array(model.inverse_binds.transpose(0, 2, 1).reshape(-1, 16))
    builder.add("skins", {"joints": list(model.joint_nodes), "inverseBindMatrices": binds})
    builder.add("scenes", {"nodes": [0, 11]})
    return builder


def animated(model: Model) -> tuple[Builder, Array, dict[tuple[int, str], Callable[[float], Array]]]:
    """The model with LINEAR, STEP and CUBICSPLINE channels, their key times, and the channels as functions."""
    generator = np.random.default_rng(5)
    builder = build(model)
    tracks: dict[tuple[int, str], Callable[[float], Array]] = {}
    animation: dict[str, Any] = {"name": "talk", "channels": [], "samplers": []}
    every: list[Array] = []

    def channel(node: int, path: str, mode: str, times: Array, keys: Array) -> None:
        times = times.astype(np.float32).astype(np.float64)
        keys = keys.astype(np.float32)
        output = builder.array(keys.reshape(-1, 1) if path == "weights" else keys.reshape(-1, keys.shape[-1]))
        animation["samplers"].append({"input": builder.array(times), "output": output, "interpolation": mode})
        target = {"node": node, "path": path}
        animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": target})
        tracks[node, path] = lambda at: interpolate(mode, path == "rotation", times, keys.astype(np.float64), at)
        every.append(times)

    def turns(count: int) -> Array:
        return np.array([quaternion(generator) for _ in range(count)])

    channel(1, "rotation", "LINEAR", np.array([0, 0.5, 1.0]), turns(3))
    channel(1, "translation", "CUBICSPLINE", np.array([0.25, 0.75]), generator.normal(size=(2, 3, 3)) * 0.02)
    channel(3, "rotation", "CUBICSPLINE", np.array([0.1, 0.6, 0.9]), turns(9).reshape(3, 3, 4))
    channel(4, "scale", "STEP", np.array([0.2, 0.4]), 1.0 + generator.random((2, 3)))
    channel(6, "translation", "LINEAR", np.array([0.3]), generator.normal(size=(1, 3)) * 0.02)
    channel(11, "weights", "LINEAR", np.array([0.0, 0.8]), generator.random((2, 3)))
    builder.add("animations", animation)
    return builder, np.unique(np.concatenate(every)), tracks


def interpolate(mode: str, rotation: bool, times: Array, keys: Array, at: float) -> Array:
    """glTF 2.0 appendix C at one time; cubic keys are (k, 3, width): in-tangent, value, out-tangent."""
    at = float(np.clip(at, times[0], times[-1]))
    k = min(int(np.searchsorted(times, at, side="right")) - 1, len(times) - 1)
    if mode == "CUBICSPLINE":
        value = keys[k, 1]
        if k + 1 < len(times):
            span = times[k + 1] - times[k]
            s = (at - times[k]) / span
            value = (
                (2 * s**3 - 3 * s**2 + 1) * keys[k, 1] + span * (s**3 - 2 * s**2 + s) * keys[k, 2]
                + (-2 * s**3 + 3 * s**2) * keys[k + 1, 1] + span * (s**3 - s**2) * keys[k + 1, 0]
            )  # fmt: skip
        return value / np.linalg.norm(value) if rotation else value
    if mode == "STEP" or k + 1 == len(times):
        return keys[k]
    s = (at - times[k]) / (times[k + 1] - times[k])
    a, b = keys[k], keys[k + 1]
    if not rotation:
        return (1 - s) * a + s * b
    b = b if a @ b >= 0 else -b
    angle = np.arccos(np.clip(a @ b, -1, 1))
    return (np.sin((1 - s) * angle) * a + np.sin(s * angle) * b) / np.sin(angle)


def full_document() -> Builder:
    """A document with everything the reader knows."""
    builder = build(make_model(), encoding="odd")
    attributes = builder.root["meshes"][0]["primitives"][0]["attributes"]
    attributes["COLOR_0"] = builder.array(np.full((54, 4), 255), "u1", normalized=True)
    attributes["_FACEPIPE_POINT"] = builder.array(np.arange(54.0))
    builder.add("images", {"bufferView": builder.view(PNG), "name": "tone"})
    builder.add("samplers", {"wrapS": 33071})
    builder.add("textures", {"source": 0, "sampler": 0})
    move = {"KHR_texture_transform": {"offset": [0.5, 0], "scale": [1, 1], "rotation": 0.1, "texCoord": 0}}
    builder.root["materials"][0] |= {
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "extensions": move}, "baseColorFactor": [1, 1, 1, 1]},
        "normalTexture": {"index": 0, "scale": 1.0},
        "alphaMode": "MASK",
        "emissiveFactor": [1, 1, 1],
        "extensions": {"KHR_materials_ior": {"ior": 1.4}},
    }
    facepipe = {"inbetweens": {"browUp": {"shape": "jawOpen", "weight": 0.5}}}
    builder.root["meshes"][0]["extras"]["facepipe"] = facepipe
    times = builder.array(np.array([0.0, 1.0]))
    turns = builder.array(np.tile([0, 0, 0, 1.0], (6, 1)))
    outputs = [(turns, "CUBICSPLINE"), (builder.array(np.zeros(6)), "LINEAR")]
    builder.add(
        "animations",
        {
            "samplers": [{"input": times, "output": output, "interpolation": mode} for output, mode in outputs],
            "channels": [
                {"sampler": 0, "target": {"node": 1, "path": "rotation"}},
                {"sampler": 1, "target": {"node": 11, "path": "weights"}},
            ],
        },
    )
    builder.root["nodes"][2] = {
        "matrix": np.eye(4).ravel().tolist(),
        "children": builder.root["nodes"][2]["children"],
        "name": "offset",
    }
    builder.root["scene"] = 0
    builder.root["extensionsUsed"] = ["KHR_texture_transform", "KHR_materials_ior"]
    builder.root["asset"]["copyright"] = "nobody"
    return builder
