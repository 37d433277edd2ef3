"""Checks of .vrm files: those of glTF, and the rules of VRM 1.0."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from facepipe.core.errors import InputError
from facepipe.core.reports import Finding
from facepipe.records import Json
from facepipe_gltf.mesh_validation import Problem, primitives_of, targets
from facepipe_gltf.raw import (
    RawDocument,
    as_list,
    as_object,
    is_index,
    local_matrix,
    parents,
    path_above,
    world_matrices,
)
from facepipe_gltf.read.document import Value
from facepipe_gltf.validation import CHECKS, judged
from facepipe_gltf.vrm.bones import PARENTS, REQUIRED, SIDES, misplaced
from facepipe_gltf.vrm.expressions import table
from facepipe_gltf.vrm.options import EXTENSION, problems
from facepipe_gltf.vrm_format import CONSTRAINT, SPRINGS, VERSION, converted

_LEVEL = 0.26  # sine of 15 degrees, by which arms held out may be off
_UNIFORM = 1e-4
_RANGES = ("rangeMapHorizontalInner", "rangeMapHorizontalOuter", "rangeMapVerticalDown", "rangeMapVerticalUp")


def validate(path: str | os.PathLike[str], *, khronos: bool = True) -> tuple[Finding, ...]:
    """Findings of all checks in a .vrm.

    :param khronos: also run the Khronos validator; a note says so where it is not installed
    :raises InputError: no such file, or no glTF at all
    """
    document = RawDocument(Path(path))
    vrm = as_object(as_object(document.json.get("extensions")).get(EXTENSION))
    checks = [(name, partial(check, vrm=vrm), severity) for name, check, severity in _CHECKS]
    return judged(document, (*checks, *CHECKS), khronos=khronos)


def _version(document: RawDocument, vrm: Json) -> Iterator[Problem]:
    """The file says that it is VRM 1.0."""
    if vrm.get("specVersion") != "1.0":
        found = f"specVersion {str(vrm['specVersion'])[:40]}" if "specVersion" in vrm else f"no {EXTENSION}"
        yield "/extensions", f"{found}, expected {EXTENSION} with specVersion 1.0"
    if EXTENSION not in as_list(document.json.get("extensionsUsed")):
        yield "/extensionsUsed", f"no {EXTENSION}, expected it"


def _meta(document: RawDocument, vrm: Json) -> Iterator[Problem]:
    """The model has a name, authors and a licence."""
    for field, what in problems(as_object(vrm.get("meta"))):
        yield f"/extensions/{EXTENSION}/meta/{field}", what


def _bones(document: RawDocument, vrm: Json) -> Iterator[Problem]:
    """The required human bones are there, each a node of its own below the right one."""
    where = f"/extensions/{EXTENSION}/humanoid/humanBones"
    count = len(document.items("nodes"))
    bones = _human_bones(vrm)
    for bone in REQUIRED:
        if bone not in bones:
            yield where, f"no {bone}, expected one"
    known: dict[str, int] = {}
    for bone, node in bones.items():
        if bone not in PARENTS:
            yield f"{where}/{bone}", "is no human bone of VRM 1.0"
        elif not is_index(node) or node >= count:
            yield f"{where}/{bone}/node", f"{str(node)[:40]}, expected 0 to {count - 1}"
        elif node in known.values():
            yield f"{where}/{bone}/node", f"{node} is another human bone too, expected each node once"
        else:
            known[bone] = node
    # of a node that several name the first parent counts: the check of the tree has reported it
    above = parents(document)
    wrong = misplaced(known, lambda node: path_above(node, lambda child: above.get(child, [None])[0]))
    if wrong is not None:
        yield f"{where}/{wrong.bone}", f"below {wrong.found or 'no human bone'}, expected below {wrong.expected}"


def _scales(document: RawDocument, vrm: Json) -> Iterator[Problem]:
    """Scales of nodes are positive and the same on all axes."""
    for i, node in enumerate(document.items("nodes")):
        scale = np.linalg.norm(local_matrix(node)[:3, :3], axis=0)
        own = node.get("scale")
        negative = isinstance(own, list) and any(isinstance(one, int | float) and one <= 0 for one in own)
        if negative or np.ptp(scale) > _UNIFORM * max(float(scale.max()), 1e-30):
            yield f"/nodes/{i}/scale", f"{[round(float(one), 4) for one in scale]}, expected one positive number"


def _pose(document: RawDocument, vrm: Json) -> Iterator[Problem]:
    """The model stands upright, looks along +Z and holds its arms out (tpose.md)."""
    count = len(document.items("nodes"))
    known = {bone: node for bone, node in _human_bones(vrm).items() if is_index(node) and node < count}
    worlds = world_matrices(document, list(known.values()))
    place = {bone: world[:3, 3] for bone, world in zip(known, worlds, strict=True)}
    where = f"/extensions/{EXTENSION}/humanoid/humanBones"
    if {"hips", "head"} <= place.keys() and place["head"][1] <= place["hips"][1]:
        yield f"{where}/head", "not above the hips, expected a standing model"
    for left in [bone for bone in place if bone.startswith("left")]:
        right = f"right{left[4:]}"
        if right in place and place[left][0] <= place[right][0]:
            yield f"{where}/{left}", f"not on the +X side of {right}, expected a model that looks along +Z"
    for side in SIDES:
        upper, hand = place.get(f"{side}UpperArm"), place.get(f"{side}Hand")
        if upper is not None and hand is not None:
            along = (hand - upper) / max(float(np.linalg.norm(hand - upper)), 1e-30)
            # |x| is the cosine of the slope whose sine may be _LEVEL: arms may point up, down, fore or back alike
            if abs(along[0]) < np.sqrt(1 - _LEVEL**2):
                yield f"{where}/{side}Hand", "arm not held out to the side, expected VRM's T-pose"
    feet = [place[bone][1] for bone in ("leftFoot", "rightFoot") if bone in place]
    if feet and min(feet) < -1e-3:
        yield where, f"feet at {min(feet):.3f} m, expected the ground at 0"


def _expressions(document: RawDocument, vrm: Json) -> Iterator[Problem]:
    """Binds name morph targets that are there, presets are VRM's and other names are not."""
    expressions = as_object(vrm.get("expressions"))
    presets = table()["preset"]
    # of a mesh whose primitives differ, which another check reports, the fewest
    counts = [
        min((len(targets(one)) for _, one in primitives_of(mesh)), default=None) for mesh in document.items("meshes")
    ]
    for group in ("preset", "custom"):
        for name, expression in as_object(expressions.get(group)).items():
            where = f"/extensions/{EXTENSION}/expressions/{group}/{name}"
            if (name in presets) != (group == "preset"):
                yield where, "is no preset of VRM 1.0" if group == "preset" else "has the name of a preset"
            for i, bind in enumerate(as_list(as_object(expression).get("morphTargetBinds"))):
                at, bind = f"{where}/morphTargetBinds/{i}", as_object(bind)
                mesh = (document.item("nodes", bind.get("node")) or {}).get("mesh")
                count = counts[mesh] if is_index(mesh) and mesh < len(counts) else None
                index, weight = bind.get("index"), bind.get("weight")
                if count is None:
                    yield f"{at}/node", f"{str(bind.get('node'))[:40]}, expected a node with a mesh"
                elif not is_index(index) or index >= count:
                    yield f"{at}/index", f"{str(index)[:40]}, expected a target below {count}"
                if isinstance(weight, bool) or not isinstance(weight, int | float) or not 0 <= weight <= 1:
                    yield f"{at}/weight", f"{str(weight)[:40]}, expected 0 to 1"


def _look_at(document: RawDocument, vrm: Json) -> Iterator[Problem]:
    """The bones or expressions that turn the eyes exist."""
    look_at = vrm.get("lookAt")
    if look_at is None:
        return
    where = f"/extensions/{EXTENSION}/lookAt"
    look_at = as_object(look_at)
    if look_at.get("type") not in ("bone", "expression"):
        yield f"{where}/type", f"{str(look_at.get('type'))[:40]}, expected bone or expression"
    if look_at.get("type") == "bone" and not {"leftEye", "rightEye"} <= _human_bones(vrm).keys():
        yield f"{where}/type", "bone without the human bones leftEye and rightEye, expected both"
    for name in _RANGES:
        if name in look_at and not {"inputMaxValue", "outputScale"} <= {*as_object(look_at[name])}:
            yield f"{where}/{name}", "expected inputMaxValue and outputScale"


class _Checked:
    """References within a document; `found` gets what is wrong."""

    def __init__(self, document: RawDocument) -> None:
        self._document = document
        self.found: list[Problem] = []

    def joint(self, value: Value) -> int:
        if self._document.item("nodes", value.data) is None:
            raise value.error(f"{str(value.data)[:40]}, expected a node")
        return value.integer()

    def mesh(self, value: Value) -> int:
        if "mesh" not in (self._document.item("nodes", value.data) or {}):
            raise value.error(f"{str(value.data)[:40]}, expected a node with a mesh")
        return value.integer()

    def target(self, mesh: Value, value: Value) -> int:
        return value.integer()

    def materials(self, value: Value) -> list[int]:
        return [value.integer()]

    def image(self, value: Value) -> int:
        return value.integer()

    def left_out(self, problem: InputError) -> None:
        self.found.append((re.sub(r"[.\[\]]+", "/", str(problem.where)).rstrip("/"), problem.what))


def _read(document: RawDocument, name: str, data: object, where: str) -> Iterator[Problem]:
    """What is wrong with an extension by the table of its fields."""
    links = _Checked(document)
    try:
        converted(name, Value(data, where), links)
    except InputError as problem:
        links.left_out(problem)
    yield from links.found


def _first_person(document: RawDocument, vrm: Json) -> Iterator[Problem]:
    """Annotations name nodes with meshes."""
    if "firstPerson" in vrm:
        own = {"specVersion": VERSION, "firstPerson": vrm["firstPerson"]}
        yield from _read(document, EXTENSION, own, f"/extensions/{EXTENSION}")


def _springs(document: RawDocument, vrm: Json) -> Iterator[Problem]:
    """Springs, colliders and their groups name nodes and each other."""
    extensions = as_object(document.json.get("extensions"))
    if SPRINGS in extensions:
        yield from _read(document, SPRINGS, extensions[SPRINGS], f"/extensions/{SPRINGS}")


def _constraints(document: RawDocument, vrm: Json) -> Iterator[Problem]:
    """Constraints name nodes as their sources."""
    for number, node in enumerate(document.items("nodes")):
        extensions = as_object(node.get("extensions"))
        if CONSTRAINT in extensions:
            yield from _read(document, CONSTRAINT, extensions[CONSTRAINT], f"/nodes/{number}/extensions/{CONSTRAINT}")


def _human_bones(vrm: Json) -> dict[str, Any]:
    """Bone -> its node in the file, unchecked."""
    bones = as_object(as_object(vrm.get("humanoid")).get("humanBones"))
    return {bone: as_object(entry).get("node") for bone, entry in bones.items()}


_CHECKS: tuple[tuple[str, Callable[..., Iterator[Problem]], Literal["error", "warning"]], ...] = (
    ("VrmVersion", _version, "error"),
    ("VrmMeta", _meta, "error"),
    ("VrmHumanBones", _bones, "error"),
    ("VrmScales", _scales, "warning"),
    ("VrmPose", _pose, "warning"),
    ("VrmExpressions", _expressions, "error"),
    ("VrmLookAt", _look_at, "error"),
    ("VrmFirstPerson", _first_person, "error"),
    ("VrmSpringBones", _springs, "error"),
    ("VrmConstraints", _constraints, "error"),
)
