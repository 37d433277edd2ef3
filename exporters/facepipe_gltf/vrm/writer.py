"""Writes a face as an avatar's head, one .vrm file: the glTF of a standing person, and VRM's extension of it."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import ExportError, InputError
from facepipe.core.names import first_names
from facepipe.core.reports import ExportReport
from facepipe.parts import FaceParts, HasParts
from facepipe.records import Json
from facepipe.rig import set_face
from facepipe_gltf.document import Document, write
from facepipe_gltf.placement import numbers
from facepipe_gltf.vrm.body import Figure, add_body, figure_of, missing_bones, moved, standing_place, turned_to_front
from facepipe_gltf.vrm.bones import Humanoid, humanoid_of, misplaced
from facepipe_gltf.vrm.expressions import Expressions, expressions_of, table, with_slider_shapes
from facepipe_gltf.vrm.meta import EXTENSION, meta_of
from facepipe_gltf.vrm.nodes import NodeTree
from facepipe_gltf.vrm.options import Options
from facepipe_gltf.writer import embedded, report_of, write_glb

_UNIFORM = 1e-4
_RANGE_FIELDS = {
    "rangeMapHorizontalInner": "inner",
    "rangeMapHorizontalOuter": "outer",
    "rangeMapVerticalDown": "down",
    "rangeMapVerticalUp": "up",
}


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
    meta = meta_of(options, name, parts.attribution)
    humanoid = humanoid_of(parts, options.bones)
    missing = missing_bones([*humanoid.bones])
    if missing and not options.stub_body:
        what = f"no joints for {len(missing)} of the 15 human bones that VRM requires: {', '.join(missing)}"
        raise InputError(parts.name, f"{what}; expected joints of known names, or option stub_body, which adds them")
    shaped, slider_shapes = with_slider_shapes(parts)
    placed, figure, added = _standing(shaped, humanoid, bool(missing))
    # without tangents, which readers compute: a VRM holds what every runtime reads
    document = write(replace(placed, animations=()), options.gltf, tangents=False)
    tree = NodeTree(document.json)
    bones = _human_nodes(parts, document, tree, humanoid, figure, added)
    expressions = expressions_of(tree.nodes, document.json.get("meshes", []))
    extension: Json = {
        "specVersion": "1.0",
        "meta": meta,
        "humanoid": {"humanBones": {bone: {"node": node} for bone, node in bones.items()}},
        "expressions": expressions.json,
        "firstPerson": _first_person(tree),
    }
    lost = [*document.dropped, *expressions.lost]
    if parts.animations:
        lost.append(f"{len(parts.animations)} animations (VRM files have none)")
    if figure.eyes is None:
        lost.append("lookAt (no eye joints, no landmarks multipie68, no shapes eyeBlink)")
    else:
        gaze = _gaze(placed, humanoid, expressions)
        extension["lookAt"] = _look_at(tree, bones, figure.eyes, gaze or "expression")
        if gaze is None:
            lost.append("the gaze (neither eye joints with skin weights nor the shapes eyeLook turn the eyes)")
    document.json.setdefault("extensions", {})[EXTENSION] = extension
    document.json["extensionsUsed"] = sorted([*document.json.get("extensionsUsed", []), EXTENSION])
    counts = {"human bones": len(bones), "expressions": sum(map(len, expressions.json.values()))}
    warnings = (*document.warnings, *humanoid.unfit, *_scale_warnings(tree))
    finished = replace(document, counts=document.counts | counts, warnings=warnings, dropped=tuple(lost))
    return finished, (*added, *slider_shapes)


def _human_nodes(
    parts: FaceParts, document: Document, tree: NodeTree, humanoid: Humanoid, figure: Figure, added: list[str]
) -> dict[str, int]:
    """Human bone -> node, with those added that are missing; meshes without a skin hang on the head."""
    skins = document.json.get("skins", [])
    bones = {bone: skins[0]["joints"][joint] for bone, joint in humanoid.bones.items()}
    missing = missing_bones([*bones])
    if missing:
        add_body(tree, bones, figure, [root for root in tree.roots if "mesh" not in tree.nodes[root]])
        added.append(f"human bones that move no point: {', '.join(missing)}")
        _check(parts, bones, tree)
    loose = [node for node in tree.roots if "mesh" in tree.nodes[node] and "skin" not in tree.nodes[node]]
    for node in loose:
        tree.hang_mesh(node, bones["head"])
    if loose and skins:
        added.append(f"{', '.join(tree.nodes[node]['name'] for node in loose)} below the head: no joint moved them")
    return bones


def _standing(parts: FaceParts, humanoid: Humanoid, stub: bool) -> tuple[FaceParts, Figure, list[str]]:
    """The face, turned to look along +Z and, above an added body, at a person's height; what was changed."""
    changes = []
    placed, degrees = turned_to_front(parts, figure_of(parts, humanoid.bones))
    if degrees:
        changes.append(f"a turn by {degrees} degrees about the up axis: VRM's models look along +Z")
    figure = figure_of(placed, humanoid.bones)
    if stub and not {"leftFoot", "rightFoot"} & {*humanoid.bones}:
        matrix = np.eye(4)
        matrix[:3, 3] = standing_place(figure, humanoid.bones.get("hips"))
        placed = moved(placed, matrix)
        figure = figure_of(placed, humanoid.bones)
        changes.append(
            f"{1000 * matrix[1, 3]:.0f} mm of height: feet stand at 0, the top of the head at {figure.high[1]:.2f} m"
        )
    return placed, figure, changes


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


def _first_person(tree: NodeTree) -> Json:
    shown = [i for i, node in enumerate(tree.nodes) if "mesh" in node]
    return {"meshAnnotations": [{"node": node, "type": "auto"} for node in shown]}


def _scale_warnings(tree: NodeTree) -> list[str]:
    """A line on nodes whose scale is not one positive number, which VRM requires (tpose.md)."""
    scaled = [(node["name"], node["scale"]) for node in tree.nodes if "scale" in node]
    odd = [name for name, (x, y, z) in scaled if min(x, y, z) <= 0 or max(x, y, z) > min(x, y, z) * (1 + _UNIFORM)]
    some = first_names(odd, 3)
    return [f"{some}: scaled unevenly or mirrored; VRM's runtimes may not keep that"] if odd else []


def _check(parts: FaceParts, bones: dict[str, int], tree: NodeTree) -> None:
    """:raises ExportError: the face's bones leave no place for the added ones"""
    wrong = misplaced(bones, tree.path)
    if wrong is not None:
        name = tree.nodes[bones[wrong.bone]]["name"]
        what = f"is the {wrong.bone} below the {wrong.found}, expected it below the {wrong.expected}"
        raise ExportError(
            f"{parts.name} -> {name}", f"{what}: the joints between are missing (option bones names them)"
        )


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
