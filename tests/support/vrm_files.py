"""Avatars as .vrm files, written without the exporter, and what a file says of its avatar with names for indices."""

from __future__ import annotations

import json
from copy import deepcopy
from typing import Any

import numpy as np
from gltf_builder import PNG as PICTURE
from gltf_builder import Builder, Json, glb

LICENSE = "https://vrm.dev/licenses/1.0/"
LEGS = {"UpperLeg": (0.1, 0.91, 0.0), "LowerLeg": (0.1, 0.5, 0.01), "Foot": (0.1, 0.08, 0.0)}
ARMS = {"UpperArm": (0.17, 1.38, 0.0), "LowerArm": (0.42, 1.38, 0.0), "Hand": (0.66, 1.38, 0.0)}
BONES: dict[str, tuple[tuple[float, float, float], str]] = {  # bone -> place in the world, the bone above
    "hips": ((0.0, 0.95, 0.0), "Armature"),
    "spine": ((0.0, 1.1, 0.01), "hips"),
    "chest": ((0.0, 1.25, 0.0), "spine"),
    "neck": ((0.0, 1.42, -0.01), "chest"),
    "head": ((0.0, 1.5, 0.0), "neck"),
    "leftEye": ((0.03, 1.58, 0.08), "head"),
    "rightEye": ((-0.03, 1.58, 0.08), "head"),
    **{
        f"{side}{part}": ((sign * place[0], *place[1:]), top if above is None else f"{side}{above}")
        for side, sign in (("left", 1.0), ("right", -1.0))
        for limb, top in ((LEGS, "hips"), (ARMS, "chest"))
        for above, (part, place) in zip((None, *limb), limb.items(), strict=False)
    },
}
OTHERS = {  # no human bones
    "hair1": ((0.0, 1.7, -0.1), "head"),
    "hair2": ((0.0, 1.6, -0.15), "hair1"),
    "hair3": ((0.01, 1.5, -0.17), "hair2"),
    "fringe": ((0.05, 1.72, 0.09), "hair1"),
    "collider": ((0.0, 1.55, 0.02), "head"),
    "twist": ((0.3, 1.38, 0.0), "leftUpperArm"),
}
LOOSE = ("leftEye", "rightEye", "hair3", "fringe", "collider", "twist", "rightHand")  # in no skin
SHAPES = ("口開け", "smile L", "smile R", "brow.down")
BALL = 6
RANGES = ("HorizontalInner", "HorizontalOuter", "VerticalDown", "VerticalUp")


def ball(center: tuple[float, float, float], radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals and triangles of a closed ball."""
    angles = np.linspace(0.15, np.pi - 0.15, BALL), np.arange(2 * BALL) * np.pi / BALL
    down, around = np.meshgrid(*angles, indexing="ij")
    normals = np.stack([np.sin(down) * np.cos(around), np.cos(down), np.sin(down) * np.sin(around)], -1).reshape(-1, 3)
    first = np.arange(BALL * 2 * BALL).reshape(BALL, -1)
    a, b = first[:-1], first[1:]
    c, d = np.roll(b, -1, 1), np.roll(a, -1, 1)
    triangles = np.concatenate([np.stack([a, d, b], -1).reshape(-1, 3), np.stack([d, c, b], -1).reshape(-1, 3)])
    return center + radius * normals, normals, triangles


class Person:
    """A person of balls, one a joint, and what it is called; `former` is VRM 0.x: it looks along -Z.

    Nodes stand in an order of their own in the file, drawn by the seed.
    """

    def __init__(self, seed: int = 0, *, former: bool = False) -> None:
        self.rng = np.random.default_rng(seed)
        self.front = -1.0 if former else 1.0  # half a turn about the vertical where it is negative
        self.builder = Builder()
        self.names = ["Armature", *BONES, *OTHERS, "Face", "Body", "Hat", "Ground"]
        self.names = [self.names[i] for i in self.rng.permutation(len(self.names))]
        self.node = {name: i for i, name in enumerate(self.names)}
        self.place = {name: self.turned(place) for name, (place, _) in (BONES | OTHERS).items()}
        self.nodes()
        self.materials = [self.builder.add("materials", {"name": name}) for name in ("unused", "skin", "cloth")]
        self.meshes()
        for picture in (b"no picture", PICTURE):
            self.builder.add("images", {"mimeType": "image/png", "bufferView": self.builder.view(picture)})
        self.builder.add("textures", {"source": 1})

    def turned(self, vector: Any) -> np.ndarray:
        """A vector of the person that looks along +Z."""
        return np.asarray(vector, np.float64) * (self.front, 1.0, self.front)

    def nodes(self) -> None:
        tree = {**{name: above for name, (_, above) in (BONES | OTHERS).items()}, "Hat": "head"}
        for name in self.names:
            self.builder.add("nodes", {"name": name})
        nodes = self.builder.root["nodes"]
        for name, above in tree.items():
            nodes[self.node[above]].setdefault("children", []).append(self.node[name])
            if name in self.place:
                start = self.place.get(above, np.zeros(3))
                nodes[self.node[name]]["translation"] = (self.place[name] - start).tolist()
        self.builder.root["scenes"] = [{"nodes": [self.node[one] for one in ("Face", "Body", "Armature", "Ground")]}]
        self.builder.root["scene"] = 0

    def meshes(self) -> None:
        build, nodes = self.builder, self.builder.root["nodes"]
        skinned = [name for name in (*BONES, *OTHERS) if name not in LOOSE]
        binds = np.tile(np.eye(4), (len(skinned), 1, 1))
        binds[:, :3, 3] = [-self.place[name] for name in skinned]
        inverse = build.array(binds.transpose(0, 2, 1).reshape(-1, 16))
        build.add("skins", {"joints": [self.node[name] for name in skinned], "inverseBindMatrices": inverse})
        head, hair = skinned.index("head"), skinned.index("hair2")
        face = [(head, (0.0, 1.62, 0.0), 0.12), (hair, OTHERS["hair2"][0], 0.03)]
        body = [(i, BONES[name][0], 0.04) for i, name in enumerate(skinned) if name in BONES and name != "head"]
        for name, balls, material, shapes in (("Face", face, 1, SHAPES), ("Body", body, 2, ())):
            attributes, indices, points = self.geometry(balls)
            one: Json = {"attributes": attributes, "indices": indices, "material": material}
            mesh: Json = {"name": f"{name} mesh", "primitives": [one]}
            if shapes:
                offsets = self.rng.normal(0.0, 0.01, (len(shapes), *points.shape))
                one["targets"] = [{"POSITION": build.array(self.turned(offset))} for offset in offsets]
                mesh["extras"] = {"targetNames": list(shapes)}
            nodes[self.node[name]] |= {"mesh": build.add("meshes", mesh), "skin": 0}
        for name, center in (("Hat", (0.0, 0.3, 0.0)), ("Ground", (0.0, 0.0, 0.0))):
            points, normals, triangles = ball(center, 0.1)
            attributes = {"POSITION": build.array(self.turned(points)), "NORMAL": build.array(self.turned(normals))}
            one = {"attributes": attributes, "indices": build.array(triangles.ravel(), "u2"), "material": 2}
            nodes[self.node[name]]["mesh"] = build.add("meshes", {"name": name, "primitives": [one]})

    def geometry(self, balls: list[Any]) -> tuple[Json, int, np.ndarray]:
        points, normals, triangles, joints = [], [], [], []
        for joint, center, radius in balls:
            own = ball(center, radius)
            triangles.append(own[2] + sum(map(len, points)))
            points.append(self.turned(own[0]))
            normals.append(self.turned(own[1]))
            joints += [[joint, 0, 0, 0]] * len(own[0])
        build, every = self.builder, np.concatenate(points)
        attributes = {
            "POSITION": build.array(every),
            "NORMAL": build.array(np.concatenate(normals)),
            "JOINTS_0": build.array(np.array(joints), "u1"),
            "WEIGHTS_0": build.array(np.tile([1.0, 0.0, 0.0, 0.0], (len(every), 1))),
        }
        return attributes, build.array(np.concatenate(triangles).ravel(), "u2"), every

    def glb(self, extensions: Json, constraints: Json | None = None) -> bytes:
        """The file, with extensions of the document and of nodes by name."""
        root = deepcopy(self.builder.root) | {"extensions": extensions}
        for name, constraint in (constraints or {}).items():
            root["nodes"][self.node[name]]["extensions"] = {"VRMC_node_constraint": constraint}
        root["extensionsUsed"] = [*extensions, *(["VRMC_node_constraint"] if constraints else [])]
        for accessor in root["accessors"]:
            if accessor["type"] == "VEC3" and accessor["componentType"] == 5126:
                view = root["bufferViews"][accessor["bufferView"]]
                data = self.builder.binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
                values = np.frombuffer(bytes(data), "<f4").reshape(-1, 3)
                accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        root["buffers"] = [{"byteLength": len(self.builder.binary)}]
        return glb(root, bytes(self.builder.binary))


def terms(rng: np.random.Generator) -> Json:
    """Terms of VRM 1.0, each drawn."""
    pick = lambda *options: options[rng.integers(len(options))]  # noqa: E731
    return {
        "name": "Åsa 花子",
        "version": "2.1",
        "authors": ["A. Author", "花子"],
        "copyrightInformation": "© A. Author",
        "contactInformation": "a@example.org",
        "references": ["https://example.org/first"],
        "thirdPartyLicenses": "Hair: CC0\nHat: MIT",
        "licenseUrl": LICENSE,
        "avatarPermission": pick("onlyAuthor", "onlySeparatelyLicensedPerson", "everyone"),
        "allowExcessivelyViolentUsage": bool(rng.integers(2)),
        "allowExcessivelySexualUsage": False,
        "commercialUsage": pick("personalNonProfit", "personalProfit", "corporation"),
        "allowPoliticalOrReligiousUsage": bool(rng.integers(2)),
        "allowAntisocialOrHateUsage": False,
        "creditNotation": pick("required", "unnecessary"),
        "allowRedistribution": bool(rng.integers(2)),
        "modification": pick("prohibited", "allowModification", "allowModificationRedistribution"),
        "otherLicenseUrl": "https://example.org/terms",
        "thumbnailImage": 1,
    }


class Drawn:
    """Values drawn by a seed; fields are there or not."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def some(self, **fields: Any) -> Json:
        return {key: one for key, one in fields.items() if self.rng.random() < 0.8}

    def real(self) -> float:
        return round(float(self.rng.uniform(0.1, 1.0)), 3)

    def vector(self, size: int = 3) -> list[float]:
        result: list[float] = self.rng.uniform(-1, 1, size).round(3).tolist()
        return result


def avatar(seed: int) -> bytes:
    """A VRM 1.0 that uses every field, some left out by the seed."""
    person, drawn = Person(seed), Drawn(seed + 1)
    node, real = person.node, drawn.real
    constraints = {
        "twist": {"roll": {"source": node["leftLowerArm"], "rollAxis": "X", "weight": 0.5}},
        "rightEye": {"rotation": {"source": node["leftEye"]}},
        "fringe": {"aim": {"source": node["head"], "aimAxis": "NegativeY", "weight": real()}},
    }
    whole = {name: {"specVersion": "1.0", "constraint": one} for name, one in constraints.items()}
    extensions = {"VRMC_vrm": _extension(node, drawn, seed), "VRMC_springBone": _springs(node, drawn)}
    return person.glb(extensions, whole)


def _extension(node: dict[str, int], drawn: Drawn, seed: int) -> Json:
    real, vector = drawn.real, drawn.vector

    def expression(*indices: int) -> Json:
        color = {"material": 1, "type": "emissionColor", "targetValue": [*vector(), 1.0]}
        return {
            "morphTargetBinds": [{"node": node["Face"], "index": index, "weight": real()} for index in indices],
            **drawn.some(
                materialColorBinds=[color, color | {"material": 2, "type": "color"}],
                textureTransformBinds=[{"material": 2, "scale": vector(2), "offset": vector(2)}],
                isBinary=True,
                overrideBlink="blend",
                overrideLookAt="none",
                overrideMouth="block",
            ),
        }

    annotations = (("Hat", "thirdPersonOnly"), ("Face", "auto"), ("Body", "both"))
    return {
        "specVersion": "1.0",
        "meta": terms(drawn.rng),
        "humanoid": {"humanBones": {bone: {"node": node[bone]} for bone in BONES}},
        "firstPerson": {"meshAnnotations": [{"node": node[mesh], "type": kind} for mesh, kind in annotations]},
        "lookAt": {
            "type": "bone" if seed % 2 else "expression",
            "offsetFromHeadBone": vector(),
            **{f"rangeMap{one}": {"inputMaxValue": 90 * real(), "outputScale": 10 * real()} for one in RANGES},
        },
        "expressions": {
            "preset": {"aa": expression(0), "happy": expression(1, 2), "blink": {}, "lookUp": expression(2)},
            "custom": {"Grumpy 😠": expression(3, 0)},
        },
    }


def _springs(node: dict[str, int], drawn: Drawn) -> Json:
    real, vector = drawn.real, drawn.vector

    def joint(name: str) -> Json:
        numbers = {key: real() for key in ("hitRadius", "stiffness", "gravityPower", "dragForce")}
        return {"node": node[name], **drawn.some(**numbers, gravityDir=[0.0, -1.0, 0.0])}

    sphere = {"shape": {"sphere": {"offset": vector(), "radius": real()}}}
    capsule = {"shape": {"capsule": {"offset": vector(), "radius": real(), "tail": vector()}}}
    plane = {"specVersion": "1.0", "shape": {"plane": {"offset": vector(), "normal": [0.0, 1.0, 0.0]}}}
    return {
        "specVersion": "1.0",
        "colliders": [
            {"node": node["collider"]} | sphere,
            {"node": node["chest"]} | capsule,
            {"node": node["hips"]} | sphere | {"extensions": {"VRMC_springBone_extended_collider": plane}},
        ],
        "colliderGroups": [{"name": "skull", "colliders": [0]}, {"colliders": [2, 1]}],
        "springs": [
            {
                "name": "hair",
                "joints": [*map(joint, ("hair1", "hair2")), {"node": node["hair3"]}],
                "colliderGroups": [1, 0],
                "center": node["head"],
            },
            {"joints": [joint("fringe"), {"node": node["hair3"]}]},
        ],
    }


def root_of(data: bytes) -> Json:
    """The JSON of a GLB."""
    root: Json = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    return root


def said(data: bytes) -> Json:
    """What a VRM 1.0 says of its avatar, every index a name."""
    root = root_of(data)
    nodes = [one["name"] for one in root["nodes"]]
    materials = [one["name"] for one in root.get("materials", [])]

    def named(value: Any, key: str = "") -> Any:
        if isinstance(value, dict):
            result = {one: named(inner, one) for one, inner in value.items()}
            if {"node", "index"} <= value.keys():
                mesh = root["meshes"][root["nodes"][value["node"]]["mesh"]]
                owner = mesh if "extras" in mesh else mesh["primitives"][0]
                result["index"] = owner["extras"]["targetNames"][value["index"]]
            return result
        if isinstance(value, list):
            return [named(one) for one in value]
        if key in ("node", "center", "source"):
            return nodes[value]
        if key == "thumbnailImage":
            view = root["bufferViews"][root["images"][value]["bufferView"]]
            binary = data[28 + int.from_bytes(data[12:16], "little") :]
            start = view.get("byteOffset", 0)
            return binary[start : start + view["byteLength"]].hex()
        return materials[value] if key == "material" else value

    own = root["extensions"]
    found = {name: named(own[name]) for name in ("VRMC_vrm", "VRMC_springBone") if name in own}
    constraints = {
        one["name"]: named(one["extensions"]["VRMC_node_constraint"])
        for one in root["nodes"]
        if "VRMC_node_constraint" in one.get("extensions", {})
    }
    return found | {"constraints": constraints}


def former_terms(**changes: Any) -> Json:
    """Terms of VRM 0.x, the loosest that it has."""
    return {
        "title": "Åsa 花子",
        "version": "0.9",
        "author": "A. Author",
        "contactInformation": "",
        "reference": "https://example.org/first",
        "texture": 0,
        "allowedUserName": "Everyone",
        "violentUssageName": "Allow",
        "sexualUssageName": "Disallow",
        "commercialUssageName": "Allow",
        "otherPermissionUrl": "https://example.org/terms",
        "licenseName": "Redistribution_Prohibited",
        "otherLicenseUrl": "",
        **changes,
    }


def former_avatar(seed: int, **terms: Any) -> tuple[bytes, Json]:
    """A VRM 0.x that looks along -Z, and what it says in the words of VRM 1.0: `said` without terms."""
    person = Person(seed, former=True)
    vectors = np.random.default_rng(seed).uniform(-0.2, 0.2, (3, 3)).round(4).tolist()
    return person.glb({"VRM": _former(person, vectors, terms)}), _as_newer(person, vectors)


def _former(person: Person, vectors: list[list[float]], changes: Json) -> Json:
    """
    :param vectors: of the person that looks along +Z: a collider's offset, the eyes above the head, and gravity
    """
    node = person.node
    number = {mesh["name"]: i for i, mesh in enumerate(person.builder.root["meshes"])}
    # Unity's space is left-handed, and the model looks the other way there
    offset, eyes, pull = (dict(zip("xyz", (-x, y, z), strict=True)) for x, y, z in vectors)
    curve = {"curve": [0, 0, 0, 1, 1, 1, 1, 0], "xRange": 80.0, "yRange": 9.0}

    def face(index: int, weight: float) -> Json:
        return {"mesh": number["Face mesh"], "index": index, "weight": weight}

    color = {"materialName": "skin", "propertyName": "_Color", "targetValue": [1.0, 0.5, 0.25, 1.0]}
    moved = {"materialName": "cloth", "propertyName": "_MainTex_ST", "targetValue": [0.5, 0.25, 0.125, 0.5]}
    groups = [
        {"name": "A", "presetName": "a", "binds": [face(0, 40)], "isBinary": False},
        {"name": "Joy", "presetName": "joy", "binds": [face(1, 100), face(2, 50)], "isBinary": True},
        {"name": "むっ", "presetName": "unknown", "binds": [face(3, 100)], "materialValues": [color, moved]},
    ]
    spring = {
        "comment": "hair",
        "stiffiness": 0.7,
        "gravityPower": 0.25,
        "gravityDir": pull,
        "dragForce": 0.4,
        "center": -1,
        "hitRadius": 0.02,
        "bones": [node["hair1"]],
        "colliderGroups": [1],
    }
    bones = [{"bone": bone, "node": node[bone], "useDefaultValues": True} for bone in BONES]
    return {
        "specVersion": "0.0",
        "meta": former_terms(**changes),
        "humanoid": {"humanBones": bones, "armStretch": 0.05, "hasTranslationDoF": False},
        "firstPerson": {
            "firstPersonBone": node["head"],
            "firstPersonBoneOffset": eyes,
            "meshAnnotations": [{"mesh": number["Hat"], "firstPersonFlag": "ThirdPersonOnly"}],
            "lookAtTypeName": "Bone",
            **{f"lookAt{one}": curve for one in RANGES},
        },
        "blendShapeMaster": {"blendShapeGroups": groups},
        "secondaryAnimation": {
            "colliderGroups": [
                {"node": node["chest"], "colliders": []},
                {"node": node["head"], "colliders": [{"offset": offset, "radius": 0.1}]},
            ],
            "boneGroups": [spring],
        },
        "materialProperties": [{"name": name, "shader": "VRM/MToon"} for name in ("unused", "skin", "cloth")],
    }


def _as_newer(person: Person, vectors: list[list[float]]) -> Json:
    """What `_former` says, in the words of VRM 1.0."""
    offset, eyes, pull = vectors
    joint = {"stiffness": 0.7, "gravityPower": 0.25, "gravityDir": pull, "dragForce": 0.4, "hitRadius": 0.02}
    first, other = ["hair2", "hair3"], ["fringe"]
    if person.builder.root["nodes"][person.node["hair1"]]["children"][0] == person.node["fringe"]:
        first, other = other, first

    def chain(names: list[str]) -> Json:
        joints = [*({"node": name} | joint for name in names), {"node": f"{names[-1]}_end"}]
        return {"name": "hair", "colliderGroups": [1], "joints": joints}

    def morphs(weights: dict[int, float]) -> Json:
        binds = [{"node": "Face", "index": SHAPES[index], "weight": weight} for index, weight in weights.items()]
        return {"morphTargetBinds": binds}

    colors = {"materialColorBinds": [{"material": "skin", "type": "color", "targetValue": [1.0, 0.5, 0.25, 1.0]}]}
    moves = {"textureTransformBinds": [{"material": "cloth", "scale": [0.5, 0.25], "offset": [0.125, 0.25]}]}
    ranges = {f"rangeMap{one}": {"inputMaxValue": 80.0, "outputScale": 9.0} for one in RANGES}
    return {
        "VRMC_vrm": {
            "specVersion": "1.0",
            "humanoid": {"humanBones": {bone: {"node": bone} for bone in BONES}},
            "firstPerson": {"meshAnnotations": [{"node": "Hat", "type": "thirdPersonOnly"}]},
            "lookAt": {"type": "bone", "offsetFromHeadBone": eyes, **ranges},
            "expressions": {
                "preset": {"aa": morphs({0: 0.4}), "happy": morphs({1: 1.0, 2: 0.5}) | {"isBinary": True}},
                "custom": {"むっ": morphs({3: 1.0}) | colors | moves},
            },
        },
        "VRMC_springBone": {
            "specVersion": "1.0",
            "colliders": [{"node": "head", "shape": {"sphere": {"offset": offset, "radius": 0.1}}}],
            "colliderGroups": [{"colliders": []}, {"colliders": [0]}],
            "springs": [chain(["hair1", *first]), chain(other)],
        },
        "constraints": {},
    }


def in_centimetres(data: bytes) -> bytes:
    """The same avatar below an armature of Blender's kind: Z up and in centimetres."""
    root, start = root_of(data), 28 + int.from_bytes(data[12:16], "little")
    binary, nodes, half = bytearray(data[start:]), {one["name"]: one for one in root["nodes"]}, float(np.sqrt(0.5))
    for name in (*BONES, *OTHERS):
        nodes[name]["translation"] = [100.0 * one for one in nodes[name]["translation"]]
    x, y, z = nodes["hips"]["translation"]
    nodes["Armature"] |= {"scale": [0.01] * 3, "rotation": [-half, 0.0, 0.0, half]}
    nodes["hips"] |= {"translation": [x, -z, y], "rotation": [half, 0.0, 0.0, half]}
    nodes["Hat"]["scale"] = [100.0] * 3
    view = root["bufferViews"][root["accessors"][root["skins"][0]["inverseBindMatrices"]]["bufferView"]]
    place = slice(view["byteOffset"], view["byteOffset"] + view["byteLength"])
    columns = np.frombuffer(bytes(binary[place]), "<f4").reshape(-1, 4, 4) * (100.0, 100.0, 100.0, 1.0)
    binary[place] = columns.astype("<f4").tobytes()
    return glb(root, bytes(binary))
