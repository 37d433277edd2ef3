"""Writes a face as an avatar's head, one .vrm file: the glTF of a standing person, and VRM's extension of it."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import ExportError, InputError
from facepipe.core.names import first_names
from facepipe.core.reports import ExportReport
from facepipe.parts import FaceParts, HasParts
from facepipe.records import Json
from facepipe.rig import build, set_face
from facepipe.rig.trs import decompose, rest_worlds
from facepipe_gltf.document import Document, write
from facepipe_gltf.placement import numbers, place, space_of
from facepipe_gltf.raw import local_matrix, path_above
from facepipe_gltf.vrm.bones import REQUIRED, SIDES, TORSO, Humanoid, humanoid_of, misplaced
from facepipe_gltf.vrm.expressions import Expressions, expressions_of, table, with_slider_shapes
from facepipe_gltf.vrm.kept import kept_bones, kept_meta, kept_stubs, with_thumbnail, write_back
from facepipe_gltf.vrm.options import EXTENSION, Options, meta_of
from facepipe_gltf.writer import embedded, report_of, write_glb

# Parts of a person's height (Drillis and Contini 1966, after Winter, Biomechanics and Motor Control of Human Movement)
_HIPS, _CHIN = 0.53, 0.87
_SPINE, _SHOULDER, _SKULL = 0.58, 0.818, 0.905
_KNEE, _ANKLE = 0.285, 0.039
_SHOULDER_OUT, _UPPER_ARM, _FOREARM = 0.129, 0.186, 0.146
_LEG_OUT = 0.055
_HEADS = 6.0  # head heights in a person's height where no landmark says where the chin is: heads come with their necks
_SCHEME, _MARKS, _CHIN_MARK, _RIGHT_EYE, _LEFT_EYE = "multipie68", 68, 8, slice(36, 42), slice(42, 48)
_QUARTER = math.pi / 2
_BODY_PROPORTION = 3.0
_UNIFORM = 1e-4
_RANGE_FIELDS = {
    "rangeMapHorizontalInner": "inner",
    "rangeMapHorizontalOuter": "outer",
    "rangeMapVerticalDown": "down",
    "rangeMapVerticalUp": "up",
}


class NodeTree:
    """The nodes of a document's only scene."""

    def __init__(self, document: Json) -> None:
        self.nodes: list[Json] = document.setdefault("nodes", [])
        self.roots: list[int] = document["scenes"][0].setdefault("nodes", [])
        self._parent = {child: i for i, node in enumerate(self.nodes) for child in node.get("children", [])}
        self._names = {node.get("name") for node in self.nodes}

    def path(self, node: int) -> list[int]:
        """The node and all above it, the root last."""
        return path_above(node, self._parent.get)

    def world(self, node: int) -> FloatArray:
        """(4, 4) world matrix at rest."""
        result = np.eye(4)
        for one in self.path(node):
            result = local_matrix(self.nodes[one]) @ result
        return result

    def add(self, name: str, place: FloatArray, parent: int | None) -> int:
        """A node at a `place` (3,) of the world, turned as its parent is; its number."""
        while name in self._names:
            name += "_"
        self._names.add(name)
        self.nodes.append({"name": name})
        number = len(self.nodes) - 1
        self._put(number, parent)
        above = np.eye(4) if parent is None else self.world(parent)
        self._translate(number, (np.linalg.inv(above) @ [*place, 1.0])[:3])
        return number

    def hang(self, node: int, under: int) -> None:
        """Hang a node under another that is turned as the one above it was: its translation alone changes."""
        offset = (np.linalg.inv(self.world(under)) @ self.world(node))[:3, 3]
        self._take(node)
        self._put(node, under)
        self._translate(node, offset)

    def hang_mesh(self, node: int, under: int) -> None:
        """Hang the node of a mesh, at the scene's root without a transform, under another."""
        local = decompose(np.linalg.inv(self.world(under))[None])
        self._take(node)
        self._put(node, under)
        self._translate(node, local.translation[0])
        for key, values, plain in (("rotation", local.rotation, [0, 0, 0, 1]), ("scale", local.scale, [1, 1, 1])):
            if numbers(values[0]) != plain:
                self.nodes[node][key] = numbers(values[0])

    def _take(self, node: int) -> None:
        parent = self._parent.pop(node, None)
        siblings = self.roots if parent is None else self.nodes[parent]["children"]
        siblings.remove(node)
        if parent is not None and not siblings:
            del self.nodes[parent]["children"]

    def _put(self, node: int, under: int | None) -> None:
        if under is None:
            self.roots.append(node)
        else:
            self._parent[node] = under
            self.nodes[under].setdefault("children", []).append(node)

    def _translate(self, node: int, offset: FloatArray) -> None:
        self.nodes[node].pop("translation", None)
        if np.any(offset):
            self.nodes[node]["translation"] = numbers(offset)


@dataclass(frozen=True)
class Figure:
    """Measures of a face in glTF space: metres, Y up."""

    eyes: FloatArray | None  # (2, 3) left, right; None: not known
    low: FloatArray  # (3,) of the rest bounding box
    high: FloatArray  # (3,)
    height: float  # of the standing person
    joints: FloatArray  # (j, 3) at rest

    @property
    def middle(self) -> FloatArray:
        """(3,) between the eyes where they are known, on the middle of the head's depth."""
        center = (self.low + self.high) / 2
        return center if self.eyes is None else np.array([self.eyes[:, 0].mean(), self.eyes[:, 1].mean(), center[2]])


def figure_of(parts: FaceParts, bones: Mapping[str, int]) -> Figure:
    """The measures of a face whose human `bones` are these joints."""
    space = space_of(parts)
    points = [place(mesh, parts.skeleton, space, skinned=False).points(mesh.points) for mesh in parts.meshes]
    every = np.concatenate([np.zeros((0, 3)), *points])
    low, high = (every.min(axis=0), every.max(axis=0)) if len(every) else (np.zeros(3), np.ones(3))
    joints = (space.skeleton @ rest_worlds(parts.skeleton))[:, :3, 3]
    height = _HEADS * (high[1] - low[1])
    listed = [mesh.landmarks[_SCHEME].indices if _SCHEME in mesh.landmarks else () for mesh in parts.meshes]
    marked = [own[np.asarray(one)] for own, one in zip(points, listed, strict=True) if len(one) == _MARKS]
    marks = marked[0] if marked else None
    if marks is not None and high[1] > marks[_CHIN_MARK, 1]:
        height = (high[1] - marks[_CHIN_MARK, 1]) / (1 - _CHIN)
    if "hips" in bones and high[1] > joints[bones["hips"], 1]:
        height = (high[1] - joints[bones["hips"], 1]) / (1 - _HIPS)
    # by joints, else landmarks, else where the shapes of blinking move points
    eyes: FloatArray | None = None
    if "leftEye" in bones and "rightEye" in bones:
        eyes = joints[[bones["leftEye"], bones["rightEye"]]]
    elif marks is not None:
        eyes = np.stack([marks[_LEFT_EYE].mean(axis=0), marks[_RIGHT_EYE].mean(axis=0)])
    else:
        middles = []
        for side in ("Left", "Right"):
            rows: list[FloatArray] = [np.zeros((0, 3))]
            weights: list[FloatArray] = [np.zeros(0)]
            for mesh, own in zip(parts.meshes, points, strict=True):
                for shape in mesh.blendshapes:
                    if shape.name == f"eyeBlink{side}":
                        rows.append(own[np.asarray(shape.point_indices)])
                        weights.append(np.linalg.norm(np.asarray(shape.offsets, np.float64), axis=1))
            far = np.concatenate(weights)  # the farther a point moves, the more it counts
            if far.sum():
                middles.append(np.average(np.concatenate(rows), axis=0, weights=far))
        eyes = np.stack(middles) if len(middles) == 2 else None
    return Figure(eyes, low, high, float(height), joints)


def _moved(parts: FaceParts, matrix: FloatArray) -> FaceParts:
    """The whole face moved by a rigid `matrix` (4, 4) of glTF space."""
    world = parts.gltf_axes
    return parts.placed(np.linalg.inv(world) @ matrix @ world)


def _missing(present: Sequence[str]) -> tuple[str, ...]:
    """The required bones that are not there, in the specification's order."""
    return tuple(bone for bone in REQUIRED if bone not in present)


def _add_spine(tree: NodeTree, bones: dict[str, int], figure: Figure, own_torso: Sequence[str]) -> None:
    """A spine above the hips, and what hangs there now above the spine."""
    next_up = next((bone for bone in own_torso if bone != "hips"), None)
    if "hips" not in own_torso:
        bones["spine"] = tree.add("spine", _at(figure, _SPINE), bones["hips"])
        if next_up is not None:
            tree.hang(tree.path(bones[next_up])[-1], bones["spine"])
        return
    low = tree.world(bones["hips"])[:3, 3]
    up = _at(figure, _SKULL) if next_up is None else tree.world(bones[next_up])[:3, 3]
    part = (_SPINE - _HIPS) / (_SKULL - _HIPS)
    bones["spine"] = tree.add("spine", low + part * (up - low), bones["hips"])
    arms = [f"{side}{part}" for side in SIDES for part in ("Shoulder", "UpperArm")]
    for bone in (one for one in (next_up, *arms) if one in bones):
        path = tree.path(bones[bone])
        if bones["spine"] not in path and bones["hips"] in path:
            tree.hang(path[path.index(bones["hips"]) - 1], bones["spine"])


def _at(figure: Figure, part: float) -> FloatArray:
    """(3,) at a part of the person's height, below the middle of the head."""
    return np.array([figure.middle[0], part * figure.height, figure.middle[2]])


def export(face: HasParts, path: str | os.PathLike[str], options: Options | None = None) -> ExportReport:
    """Write a face as VRM 1.0.

    :raises InputError: another suffix, no licence or authors, human bones that are missing, a shape glob that matches
        nothing, or no such pose
    :raises ExportError: a face that glTF can't hold
    """
    start = time.perf_counter()
    (target,) = outputs(path)
    options = options or Options()
    if options.pose == "set-joints":
        raise InputError("option pose", "set-joints scales joints, which VRM doesn't allow, expected set or rest")
    delivered = set_face(face.parts(), options.pose)
    document, added = _vrm_document(delivered.parts, options, target.stem)
    return report_of(document, write_glb(target, *embedded(document)), delivered, start, added)


def outputs(path: str | os.PathLike[str]) -> tuple[Path, ...]:
    """The file that `export` to `path` writes.

    :raises InputError: another suffix than .vrm
    """
    target = Path(path)
    if target.suffix.lower() != ".vrm":
        raise InputError(target, f"suffix '{target.suffix}', expected .vrm")
    return (target,)


def _vrm_document(parts: FaceParts, options: Options, name: str) -> tuple[Document, tuple[str, ...]]:
    """The VRM document of a face, and what was added to the face.

    :param name: what the model is called where the options don't say
    :raises InputError: no licence or authors, or bones that the face lacks and may not get
    :raises ExportError: a face that glTF can't hold
    """
    meta = meta_of(options, name, parts.attribution, kept_meta(parts))
    humanoid = _humanoid(parts, options)
    missing = _missing([*humanoid.bones])
    shaped, slider_shapes = with_slider_shapes(replace(parts, vrm={}))
    placed, figure, added = shaped, figure_of(shaped, humanoid.bones), list[str]()
    if missing or EXTENSION not in parts.vrm:  # a model of VRM stands as it is to stand
        placed, figure, added = _standing(shaped, humanoid, bool(missing))
    # without tangents, which readers compute: a VRM holds what every runtime reads
    document = write(replace(placed, animations=()), options.gltf, tangents=False)
    meta, document = with_thumbnail(meta, document)
    tree = NodeTree(document.json)
    bones = _human_nodes(parts, document, tree, humanoid, figure, added)
    if EXTENSION in parts.vrm:
        extension, more = write_back(parts.vrm, document.places, document.json)
    else:
        extension, more = _new_extension(placed, document, tree, humanoid, bones, figure)
    extension |= {
        "specVersion": "1.0",
        "meta": meta,
        "humanoid": {"humanBones": {bone: {"node": node} for bone, node in bones.items()}},
    }
    lost = [*document.dropped, *more]
    if parts.animations:
        lost.append(f"{len(parts.animations)} animations (VRM files have none)")
    document.json.setdefault("extensions", {})[EXTENSION] = extension
    document.json["extensionsUsed"] = sorted([*document.json.get("extensionsUsed", []), EXTENSION])
    counts = {"human bones": len(bones), "expressions": sum(map(len, extension.get("expressions", {}).values()))}
    # a line on nodes whose scale is not one positive number, which VRM requires (tpose.md)
    scaled = [(node["name"], node["scale"]) for node in tree.nodes if "scale" in node]
    odd = [name for name, (x, y, z) in scaled if min(x, y, z) <= 0 or max(x, y, z) > min(x, y, z) * (1 + _UNIFORM)]
    some = first_names(odd, 3)
    warnings = (
        *document.warnings,
        *humanoid.unfit,
        *([f"{some}: scaled unevenly or mirrored; VRM's runtimes may not keep that"] if odd else []),
    )
    finished = replace(document, counts=document.counts | counts, warnings=warnings, dropped=tuple(lost))
    return finished, (*added, *slider_shapes)


def _humanoid(parts: FaceParts, options: Options) -> Humanoid:
    """The human bones of a face, those it came with before those that names say.

    :raises InputError: bones that the face lacks and may not get
    """
    avatar, stubs = EXTENSION in parts.vrm, kept_stubs(parts)
    humanoid = humanoid_of(parts, options.bones, kept_bones(parts) if avatar else None)
    missing = _missing([*humanoid.bones])
    # bones between those of a known body can be added, a second body can't
    whole = not stubs and (avatar or not missing or ("hips" not in humanoid.bones and is_body(parts)))
    if options.stub_body and whole:
        how = f"no joints are known as {', '.join(missing)}: option bones names them" if missing else "it is complete"
        raise InputError("option stub_body", f"the face has a body, expected a head without one ({how})")
    if missing and not options.stub_body and not {*missing} <= stubs:
        what = f"no joints for {len(missing)} of the 15 human bones that VRM requires: {', '.join(missing)}"
        ways = "joints of known names, or option bones, which names them"
        if not whole:
            ways = "joints of known names, or option stub_body, which adds them"
        raise InputError(parts.name, f"{what}; expected {ways}")
    return humanoid


def is_body(parts: FaceParts) -> bool:
    """Whether a face has the joints and the proportions of a body, whatever its joints are called.

    The depth of a standing or lying body is less than a third of its length, arms held out or not; a head's is more.
    """
    used = {
        int(joint)
        for mesh in parts.meshes
        if mesh.skin is not None
        for joint in np.unique(np.asarray(mesh.skin.joint_indices)[np.asarray(mesh.skin.joint_weights) > 0])
    }
    if len(used) < len(REQUIRED):
        return False
    points = build(parts).evaluate()
    sides = np.sort(np.ptp(points, axis=0)) if len(points) else np.zeros(3)
    return bool(sides[0] * _BODY_PROPORTION < sides[2])


def _new_extension(
    parts: FaceParts,
    document: Document,
    tree: NodeTree,
    humanoid: Humanoid,
    bones: Mapping[str, int],
    figure: Figure,
) -> tuple[Json, list[str]]:
    """Expressions, first person and lookAt of a face that is new to VRM, and lines on what it has none of."""
    expressions = expressions_of(tree.nodes, document.json.get("meshes", []))
    shown = [i for i, node in enumerate(tree.nodes) if "mesh" in node]
    extension: Json = {
        "expressions": expressions.json,
        "firstPerson": {"meshAnnotations": [{"node": node, "type": "auto"} for node in shown]},
    }
    lost = list(expressions.lost)
    if figure.eyes is None:
        lost.append("lookAt (no eye joints, no landmarks multipie68, no shapes eyeBlink)")
    else:
        gaze = _gaze(parts, humanoid, expressions)
        extension["lookAt"] = _look_at(tree, bones, figure.eyes, gaze or "expression")
        if gaze is None:
            lost.append("the gaze (neither eye joints with skin weights nor the shapes eyeLook turn the eyes)")
    return extension, lost


def _human_nodes(
    parts: FaceParts, document: Document, tree: NodeTree, humanoid: Humanoid, figure: Figure, added: list[str]
) -> dict[str, int]:
    """Human bone -> node, with those added that are missing; meshes without a skin hang on the head."""
    skins = document.json.get("skins", [])
    bones = {bone: skins[0]["joints"][joint] for bone, joint in humanoid.bones.items()}
    missing = _missing([*bones])
    if missing:
        # the face's own joints hang on the added ones: its roots, before any is added
        roots = [root for root in tree.roots if "mesh" not in tree.nodes[root]]
        own_torso = [bone for bone in TORSO if bone in bones]
        if "hips" not in bones:
            root = tree.add("root", np.zeros(3), None)
            legs = [tree.world(bones[f"{side}UpperLeg"])[:3, 3] for side in SIDES if f"{side}UpperLeg" in bones]
            bones["hips"] = tree.add("hips", np.mean(legs, axis=0) if len(legs) == 2 else _at(figure, _HIPS), root)
        if "spine" not in bones:
            _add_spine(tree, bones, figure, own_torso)
        elif "hips" not in own_torso:
            tree.hang(tree.path(bones["spine"])[-1], bones["hips"])
        if "head" not in bones:
            bones["head"] = tree.add("head", _at(figure, _SKULL), bones["spine"])
            for root in roots:
                tree.hang(root, bones["head"])
        for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
            upper, lower, foot = (f"{side}{part}" for part in ("UpperLeg", "LowerLeg", "Foot"))
            if upper not in bones:
                x, y, z = tree.world(bones["hips"])[:3, 3]
                bones[upper] = tree.add(upper, np.array([x + sign * _LEG_OUT * figure.height, y, z]), bones["hips"])
            for bone, above, part in ((lower, upper, _KNEE / _HIPS), (foot, lower, _ANKLE / _KNEE)):
                if bone not in bones:
                    place = tree.world(bones[above])[:3, 3] * (1, part, 1)
                    bones[bone] = tree.add(bone, place, bones[above])
            upper, lower, hand = (f"{side}{part}" for part in ("UpperArm", "LowerArm", "Hand"))
            if upper not in bones:
                parent = next(bones[one] for one in (f"{side}Shoulder", "upperChest", "chest", "spine") if one in bones)
                place = _at(figure, _SHOULDER)
                place[0] += sign * _SHOULDER_OUT * figure.height
                bones[upper] = tree.add(upper, place, parent)
            for bone, above, part in ((lower, upper, _UPPER_ARM), (hand, lower, _FOREARM)):
                if bone not in bones:
                    place = tree.world(bones[above])[:3, 3]
                    place[0] += sign * part * figure.height
                    bones[bone] = tree.add(bone, place, bones[above])
        added.append(f"human bones that move no point: {', '.join(missing)}")
        wrong = misplaced(bones, tree.path)
        if wrong is not None:
            name = tree.nodes[bones[wrong.bone]]["name"]
            what = f"is the {wrong.bone} below the {wrong.found}, expected it below the {wrong.expected}"
            raise ExportError(
                f"{parts.name} -> {name}", f"{what}: the joints between are missing (option bones names them)"
            )
    loose = [node for node in tree.roots if "mesh" in tree.nodes[node] and "skin" not in tree.nodes[node]]
    if EXTENSION in parts.vrm and not kept_stubs(parts):  # the avatar's own author has left them where they are
        loose = []
    for node in loose:
        tree.hang_mesh(node, bones["head"])
    if loose and skins:
        added.append(f"{', '.join(tree.nodes[node]['name'] for node in loose)} below the head: no joint moved them")
    return bones


def _standing(parts: FaceParts, humanoid: Humanoid, stub: bool) -> tuple[FaceParts, Figure, list[str]]:
    """The face, turned to look along +Z and, above an added body, at a person's height; what was changed."""
    changes = []
    figure = figure_of(parts, humanoid.bones)
    x, y, z = np.zeros(3) if figure.eyes is None else figure.eyes[0] - figure.eyes[1]
    # by quarters, as axes differ between programs; the left eye of who looks along +Z is on the side of +X
    steps = round(math.atan2(z, x) / _QUARTER) % 4
    if steps and abs(y) <= math.hypot(x, z):
        sine, cosine, degrees = {1: (1, 0, 90), 2: (0, -1, 180), 3: (-1, 0, -90)}[steps]
        turn = np.eye(4)
        turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = cosine, sine, -sine, cosine
        parts = _moved(parts, turn)
        figure = figure_of(parts, humanoid.bones)
        changes.append(f"a turn by {degrees} degrees about the up axis: VRM's models look along +Z")
    if stub and not {"leftFoot", "rightFoot"} & {*humanoid.bones}:
        # on a body that stands on the ground; sideways only where the whole body is new
        matrix, hips = np.eye(4), humanoid.bones.get("hips")
        if hips is None:
            matrix[:3, 3] = -figure.middle[0], figure.height - figure.high[1], -figure.middle[2]
        else:
            matrix[1, 3] = _HIPS * figure.height - figure.joints[hips, 1]
        parts = _moved(parts, matrix)
        figure = figure_of(parts, humanoid.bones)
        up = f"{1000 * matrix[1, 3]:.0f} mm"
        if up not in ("0 mm", "-0 mm"):  # of a model that stands already
            changes.append(f"{up} of height: feet stand at 0, the top of the head at {figure.high[1]:.2f} m")
    return parts, figure, changes


def _gaze(parts: FaceParts, humanoid: Humanoid, expressions: Expressions) -> Literal["bone", "expression"] | None:
    """How the eyes turn: by their bones where these move points, else by shapes; None for neither."""
    weighted = set[int]()
    for mesh in parts.meshes:
        if mesh.skin is not None:
            used = np.asarray(mesh.skin.joint_weights) > 0
            weighted |= {*np.unique(np.asarray(mesh.skin.joint_indices)[used]).tolist()}
    if {humanoid.bones.get("leftEye", -1), humanoid.bones.get("rightEye", -1)} <= weighted:
        return "bone"
    return "expression" if expressions.has("lookUp", "lookDown", "lookLeft", "lookRight") else None


def _look_at(tree: NodeTree, bones: Mapping[str, int], eyes: FloatArray, kind: Literal["bone", "expression"]) -> Json:
    """`VRMC_vrm.lookAt`: bones turn by the angle of what is looked at, up to a limit, where shapes are fully on.

    :param eyes: (2, 3) left and right
    """
    between = np.linalg.inv(tree.world(bones["head"])) @ [*eyes.mean(axis=0), 1.0]
    limits = {field: table()["degrees"][kind][name] for field, name in _RANGE_FIELDS.items()}
    ranges = {
        field: {"inputMaxValue": limit, "outputScale": limit if kind == "bone" else 1.0}
        for field, limit in limits.items()
    }
    return {"type": kind, "offsetFromHeadBone": numbers(between[:3])} | ranges
