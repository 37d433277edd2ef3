"""FBX files made node by node, binary or ASCII: a writer of its own, and scenes whose truth is known.

Source: the layout of binary FBX 7.x as Blender's developers described it in 2013; names of nodes and properties as
files of Maya, 3ds Max and Blender have them.
"""

from __future__ import annotations

import itertools
import struct
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gltf_builder import PNG

TICKS = 46_186_158_000  # in a second
_ARRAYS = {"f8": b"d", "f4": b"f", "i4": b"i", "i8": b"l", "u1": b"b"}


@dataclass
class Node:
    """A node: name, properties (int, float, str, bytes, arrays; numpy integers keep their size), nodes below."""

    name: str
    values: tuple[Any, ...] = ()
    children: list[Node] = field(default_factory=list)


def node(name: str, *values: Any, children: Iterable[Node] = ()) -> Node:
    return Node(name, values, list(children))


def _packed(value: Any, *, deflate: bool) -> bytes:
    if isinstance(value, np.ndarray):
        data = value.astype(value.dtype.newbyteorder("<")).tobytes()
        packed = zlib.compress(data) if deflate else data
        return _ARRAYS[value.dtype.str[1:]] + struct.pack("<III", value.size, int(deflate), len(packed)) + packed
    if isinstance(value, bool):
        return b"C" + struct.pack("<b", value)
    if isinstance(value, np.int64):
        return b"L" + struct.pack("<q", value)
    if isinstance(value, int):
        return b"I" + struct.pack("<i", value)
    if isinstance(value, float):
        return b"D" + struct.pack("<d", value)
    data = value.encode() if isinstance(value, str) else value
    return (b"S" if isinstance(value, str) else b"R") + struct.pack("<I", len(data)) + data


def _binary(one: Node, at: int, *, deflate: bool) -> bytes:
    name, values = one.name.encode(), b"".join(_packed(value, deflate=deflate) for value in one.values)
    start = at + 13 + len(name) + len(values)
    below = b""
    for child in one.children:
        below += _binary(child, start + len(below), deflate=deflate)
    if one.children:
        below += b"\0" * 13
    head = struct.pack("<IIIB", start + len(below), len(one.values), len(values), len(name))
    return head + name + values + below


def binary(nodes: Sequence[Node], *, version: int = 7400, deflate: bool = True) -> bytes:
    """A binary file."""
    data = b"Kaydara FBX Binary  \0\x1a\0" + struct.pack("<I", version)
    for one in nodes:
        data += _binary(one, len(data), deflate=deflate)
    return data + b"\0" * 13 + b"\0" * 160


def _text(one: Node, depth: int) -> str:
    tab = "\t" * depth
    if len(one.values) == 1 and isinstance(one.values[0], np.ndarray):
        listed = ",".join(repr(number) for number in one.values[0].tolist())
        return f"{tab}{one.name}: *{one.values[0].size} {{\n{tab}\ta: {listed}\n{tab}}}\n"
    shown = [f'"{_named(value)}"' if isinstance(value, str) else repr(_plain(value)) for value in one.values]
    below = "".join(_text(child, depth + 1) for child in one.children)
    return f"{tab}{one.name}: {', '.join(shown)}" + (f" {{\n{below}{tab}}}\n" if one.children else "\n")


def _named(value: str) -> str:
    name, separator, kind = value.partition("\0\x01")
    return f"{kind}::{name}" if separator else value


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def ascii_text(nodes: Sequence[Node], version: int = 7400) -> bytes:
    """An ASCII file."""
    head = f"; FBX {version // 1000}.{version % 1000 // 100}.0 project file\n"
    return (head + "".join(_text(one, 0) for one in nodes)).encode()


def property70(name: str, kind: str, *values: Any) -> Node:
    return node("P", name, kind, "", "A", *values)


def properties(*listed: Node) -> Node:
    return node("Properties70", children=listed)


class Scene:
    """Objects and connections, in the order that they are made."""

    def __init__(self, *, unit: float = 1.0, up: int = 1, front: tuple[int, int] = (2, 1), right: int = 1) -> None:
        """:param unit: centimetres

        :param up: axis 0, 1 or 2; `front` its axis and sign; `right` the sign of the remaining one
        """
        self._numbers = itertools.count(1000)
        axis = 3 - up - front[0]
        self.settings = [
            property70("UpAxis", "int", up),
            property70("UpAxisSign", "int", 1),
            property70("FrontAxis", "int", front[0]),
            property70("FrontAxisSign", "int", front[1]),
            property70("CoordAxis", "int", axis),
            property70("CoordAxisSign", "int", right),
            property70("UnitScaleFactor", "double", unit),
            property70("TimeMode", "enum", 11),  # 24 frames per second
        ]
        self.objects: list[Node] = []
        self.links: list[Node] = []

    def add(self, kind: str, name: str, of: str, children: Iterable[Node] = (), group: str = "") -> int:
        """An object; its number."""
        number = next(self._numbers)
        title = f"{name}\0\x01{group or kind}"
        self.objects.append(node(kind, np.int64(number), title, of, children=children))
        return number

    def link(self, child: int, parent: int, name: str = "") -> None:
        values = ("OP", np.int64(child), np.int64(parent), name) if name else ("OO", np.int64(child), np.int64(parent))
        self.links.append(node("C", *values))

    def model(self, name: str, parent: int = 0, of: str = "Null", **given: Sequence[float]) -> int:
        """A node; `given` has its translation, rotation (degrees), scaling, and so on by the names of FBX."""
        names = {"translation": "Lcl Translation", "rotation": "Lcl Rotation", "scaling": "Lcl Scaling"}
        listed = [
            property70(names.get(key, key), names.get(key, "Vector3D"), *map(float, v)) for key, v in given.items()
        ]
        number = self.add("Model", name, of, [node("Version", 232), properties(*listed)])
        self.link(number, parent)
        return number

    def mesh(
        self, owner: int, points: Any, faces: Sequence[Sequence[int]], *layers: Node, name: str = "geometry"
    ) -> int:
        """A geometry on a node, with more nodes of its own (normals, UVs, materials)."""
        flat = [index for face in faces for index in (*face[:-1], -1 - face[-1])]
        own = [node("Vertices", np.asarray(points, "f8").ravel()), node("PolygonVertexIndex", np.array(flat, "i4"))]
        number = self.add("Geometry", name, "Mesh", [*own, node("GeometryVersion", 124), *layers])
        self.link(number, owner)
        return number

    def skin(self, mesh: int, bones: Sequence[tuple[int, Any, Any, Any, Any]], kind: str = "Linear") -> int:
        """A skin of (bone, points, weights, Transform, TransformLink); matrices act on columns."""
        skin = self.add("Deformer", "", "Skin", [node("Version", 101), node("SkinningType", kind)])
        self.link(skin, mesh)
        for bone, points, weights, transform, link in bones:
            own = [node("Indexes", np.array(points, "i4")), node("Weights", np.array(weights, "f8"))]
            own += [node("Transform", np.asarray(transform, "f8").T.ravel())]
            own += [node("TransformLink", np.asarray(link, "f8").T.ravel())]
            cluster = self.add("Deformer", "", "Cluster", [node("Version", 100), *own], "SubDeformer")
            self.link(cluster, skin)
            self.link(bone, cluster)
        return skin

    def channels(self, mesh: int) -> int:
        """The deformer that channels are linked to."""
        deformer = self.add("Deformer", "", "BlendShape", [node("Version", 100)])
        self.link(deformer, mesh)
        return deformer

    def channel(
        self, deformer: int, name: str, targets: Sequence[tuple[str, float, Any, Any]], percent: float = 0.0
    ) -> int:
        """A channel of targets (name, full weight in per cent, points, offsets)."""
        full = node("FullWeights", np.array([weight for _, weight, *_ in targets], "f8"))
        own = [node("Version", 100), node("DeformPercent", percent), full]
        channel = self.add("Deformer", name, "BlendShapeChannel", own, "SubDeformer")
        self.link(channel, deformer)
        for called, _, points, offsets in targets:
            listed = [node("Indexes", np.array(points, "i4")), node("Vertices", np.asarray(offsets, "f8").ravel())]
            shape = self.add("Geometry", called, "Shape", [node("Version", 100), *listed])
            self.link(shape, channel)
        return channel

    def material(self, owner: int, name: str, *listed: Node, shading: str = "phong") -> int:
        number = self.add(
            "Material", name, "", [node("Version", 102), node("ShadingModel", shading), properties(*listed)]
        )
        self.link(number, owner)
        return number

    def texture(self, material: int, slot: str, relative: str, absolute: str = "", content: bytes = b"") -> int:
        """A picture on a material's property, embedded where it has content."""
        paths = [node("FileName", absolute or relative), node("RelativeFilename", relative)]
        number = self.add("Texture", "map", "", [node("Type", "TextureVideoClip"), *paths])
        self.link(number, material, slot)
        if content:
            video = self.add("Video", "map", "Clip", [node("Type", "Clip"), *paths, node("Content", content)])
            self.link(video, number)
        return number

    def stack(self, name: str, begin: float, end: float) -> int:
        """An animation stack with one layer; the layer's number."""
        span = [
            node("P", key, "KTime", "Time", "", np.int64(round(time * TICKS)))
            for key, time in (("LocalStart", begin), ("LocalStop", end))
        ]
        stack = self.add("AnimationStack", name, "", [properties(*span)], "AnimStack")
        layer = self.add("AnimationLayer", "base", "", [], "AnimLayer")
        self.link(layer, stack)
        return layer

    def curves(
        self, layer: int, target: int, slot: str, keys: dict[str, Sequence[tuple[float, float]]], flag: int = 4
    ) -> None:
        """Curves of a property: ``{"d|X": [(seconds, value) ...]}``; flag 4 is linear, 2 holds each value."""
        own = self.add("AnimationCurveNode", slot, "", [properties()], "AnimCurveNode")
        self.link(own, layer)
        self.link(own, target, slot)
        for name, listed in keys.items():
            times = np.array([round(time * TICKS) for time, _ in listed], "i8")
            parts = [
                node("Default", 0.0),
                node("KeyVer", 4008),
                node("KeyTime", times),
                node("KeyValueFloat", np.array([value for _, value in listed], "f4")),
                node("KeyAttrFlags", np.array([flag], "i4")),
                node("KeyAttrDataFloat", np.zeros(4, "f4")),
                node("KeyAttrRefCount", np.array([len(listed)], "i4")),
            ]
            curve = self.add("AnimationCurve", "", "", parts, "AnimCurve")
            self.link(curve, own, name)

    def nodes(self, version: int = 7400) -> list[Node]:
        """The file."""
        head = node("FBXHeaderExtension", children=[node("FBXHeaderVersion", 1003), node("FBXVersion", version)])
        settings = node("GlobalSettings", children=[node("Version", 1000), properties(*self.settings)])
        definitions = node("Definitions", children=[node("Version", 100), node("Count", len(self.objects))])
        objects = node("Objects", children=self.objects)
        return [head, settings, definitions, objects, node("Connections", children=self.links)]

    def binary(self, **more: Any) -> bytes:
        return binary(self.nodes(), **more)

    def ascii(self) -> bytes:
        return ascii_text(self.nodes())


def layer(kind: str, mapping: str, reference: str, *arrays: Node, name: str = "") -> Node:
    """A layer element of a geometry: ``layer("UV", "ByPolygonVertex", "IndexToDirect", ...)``."""
    head = [node("Version", 101), node("Name", name)]
    head += [node("MappingInformationType", mapping), node("ReferenceInformationType", reference)]
    return node(f"LayerElement{kind}", 0, children=[*head, *arrays])


def layers(*kinds: str) -> Node:
    """What a geometry says of its layer elements."""
    own = [
        node("LayerElement", children=[node("Type", f"LayerElement{kind}"), node("TypedIndex", 0)]) for kind in kinds
    ]
    return node("Layer", 0, children=[node("Version", 100), *own])


def full_scene() -> Scene:
    """A face with all that the importer reads: skin, shapes, clips, UVs, materials, a picture, a mesh on a bone."""
    scene, ways = Scene(), np.eye(4)
    armature = scene.model("Armature", scaling=(100, 100, 100))
    head = scene.model("head", armature, "LimbNode", translation=(0, 1, 0))
    jaw = scene.model("jaw", head, "LimbNode", translation=(0, 0, 1), rotation=(10, 20, 30))
    model = scene.model("Head", of="Mesh", GeometricTranslation=(0, 0, 1))
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0.5]])
    geometry = scene.mesh(
        model,
        points,
        [[0, 1, 2, 3], [1, 4, 2]],
        layer("Normal", "ByVertice", "Direct", node("Normals", np.tile([0.0, 0.0, 1.0], 5))),
        layer(
            "UV",
            "ByPolygonVertex",
            "IndexToDirect",
            node("UV", np.array([0, 0, 1, 0, 1, 1, 0, 1.0])),
            node("UVIndex", np.array([0, 1, 2, 3, 0, 1, 2], "i4")),
        ),
        layer("Color", "ByVertice", "Direct", node("Colors", np.full(20, 0.5))),
        layer("Material", "ByPolygon", "IndexToDirect", node("Materials", np.array([0, 1], "i4"))),
        layers("Normal", "UV", "Color", "Material"),
    )
    link = np.diag([100.0, 100, 100, 1])
    scene.skin(
        geometry,
        [
            (head, [0, 1, 2, 3], [1.0, 0.5, 0.5, 1.0], np.linalg.inv(link), link),
            (jaw, [1, 2, 4], [0.5, 0.5, 1.0], np.linalg.inv(link) @ ways, link),
        ],
    )
    deformer = scene.channels(geometry)
    opened = scene.channel(
        deformer, "jawOpen", [("half", 50, [1], [[0, 0, 1]]), ("open", 100, [1, 2], [[0, 0, 4]] * 2)]
    )
    scene.channel(deformer, "smile", [("smile", 100, [3], [[0, 1, 0]])], percent=30)
    eye = scene.model("Eye", head, of="Mesh", translation=(0, 0, 2), scaling=(-1, 1, 1))
    scene.link(geometry, scene.model("Twin", eye, of="Mesh"))
    scene.mesh(eye, points, [[0, 1, 2, 3]])
    for name in ("skin", "lips"):
        number = scene.material(model, name, property70("DiffuseColor", "Color", 1.0, 0.5, 0.25))
        scene.texture(number, "DiffuseColor", f"{name}.png", content=PNG)
    for take, (begin, end) in {"talk": (0.0, 0.5), "nod": (0.25, 1.0)}.items():
        number = scene.stack(take, begin, end)
        scene.curves(number, opened, "DeformPercent", {"d|DeformPercent": [(begin, 0), (end, 100)]})
        scene.curves(number, jaw, "Lcl Rotation", {"d|X": [(begin, 0), (end, 90)], "d|Y": [(begin, 0), (end, 20)]})
    return scene
