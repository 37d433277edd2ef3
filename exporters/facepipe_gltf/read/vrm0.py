"""VRM 0.x as VRM 1.0: its extension with the fields of the newer ones, and its model turned to look along +Z.

Source: the schema of VRM 0.0 and VRM Consortium's own migration (UniVRM, VRM10/Runtime/Migration): what it makes
stricter is made stricter here, and nothing is ever made looser. Vectors are of Unity's left-handed space: (x, y, z)
there is (x, y, -z) in the file, and (-x, y, z) once the model has turned by half a turn.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.parts import Animation, FaceParts, Mesh
from facepipe.records import Json
from facepipe_gltf.read.document import Document, Value, quote
from facepipe_gltf.read.skins import Nodes
from facepipe_gltf.vrm.options import EXTENSION, LICENSE_URL, STRICTEST
from facepipe_gltf.vrm_format import PRESETS, SPRINGS, VERSION

_PRESETS = {
    "joy": "happy",
    "sorrow": "sad",
    "fun": "relaxed",
    "angry": "angry",
    "neutral": "neutral",
    "a": "aa",
    "i": "ih",
    "u": "ou",
    "e": "ee",
    "o": "oh",
    "blink": "blink",
    "blink_l": "blinkLeft",
    "blink_r": "blinkRight",
    "lookup": "lookUp",
    "lookdown": "lookDown",
    "lookleft": "lookLeft",
    "lookright": "lookRight",
}
_THUMBS = {
    f"{side}Thumb{old}": f"{side}Thumb{new}"
    for side in ("left", "right")
    for old, new in (("Proximal", "Metacarpal"), ("Intermediate", "Proximal"))
}
_TEXTS = {"title": "name", "version": "version", "contactInformation": "contactInformation"}
_CHOICES: dict[str, tuple[str, dict[str, Any]]] = {
    "allowedUserName": (
        "avatarPermission",
        {
            "OnlyAuthor": "onlyAuthor",
            "ExplicitlyLicensedPerson": "onlySeparatelyLicensedPerson",
            "Everyone": "everyone",
        },
    ),
    "violentUssageName": ("allowExcessivelyViolentUsage", {"Disallow": False, "Allow": True}),
    "sexualUssageName": ("allowExcessivelySexualUsage", {"Disallow": False, "Allow": True}),
    "commercialUssageName": ("commercialUsage", {"Disallow": "personalNonProfit", "Allow": "personalProfit"}),
}
_CC = {
    "CC0": "publicdomain/zero/1.0",
    **{f"CC_{kind}": f"licenses/{kind.lower().replace('_', '-')}/4.0" for kind in ("BY", "BY_NC", "BY_SA", "BY_ND")},
    **{f"CC_{kind}": f"licenses/{kind.lower().replace('_', '-')}/4.0" for kind in ("BY_NC_SA", "BY_NC_ND")},
}
_MUSCLES = {  # of humans in Unity, where nobody has changed them
    "armStretch": 0.05,
    "legStretch": 0.05,
    "upperArmTwist": 0.5,
    "lowerArmTwist": 0.5,
    "upperLegTwist": 0.5,
    "lowerLegTwist": 0.5,
    "feetSpacing": 0,
    "hasTranslationDoF": False,
}
_COLORS = {
    "_Color": "color",
    "_EmissionColor": "emissionColor",
    "_RimColor": "rimColor",
    "_OutlineColor": "outlineColor",
    "_ShadeColor": "shadeColor",
}
_FLAGS = {
    "auto": "auto",
    "both": "both",
    "thirdpersononly": "thirdPersonOnly",
    "firstpersononly": "firstPersonOnly",
}
_RANGES = {
    "lookAtHorizontalInner": "rangeMapHorizontalInner",
    "lookAtHorizontalOuter": "rangeMapHorizontalOuter",
    "lookAtVerticalDown": "rangeMapVerticalDown",
    "lookAtVerticalUp": "rangeMapVerticalUp",
}
_STRAIGHT = [0, 0, 0, 1, 1, 1, 1, 0]  # the curve of a range that VRM 1.0 has
_EYES_ABOVE = 0.06  # metres, of an offset that isn't given
_TAIL = 0.07  # metres: VRM 0.x has every chain end in a bone of this length that is no node
_NOTED = 12  # lines on what has no counterpart
_HALF_TURN = np.array([-1.0, 1.0, -1.0])


class Tail(NamedTuple):
    """A joint to be at the end of a chain."""

    node: int  # the last of the chain
    offset: FloatArray  # (3,) from it


class Migrated(NamedTuple):
    """Extensions of VRM 1.0 with the indices of the document, and nodes that follow its own."""

    extensions: dict[str, Value]
    tails: list[Tail]


@dataclass
class _Migration:
    document: Document
    nodes: Nodes
    tails: list[Tail]

    def __post_init__(self) -> None:
        self.noted = 0
        self.showing: dict[int, list[int]] = {}  # mesh -> nodes that show it
        for node in self.nodes.shown:
            mesh = self.nodes.values[node].get_or("mesh", None).data
            if isinstance(mesh, int):
                self.showing.setdefault(mesh, []).append(node)
        self.children: dict[int, list[int]] = {}
        for node in self.nodes.order:
            self.children.setdefault(self.nodes.parents[node], []).append(node)

    def note(self, where: Value | str, what: str) -> None:
        """Name what has no counterpart; of hundreds of a kind the first."""
        self.noted += 1
        if self.noted <= _NOTED:
            self.document.warn(where, what)
        elif self.noted == _NOTED + 1:
            self.document.warn(self.document.root, "more of its VRM 0.x extension has no counterpart")

    def meta(self, meta: Value) -> Json:
        """Terms, never looser than they were: what VRM 0.x has no word for is prohibited."""
        known = _object(meta)
        result: Json = dict(STRICTEST)
        for old, new in _TEXTS.items():
            result[new] = known.get(old)
        result["authors"], result["references"] = [known.get("author")], [known.get("reference")]
        for old, (new, words) in _CHOICES.items():
            value = known.get(old)
            if isinstance(value, str) and value in words:
                result[new] = words[value]
            elif value is not None:
                what = f"{quote(str(value)[:60])}, expected {' or '.join(words)}: {new} is {result[new]}"
                self.note(meta, f"{old} {what}")
        name = known.get("licenseName")
        urls = [known.get("otherLicenseUrl"), known.get("otherPermissionUrl")]
        if isinstance(name, str) and name in _CC:
            urls.insert(0, f"https://creativecommons.org/{_CC[name]}/")
        result["otherLicenseUrl"] = ", ".join(dict.fromkeys(url for url in urls if isinstance(url, str) and url))
        result["licenseUrl"] = LICENSE_URL
        if name not in (None, "Redistribution_Prohibited"):
            what = f"licenseName {quote(str(name)[:40])} has no counterpart in VRM 1.0"
            self.note(meta, f"{what}: redistribution and modification are prohibited")
        texture = known.get("texture")
        if texture not in (None, -1):
            try:
                image = self.document.entry("textures", Value(texture, f"{meta.trail}.texture"))
                result["thumbnailImage"] = image.get_or("source", None).data
            except InputError as problem:
                self.note(problem.where, f"{problem.what}: left out")
        # texts that are empty were not given
        return {key: one for key, one in result.items() if one not in (None, "", [None], [""])}

    def humanoid(self, humanoid: Value) -> Json:
        bones: Json = {}
        entries = [_as_object(one) for one in _list(_object(humanoid).get("humanBones"))]
        for one in entries:
            bone = one.get("bone")
            if isinstance(bone, str) and one.get("node") != -1:
                bones[_THUMBS.get(bone, bone)] = {"node": one.get("node")}
        muscles = {key: value for key, value in _object(humanoid).items() if key != "humanBones"}
        if any(key in _MUSCLES and value != _MUSCLES[key] for key, value in muscles.items()) or any(
            one.get("useDefaultValues") is False for one in entries
        ):
            self.note(humanoid, "limits and stretch of Unity's muscles are left out")
        return {"humanBones": bones}

    def first_person(self, first: Value) -> Json:
        annotations = []
        for one in map(_as_object, _list(_object(first).get("meshAnnotations"))):
            kind = _FLAGS.get(str(one.get("firstPersonFlag"))[:20].lower())
            for node in self._nodes_of(first, one.get("mesh")):
                annotations.append({"node": node, "type": kind})
        return {"meshAnnotations": annotations}

    def look_at(self, first: Value) -> Json:
        given = _object(first)
        by_shapes = given.get("lookAtTypeName") == "BlendShape"
        offset = _as_object(given.get("firstPersonBoneOffset"))
        result: Json = {
            "type": "expression" if by_shapes else "bone",
            "offsetFromHeadBone": _turned(offset, {"y": _EYES_ABOVE}),
        }
        for old, new in _RANGES.items():
            one = _as_object(given.get(old))
            result[new] = {
                "inputMaxValue": one.get("xRange", 90.0),
                "outputScale": one.get("yRange", 1.0 if by_shapes else 10.0),
            }
            if one.get("curve") not in (None, [], _STRAIGHT):
                self.note(first, f"{old} is straight now: VRM 1.0 has no curves")
        return result

    def expressions(self, master: Value) -> Json:
        preset: Json = {}
        custom: Json = {}
        twice: dict[str, int] = {}  # name -> how often it was tried: of many of one name each would try them all
        materials: dict[Any, list[int]] = {}
        for number, value in enumerate(self.document.entries("materials")):
            name = value.get_or("name", None).data
            materials.setdefault(name if isinstance(name, str) else None, []).append(number)
        for group in map(_as_object, _list(_object(master).get("blendShapeGroups"))):
            name = group.get("name")
            known = _PRESETS.get(str(group.get("presetName", "unknown"))[:20].lower())
            expression = self._expression(master, group, materials)
            if known is not None and known not in preset:
                preset[known] = expression
                continue
            called = wanted = name if isinstance(name, str) and name else "expression"
            while called in custom or called in PRESETS:
                twice[wanted] = twice.get(wanted, 1) + 1
                called = f"{wanted}_{twice[wanted]}"
            custom[called] = expression
        return {"preset": preset, "custom": custom}

    def _expression(self, where: Value, group: Json, materials: Mapping[Any, list[int]]) -> Json:
        binds = []
        for one in map(_as_object, _list(group.get("binds"))):
            weight = one.get("weight", 0)
            share = weight * 0.01 if isinstance(weight, int | float) and not isinstance(weight, bool) else weight
            for node in self._nodes_of(where, one.get("mesh")):
                binds.append({"node": node, "index": one.get("index"), "weight": share})
        colors: list[Json] = []
        transforms: list[Json] = []
        for one in map(_as_object, _list(group.get("materialValues"))):
            name, kind, target = one.get("materialName"), str(one.get("propertyName")), _list(one.get("targetValue"))
            found = materials.get(name, []) if isinstance(name, str) else []
            numeric = len(target) == 4 and all(_is_number(x) for x in target)
            for material in found[:1]:
                if kind in _COLORS and numeric:
                    colors.append({"material": material, "type": _COLORS[kind], "targetValue": target})
                elif "_ST" in kind and numeric:
                    transforms.append({"material": material} | _transform(kind, target))
            if not found or not numeric or not (kind in _COLORS or "_ST" in kind):
                what = f"{quote(kind[:40])} of the material {quote(str(name)[:40])} left out of an expression"
                self.note(where, what)
        result: Json = {"morphTargetBinds": binds, "materialColorBinds": colors, "textureTransformBinds": transforms}
        result = {key: one for key, one in result.items() if one}
        return result | ({"isBinary": True} if group.get("isBinary") is True else {})

    def springs(self, second: Value) -> Json:
        given = _object(second)
        colliders: list[Json] = []
        groups = []
        for one in map(_as_object, _list(given.get("colliderGroups"))):
            own = []
            for ball in map(_as_object, _list(one.get("colliders"))):
                own.append(len(colliders))
                sphere = {"offset": _turned(_as_object(ball.get("offset"))), "radius": ball.get("radius", 0)}
                colliders.append({"node": one.get("node"), "shape": {"sphere": sphere}})
            groups.append({"colliders": own})
        springs: list[Json] = []
        moved: set[int] = set()
        for group in map(_as_object, _list(given.get("boneGroups"))):
            collides = _list(group.get("colliderGroups"))
            common: Json = {"colliderGroups": collides} if collides else {}
            if isinstance(group.get("comment"), str) and group["comment"]:
                common["name"] = group["comment"]
            if group.get("center", -1) != -1:
                common["center"] = group["center"]
            down = _turned(_as_object(group.get("gravityDir")), {"y": -1.0} if "gravityDir" not in group else {})
            joint = {
                "stiffness": group.get("stiffiness", 1.0),
                "gravityPower": group.get("gravityPower", 0.0),
                "gravityDir": down,
                "dragForce": group.get("dragForce", 0.4),
                "hitRadius": group.get("hitRadius", 0.02),
            }
            for root in _list(group.get("bones")):
                for chain in self._chains(second, root, moved):
                    self.document.budget.spend(16 * len(collides), second.error)  # each spring repeats them
                    last = len(self.nodes.values) + len(self.tails) - 1
                    springs.append(common | {"joints": [*({"node": node} | joint for node in chain), {"node": last}]})
        result = {"colliders": colliders, "colliderGroups": groups, "springs": springs}
        return {key: one for key, one in result.items() if one}

    def _chains(self, where: Value, root: object, moved: set[int]) -> Iterator[list[int]]:
        """Nodes from `root` down to each end, each in one chain alone; of each a tail is added."""
        count = len(self.nodes.values)
        if isinstance(root, bool) or not isinstance(root, int) or not 0 <= root < count:
            self.note(where, f"{quote(str(root)[:20])} is no node that springs: left out")
            return
        starts = [root]
        while starts:
            node: int | None = starts.pop()
            chain = []
            while node is not None and node not in moved:
                moved.add(node)
                chain.append(node)
                below = self.children.get(node, [])
                starts += reversed(below[1:])
                node = below[0] if below else None
            if chain:
                along = self.nodes.locals[chain[-1]][:3, 3]
                length = float(np.linalg.norm(along))
                self.tails.append(Tail(chain[-1], _TAIL * along / length if length > 0 else np.zeros(3)))
                yield chain

    def _nodes_of(self, where: Value, mesh: object) -> Sequence[int]:
        """The nodes that show a mesh."""
        nodes = self.showing.get(mesh, []) if isinstance(mesh, int) and not isinstance(mesh, bool) else []
        if not nodes:
            self.note(where, f"names the mesh {quote(str(mesh)[:20])}, which no node shows: left out")
        self.document.budget.spend(64 * len(nodes), where.error)
        return nodes


def migrated(document: Document, vrm: Value, nodes: Nodes) -> Migrated:
    """The extensions of VRM 1.0 that say what `vrm`, that of 0.x, does; what has no counterpart is named."""
    work = _Migration(document, nodes, [])

    def part(name: str) -> Value:
        return vrm.get_or(name, {})

    first = part("firstPerson")
    own: Json = {
        "specVersion": VERSION,
        "meta": work.meta(part("meta")),
        "humanoid": work.humanoid(part("humanoid")),
        "firstPerson": work.first_person(first),
        "lookAt": work.look_at(first),
        "expressions": work.expressions(part("blendShapeMaster")),
    }
    springs = work.springs(part("secondaryAnimation"))
    extensions = {EXTENSION: Value(own, vrm.trail)}
    if springs:
        extensions[SPRINGS] = Value({"specVersion": VERSION} | springs, f"{vrm.trail}.secondaryAnimation")
    shaders = [_as_object(one).get("shader") for one in _list(_object(vrm).get("materialProperties"))]
    toon = sum(isinstance(one, str) and one.startswith("VRM/") and "Unlit" not in one for one in shaders)
    if toon:
        work.note(vrm, f"toon shading of {toon} material{'s' * (toon > 1)} left out: the colours stay")
    return Migrated(extensions, work.tails)


def turned_round(face: FaceParts) -> FaceParts:
    """The face by half a turn about the vertical of its file, exactly: all of x and z change their signs.

    Matrices M become R M R, so that joints that were turned as the world is stay so.
    """

    def vectors(values: FloatArray) -> FloatArray:
        return np.asarray(values * _HALF_TURN.astype(np.asarray(values).dtype) + 0.0)

    def matrices(values: FloatArray) -> FloatArray:
        signs = np.append(_HALF_TURN, 1.0)
        return np.asarray(values) * np.outer(signs, signs) + 0.0

    def mesh(one: Mesh) -> Mesh:
        skin = one.skin
        return replace(
            one,
            points=vectors(one.points),
            normals=None if one.normals is None else vectors(one.normals),
            transform=matrices(one.transform),
            skin=skin and replace(skin, geom_bind_transform=matrices(skin.geom_bind_transform)),
            blendshapes=tuple(shape.changed(vectors, vectors) for shape in one.blendshapes),
        )

    def animation(one: Animation) -> Animation:
        moves, turns = one.translations, one.rotations
        return replace(
            one,
            translations=None if moves is None else vectors(moves),
            rotations=None if turns is None else np.asarray(turns * np.array([-1.0, 1.0, -1.0, 1.0], turns.dtype)),
        )

    skeleton = face.skeleton
    return replace(
        face,
        meshes=tuple(map(mesh, face.meshes)),
        skeleton=replace(
            skeleton,
            bind_transforms=matrices(skeleton.bind_transforms),
            rest_transforms=matrices(skeleton.rest_transforms),
            transform=matrices(skeleton.transform),
        ),
        animations=tuple(map(animation, face.animations)),
    )


def _transform(kind: str, target: Sequence[float]) -> Json:
    """Scale and offset of a texture, v down, of Unity's (scale x, scale y, offset x, offset y), v up."""
    x, y, at, up = target
    if kind.endswith("_ST_S"):
        y, up = 1.0, 0.0
    elif kind.endswith("_ST_T"):
        x, at = 1.0, 0.0
    return {"scale": [x, y], "offset": [at, 1.0 - up - y]}


def _turned(vector: Json, defaults: Mapping[str, float] | None = None) -> list[Any]:
    """A vector of Unity's space, in that of the turned model; what is no number stays, and is refused later."""
    x, y, z = (vector.get(axis, (defaults or {}).get(axis, 0.0)) for axis in "xyz")
    return [-x if _is_number(x) and x else x, y, z]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _object(value: Value) -> Json:
    return value.data if isinstance(value.data, dict) else {}


def _as_object(value: object) -> Json:
    return value if isinstance(value, dict) else {}


def _list(value: object) -> list[Any]:
    return value if isinstance(value, list) else []
