"""An own reading of glTF 2.0 for `files_of_others`: points over time, texture coordinates and colours, by the formulas
of the specification, in numpy alone."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

Array = np.ndarray[Any, np.dtype[Any]]
Json = dict[str, Any]
_DTYPES = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Gltf:
    """A document with its numbers."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        binary = b""
        if data[:4] == b"glTF":
            (size,) = struct.unpack_from("<I", data, 12)
            self.root: Json = json.loads(data[20 : 20 + size])
            binary = data[28 + size :]
        else:
            self.root = json.loads(data)
        self.buffers = [
            base64.b64decode(one["uri"].partition(",")[2]) if "uri" in one else binary
            for one in self.root.get("buffers", [])
        ]
        self.nodes: list[Json] = self.root["nodes"]
        self.parents = {child: i for i, node in enumerate(self.nodes) for child in node.get("children", [])}

    def array(self, index: int) -> Array:
        """(n, width) numbers of an accessor, normalised ones as fractions."""
        one = self.root["accessors"][index]
        dtype, width = np.dtype("<" + _DTYPES[one["componentType"]]), _WIDTHS[one["type"]]
        values = np.zeros((one["count"], width))
        if "bufferView" in one:
            values = self._rows(one["bufferView"], one.get("byteOffset", 0), dtype, one["count"], width)
        if "sparse" in one:
            values, sparse = np.array(values), one["sparse"]
            places = sparse["indices"]
            kind = np.dtype("<" + _DTYPES[places["componentType"]])
            at = self._rows(places["bufferView"], places.get("byteOffset", 0), kind, sparse["count"], 1)[:, 0]
            given = sparse["values"]
            values[at.astype(int)] = self._rows(
                given["bufferView"], given.get("byteOffset", 0), dtype, sparse["count"], width
            )
        if one.get("normalized"):
            values = np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values

    def _rows(self, view: int, offset: int, dtype: np.dtype[Any], count: int, width: int) -> Array:
        own = self.root["bufferViews"][view]
        stride = own.get("byteStride", dtype.itemsize * width)
        start = own.get("byteOffset", 0) + offset
        data = self.buffers[own["buffer"]]
        read = [np.frombuffer(data, dtype, width, start + i * stride) for i in range(count)]
        return np.array(read, float).reshape(count, width)

    def shown(self) -> list[int]:
        """Nodes of the scene that show a mesh, children after their parents."""
        found: list[int] = []
        todo = list(self.root["scenes"][self.root.get("scene", 0)]["nodes"])
        while todo:
            node = todo.pop(0)
            found += [node] if "mesh" in self.nodes[node] else []
            todo = self.nodes[node].get("children", []) + todo
        return found

    def primitives(self, node: int) -> list[Json]:
        """Those of the mesh that a node shows."""
        return list(self.root["meshes"][self.nodes[node]["mesh"]]["primitives"])

    def target_count(self, node: int) -> int:
        """Morph targets of the mesh: those of the primitive that has the most."""
        return max(len(one.get("targets", [])) for one in self.primitives(node))

    # ---- time

    def state(self, animation: int | None, time: float) -> Mapping[tuple[int, str], Array]:
        """Values that an animation gives (node, path) at a time; `weights[i]` for one weight alone."""
        state: dict[tuple[int, str], Array] = {}
        if animation is None:
            return state
        own = self.root["animations"][animation]
        for channel in own["channels"]:
            target = channel["target"]
            pointer = target.get("extensions", {}).get("KHR_animation_pointer", {}).get("pointer")
            if pointer is None:
                places = [(target["node"], target["path"])]
            else:
                words = pointer.split("/")[1:]
                if words[0] == "meshes":
                    nodes = [i for i, node in enumerate(self.nodes) if node.get("mesh") == int(words[1])]
                    places = [(node, "/".join(words[2:])) for node in nodes if "weights" not in self.nodes[node]]
                else:
                    places = [(int(words[1]), "/".join(words[2:]))]
            sampler = own["samplers"][channel["sampler"]]
            times = self.array(sampler["input"])[:, 0]
            values = self.array(sampler["output"])
            mode = sampler.get("interpolation", "LINEAR")
            rows = len(times) * (3 if mode == "CUBICSPLINE" else 1)
            values = values.reshape(rows, -1)
            turning = any(path == "rotation" for _, path in places)
            for place in places:
                state[place] = _between(times, values, mode, time, turning)
        return state

    def key_times(self, animation: int) -> Array:
        """All times of its keys."""
        samplers = self.root["animations"][animation]["samplers"]
        return np.unique(np.concatenate([self.array(one["input"])[:, 0] for one in samplers]))

    def world(self, node: int, state: Mapping[tuple[int, str], Array]) -> Array:
        """(4, 4) of a node."""
        own = self.nodes[node]
        local = np.array(own["matrix"], float).reshape(4, 4).T if "matrix" in own else None
        if local is None or any((node, path) in state for path in ("translation", "rotation", "scale")):
            local = _trs(
                state.get((node, "translation"), own.get("translation", [0, 0, 0])),
                state.get((node, "rotation"), own.get("rotation", [0, 0, 0, 1])),
                state.get((node, "scale"), own.get("scale", [1, 1, 1])),
            )
        return local if node not in self.parents else self.world(self.parents[node], state) @ local

    def weights(self, node: int, state: Mapping[tuple[int, str], Array]) -> Array:
        """(t,) weights of its morph targets: what plays, else the node's, else the mesh's, else 0."""
        count = self.target_count(node)
        mesh = self.root["meshes"][self.nodes[node]["mesh"]]
        found = np.array(self.nodes[node].get("weights", mesh.get("weights", [0.0] * count)), float)
        if (node, "weights") in state:
            found = np.array(state[node, "weights"], float)
        for (other, path), value in state.items():
            if other == node and path.startswith("weights/"):
                found[int(path.split("/")[1])] = value[0]
        return found

    def points(self, node: int, state: Mapping[tuple[int, str], Array], weights: Array | None = None) -> Array:
        """(corners, 3) world positions at the corners of all triangles of a node's mesh, in metres."""
        own = self.nodes[node]
        weights = self.weights(node, state) if weights is None else weights
        corners = []
        for primitive in self.primitives(node):
            given = primitive["attributes"]
            points = self.array(given["POSITION"])
            for weight, target in zip(weights, primitive.get("targets", []), strict=False):
                if "POSITION" in target:
                    points = points + weight * self.array(target["POSITION"])
            if "skin" in own:
                points = self._skinned(own["skin"], given, points, state)
            else:
                world = self.world(node, state)
                points = points @ world[:3, :3].T + world[:3, 3]
            corners.append(points[self.corners(primitive)])
        return np.concatenate(corners)

    def _skinned(self, skin: int, given: Json, points: Array, state: Mapping[tuple[int, str], Array]) -> Array:
        own = self.root["skins"][skin]
        binds = (
            self.array(own["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
            if "inverseBindMatrices" in own
            else np.tile(np.eye(4), (len(own["joints"]), 1, 1))
        )
        matrices = np.stack(
            [self.world(joint, state) @ bind for joint, bind in zip(own["joints"], binds, strict=False)]
        )
        blended = np.zeros((len(points), 4, 4))
        total = np.zeros((len(points), 1, 1))
        for number in range(4):
            if f"JOINTS_{number}" in given:
                joints = self.array(given[f"JOINTS_{number}"]).astype(int)
                shares = self.array(given[f"WEIGHTS_{number}"])
                blended += np.einsum("nk,nkij->nij", shares, matrices[joints])
                total += shares.sum(1)[:, None, None]
        blended = blended / total
        return np.asarray(np.einsum("nij,nj->ni", blended[:, :3, :3], points) + blended[:, :3, 3])

    def corners(self, primitive: Json) -> Array:
        """Vertices of all corners of its triangles."""
        if "indices" in primitive:
            return self.array(primitive["indices"])[:, 0].astype(int)
        return np.arange(self.root["accessors"][primitive["attributes"]["POSITION"]]["count"])

    # ---- textures

    def uvs(self, primitive: Json, reference: Json) -> Array:
        """(corners, 2) where a texture is read, v down: ``T R S uv`` of KHR_texture_transform."""
        move = reference.get("extensions", {}).get("KHR_texture_transform", {})
        number = move.get("texCoord", reference.get("texCoord", 0))
        uv = self.array(primitive["attributes"][f"TEXCOORD_{number}"])[self.corners(primitive)]
        c, s = np.cos(move.get("rotation", 0.0)), np.sin(move.get("rotation", 0.0))
        scaled = uv * move.get("scale", [1, 1])
        turned = np.stack([c * scaled[:, 0] + s * scaled[:, 1], -s * scaled[:, 0] + c * scaled[:, 1]], axis=1)
        return turned + move.get("offset", [0, 0])

    def image(self, reference: Json) -> bytes:
        """The bytes of the image that a reader of all extensions shows."""
        texture = self.root["textures"][reference["index"]]
        sources = [one["source"] for one in texture.get("extensions", {}).values() if "source" in one]
        own = self.root["images"][(sources or [texture.get("source")])[0]]
        if "uri" in own:
            return base64.b64decode(own["uri"].partition(",")[2])
        view = self.root["bufferViews"][own["bufferView"]]
        start = view.get("byteOffset", 0)
        return self.buffers[view["buffer"]][start : start + view["byteLength"]]


def _trs(translation: Any, rotation: Any, scale: Any) -> Array:
    x, y, z, w = np.asarray(rotation, float) / np.linalg.norm(rotation)
    made = np.eye(4)
    made[:3, :3] = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ) * np.asarray(scale, float)
    made[:3, 3] = translation
    return made


def _between(times: Array, values: Array, mode: str, time: float, turning: bool) -> Array:
    """Appendix C of the specification."""
    t = float(np.clip(time, times[0], times[-1]))
    k = int(np.clip(np.searchsorted(times, t, side="right") - 1, 0, max(len(times) - 2, 0)))
    if len(times) == 1:
        return values[1] if mode == "CUBICSPLINE" else values[0]
    span = times[k + 1] - times[k]
    u = (t - times[k]) / span
    if mode == "STEP":
        return values[k + 1] if u >= 1 else values[k]
    if mode == "CUBICSPLINE":
        a, m, b, n = values[3 * k + 1], values[3 * k + 2] * span, values[3 * k + 4], values[3 * k + 3] * span
        made = (2 * u**3 - 3 * u**2 + 1) * a + (u**3 - 2 * u**2 + u) * m + (3 * u**2 - 2 * u**3) * b + (u**3 - u**2) * n
        return np.asarray(made / np.linalg.norm(made) if turning else made)
    a, b = values[k], values[k + 1]
    if not turning:
        return np.asarray((1 - u) * a + u * b)
    b = b if a @ b >= 0 else -b
    angle = np.arccos(np.clip(a @ b, -1.0, 1.0))
    if angle < 1e-6:
        return np.asarray((1 - u) * a + u * b)
    return np.asarray((np.sin((1 - u) * angle) * a + np.sin(u * angle) * b) / np.sin(angle))
