"""Reads glTF files back and evaluates them by the glTF formula; shares no code with the exporter or the importer.

Decoding follows glTF 2.0 section 3.6.2 (accessors, sparse, normalised integers); deformation section 3.7.2 (morph
targets) and 3.7.3 (skins): ``position = sum_i w_i world_i inverseBind_i (position_0 + sum_k a_k delta_k)``.
"""

from __future__ import annotations

import io
import itertools
import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


@dataclass
class Gltf:
    """A glTF document and its buffer."""

    json: dict[str, Any]
    buffers: list[bytes]
    folder: Path
    _decoded: dict[int, np.ndarray] = field(default_factory=dict)

    def list(self, name: str) -> list[dict[str, Any]]:
        """A top-level array of the document."""
        return self.json.get(name, [])

    def stored(self, index: int) -> np.ndarray:
        """Accessor values as stored, (count, components)."""
        accessor = self.list("accessors")[index]
        dtype, size = np.dtype(_DTYPES[accessor["componentType"]]), _SIZES[accessor["type"]]
        count = accessor["count"]
        values = np.zeros((count, size), dtype)
        if "bufferView" in accessor:
            view = self.list("bufferViews")[accessor["bufferView"]]
            strides = (view.get("byteStride", dtype.itemsize * size), dtype.itemsize)
            data = self.view(accessor["bufferView"])
            values = np.ndarray((count, size), dtype, data, accessor.get("byteOffset", 0), strides).copy()
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            at, what = sparse["indices"], sparse["values"]
            rows = np.frombuffer(
                self.view(at["bufferView"]), _DTYPES[at["componentType"]], sparse["count"], at.get("byteOffset", 0)
            )
            assert (np.diff(rows.astype(np.int64)) > 0).all(), "sparse indices must ascend"
            data, offset = self.view(what["bufferView"]), what.get("byteOffset", 0)
            values[rows] = np.frombuffer(data, dtype, sparse["count"] * size, offset).reshape(-1, size)
        return values

    def decoded(self, index: int) -> np.ndarray:
        """Accessor values as float64: (count,), (count, k), or matrices (count, 4, 4)."""
        if index not in self._decoded:
            self._decoded[index] = self._decode(index)
        return self._decoded[index]

    def _decode(self, index: int) -> np.ndarray:
        accessor = self.list("accessors")[index]
        raw = self.stored(index)
        values = raw.astype(np.float64)
        if accessor.get("normalized"):
            values = np.maximum(values / np.iinfo(raw.dtype).max, -1.0)
        if accessor["type"] == "MAT4":
            return values.reshape(-1, 4, 4).transpose(0, 2, 1)
        return values[:, 0] if accessor["type"] == "SCALAR" else values

    def view(self, index: int) -> bytes:
        """The bytes of a bufferView."""
        view = self.list("bufferViews")[index]
        start = view.get("byteOffset", 0)
        return self.buffers[view["buffer"]][start : start + view["byteLength"]]

    def image(self, index: int) -> bytes:
        """The file of an image."""
        image = self.list("images")[index]
        return self.view(image["bufferView"]) if "bufferView" in image else (self.folder / image["uri"]).read_bytes()

    def pixels(self, texture_info: Mapping[str, Any]) -> np.ndarray:
        """Pixels of the image that a textureInfo refers to."""
        source = self.list("textures")[texture_info["index"]]["source"]
        return np.asarray(Image.open(io.BytesIO(self.image(source))))

    def mesh(self, name: str) -> dict[str, Any]:
        """A mesh by name."""
        return next(mesh for mesh in self.list("meshes") if mesh["name"] == name)

    def targets(self, mesh: str) -> list[str]:
        """Morph target names of a mesh."""
        return list(self.mesh(mesh).get("extras", {}).get("targetNames", []))

    def joint_names(self) -> list[str]:
        """Names of the skin's joints, in its order."""
        nodes = self.list("nodes")
        return [nodes[node]["name"] for node in self.list("skins")[0]["joints"]] if self.list("skins") else []

    def worlds(self, motion: Mapping[str, np.ndarray] | None = None) -> np.ndarray:
        """(nodes, 4, 4) world matrices; `motion` by node name is multiplied to the right of a node's own matrix."""
        nodes = self.list("nodes")
        parents = {child: i for i, node in enumerate(nodes) for child in node.get("children", [])}
        local = [local_matrix(node) @ (motion or {}).get(node["name"], np.eye(4)) for node in nodes]

        def world(i: int) -> np.ndarray:
            return world(parents[i]) @ local[i] if i in parents else local[i]

        return np.array([world(i) for i in range(len(nodes))])

    def evaluate(
        self,
        weights: Mapping[str, float] | None = None,
        motion: Mapping[str, np.ndarray] | None = None,
        worlds: np.ndarray | None = None,
        target_weights: Mapping[str, np.ndarray] | None = None,
    ) -> dict[str, np.ndarray]:
        """World points (n, 3) of every mesh by name, NaN for points that no vertex stands for.

        :param weights: by shape name; inbetweens follow the curves in the mesh's extras
        :param target_weights: activations by mesh name, instead of `weights`
        """
        worlds = self.worlds(motion) if worlds is None else worlds
        result = {}
        for i, node in enumerate(self.list("nodes")):
            if "mesh" in node:
                mesh = self.list("meshes")[node["mesh"]]
                if target_weights is None:
                    activations = activate(mesh, weights or {})
                else:
                    activations = target_weights.get(mesh["name"], activate(mesh, {}))
                result[mesh["name"]] = self._mesh_points(node, mesh, activations, worlds[i], worlds)
        return result

    def animation(self, name: str) -> dict[str, Any]:
        """An animation by name."""
        return next(one for one in self.list("animations") if one["name"] == name)

    def key_times(self, name: str) -> np.ndarray:
        """All times at which some channel of an animation has a key."""
        return np.unique(np.concatenate([self.decoded(one["input"]) for one in self.animation(name)["samplers"]]))

    def pose(self, name: str, time: float) -> dict[str, np.ndarray]:
        """World points (n, 3) of every mesh at a time of an animation (glTF 2.0 appendix C)."""
        nodes = [dict(node) for node in self.list("nodes")]
        weights = {}
        animation = self.animation(name)
        for channel in animation["channels"]:
            sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
            times, values = self.decoded(sampler["input"]), self.decoded(sampler["output"])
            values = values.reshape(len(times), -1)
            value = slerp(times, values, time) if target["path"] == "rotation" else linear(times, values, time)
            if target["path"] == "weights":
                weights[self.list("meshes")[nodes[target["node"]]["mesh"]]["name"]] = value
            else:
                nodes[target["node"]][target["path"]] = value
        posed = Gltf(self.json | {"nodes": nodes}, self.buffers, self.folder, self._decoded)
        return posed.evaluate(target_weights=weights)

    def _mesh_points(
        self,
        node: Mapping[str, Any],
        mesh: Mapping[str, Any],
        activations: np.ndarray,
        own: np.ndarray,
        worlds: np.ndarray,
    ) -> np.ndarray:
        points = np.full((mesh["extras"]["facepipe"]["pointCount"], 3), np.nan)
        for primitive in mesh["primitives"]:
            attributes = primitive["attributes"]
            positions = self.decoded(attributes["POSITION"])
            for activation, target in zip(activations, primitive.get("targets", []), strict=True):
                if activation:
                    positions = positions + activation * self.decoded(target["POSITION"])
            matrices = self._skin_matrices(node, attributes, worlds) if "skin" in node else own[None]
            moved = np.einsum("nij,nj->ni", matrices[:, :3, :3], positions) + matrices[:, :3, 3]
            numbers = self.decoded(attributes["_FACEPIPE_POINT"]).astype(np.int64)
            points[numbers] = moved
            assert np.abs(points[numbers] - moved).max(initial=0) < 1e-9, "vertices of one point must stay together"
        return points

    def _skin_matrices(self, node: Mapping[str, Any], attributes: Mapping[str, int], worlds: np.ndarray) -> np.ndarray:
        skin = self.list("skins")[node["skin"]]
        matrices = worlds[skin["joints"]] @ self.decoded(skin["inverseBindMatrices"])
        blended = 0.0
        for i in range(2):
            if f"JOINTS_{i}" in attributes:
                joints = self.stored(attributes[f"JOINTS_{i}"])
                weights = self.decoded(attributes[f"WEIGHTS_{i}"])
                blended = blended + np.einsum("nk,nkij->nij", weights, matrices[joints])
        return np.asarray(blended)


def read(path: Path) -> Gltf:
    """A .glb or .gltf file."""
    data = path.read_bytes()
    if path.suffix == ".gltf":
        document = json.loads(data)
        return Gltf(
            document, [(path.parent / one["uri"]).read_bytes() for one in document.get("buffers", [])], path.parent
        )
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    chunks, position = {}, 12
    while position < length:
        size, kind = struct.unpack_from("<I4s", data, position)
        chunks[kind] = data[position + 8 : position + 8 + size]
        position += 8 + size
    return Gltf(json.loads(chunks[b"JSON"]), [chunks.get(b"BIN\0", b"")], path.parent)


def local_matrix(node: Mapping[str, Any]) -> np.ndarray:
    """(4, 4) local matrix of a node."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    return trs_matrix(
        np.array(node.get("translation", (0.0, 0.0, 0.0))),
        np.array(node.get("rotation", (0.0, 0.0, 0.0, 1.0))),
        np.array(node.get("scale", (1.0, 1.0, 1.0))),
    )


def trs_matrix(translation: np.ndarray, rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """(4, 4) of translation, quaternion x y z w and scale; the rotation by v + 2w(q x v) + 2 q x (q x v)."""
    axis, w = rotation[:3], rotation[3]
    columns = [e + 2 * w * np.cross(axis, e) + 2 * np.cross(axis, np.cross(axis, e)) for e in np.eye(3)]
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack(columns, axis=1) * scale
    matrix[:3, 3] = translation
    return matrix


def linear(times: np.ndarray, values: np.ndarray, time: float) -> np.ndarray:
    """(k,) of keys (T,) and values (T, k), held beyond the ends."""
    return np.array([np.interp(time, times, column) for column in values.T])


def slerp(times: np.ndarray, values: np.ndarray, time: float) -> np.ndarray:
    """A quaternion between keys, along the shorter arc."""
    last = len(times) - 1
    i = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, max(last - 1, 0)))
    a, b = values[i], values[min(i + 1, last)]
    part = 0.0 if last == 0 else float(np.clip((time - times[i]) / (times[i + 1] - times[i]), 0, 1))
    dot = float(a @ b)
    angle = np.arccos(np.clip(abs(dot), 0, 1))
    if angle < 1e-9:
        return a
    return (np.sin((1 - part) * angle) * a + np.sign(dot) * np.sin(part * angle) * b) / np.sin(angle)


def activate(mesh: Mapping[str, Any], weights: Mapping[str, float]) -> np.ndarray:
    """(targets,) activations for shape weights, by the curves in the mesh's extras."""
    extras = mesh.get("extras", {})
    own = extras.get("facepipe", {})
    result = []
    for name in extras.get("targetNames", []):
        shape = own.get("inbetweens", {}).get(name, {}).get("shape", name)
        weight = weights.get(shape, 0.0)
        curve = own.get("curves", {}).get(name)
        result.append(weight if curve is None else follow(curve, weight))
    return np.array(result)


def follow(curve: list[list[float]], weight: float) -> float:
    """A piecewise-linear curve at `weight`, its end pieces extended."""
    pieces = list(itertools.pairwise(curve))
    (x0, y0), (x1, y1) = next((piece for piece in pieces if weight <= piece[1][0]), pieces[-1])
    return y0 + (y1 - y0) * (weight - x0) / (x1 - x0)
