"""Show what a face holds: meshes, joints, shapes, regions, landmarks, animations, materials, sliders, neural rig.

example: facepipe inspect head.usda
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.cli.rename import convention_of, convention_text
from facepipe.cli.show import emit, warn
from facepipe.core.texts import table

if TYPE_CHECKING:
    from facepipe.stage import Face


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    parser.add_argument("face", type=Path, metavar="FACE", help="face stage")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Open and print."""
    import facepipe
    from facepipe.rig import implausible

    face = facepipe.read(arguments.face)
    summary = summarise(face)
    warnings = implausible(face.parts())
    warn(warnings)
    emit({**summary, "warnings": list(warnings)}, as_text(summary), as_json=arguments.json)
    return 0


def summarise(face: Face) -> dict[str, Any]:
    """Counts and names of everything on the face, as JSON values."""
    parts = face.parts()
    return {
        "face": face.where,
        "meters_per_unit": face.meters_per_unit,
        "up_axis": face.up_axis,
        "head_height_mm": round(face.head_height * face.mm_per_unit, 3),
        "meshes": [
            {
                "name": mesh.name,
                "points": len(mesh.points),
                "faces": len(mesh.face_vertex_counts),
                "shapes": len(mesh.blendshapes),
                "influences": mesh.skin.joint_indices.shape[1] if mesh.skin else 0,
                "uv_sets": len(mesh.uv_sets),
                "regions": len(mesh.regions),
            }
            for mesh in parts.meshes
        ],
        "joints": list(parts.skeleton.joints),
        "joint_names": list(parts.skeleton.names),
        "shapes": list(face.shapes),
        "shape_names": convention_of(face.shapes),
        "inbetweens": sum(len(shape.inbetweens) for mesh in parts.meshes for shape in mesh.blendshapes),
        "regions": sorted({name for mesh in parts.meshes for name in mesh.regions}),
        "landmarks": {
            scheme: len(landmarks.indices) for mesh in parts.meshes for scheme, landmarks in mesh.landmarks.items()
        },
        "animations": [animation.name for animation in parts.animations],
        "sliders": [slider.name for slider in parts.sliders],
        "materials": [material.name for material in parts.materials],
        "photos": [photo.name for photo in parts.photos],
        "person": face.person().description,
        "attach_joint": parts.attach_joint,
        "attribution": parts.attribution,
        "recipe": parts.recipe.verb if parts.recipe else None,
        "neural_rig": _neural_rig(face),
    }


def _neural_rig(face: Face) -> dict[str, str] | None:
    """The file that a face links, and whether it is still what was applied."""
    from facepipe.core.digests import digest
    from facepipe.stage.neural_rig_link import read_neural_rig_link

    link = read_neural_rig_link(face.prim)
    if link is None:
        return None
    state = "lost" if link.path is None else "as applied" if digest([link.path]) == link.digest else "changed since"
    return {"file": link.file, "state": state}


def as_text(summary: dict[str, Any]) -> str:
    """The summary as tables for people."""
    meshes = summary["meshes"]
    columns = ("name", "points", "faces", "shapes", "influences", "uv_sets", "regions")
    total = ["in all", *(sum(mesh[column] for mesh in meshes) for column in ("points", "faces"))]
    rows: list[Any] = [["mesh", *columns[1:]], *[[mesh[column] for column in columns] for mesh in meshes], total]
    facts = [
        ("units", f"{summary['meters_per_unit']:g} m, {summary['up_axis']} up"),
        ("head height", f"{summary['head_height_mm']:.1f} mm"),
        *[
            (key, _listing(summary["joint_names" if key == "joints" else key]))
            for key in ("joints", "shapes", "regions", "animations", "sliders", "materials")
        ],
        *[("photos", _listing(summary["photos"])) for _ in summary["photos"][:1]],
        *[("shapes' names", convention_text(summary["shape_names"])) for _ in summary["shapes"][:1]],
        ("person", summary["person"]),
        ("inbetweens", summary["inbetweens"] or "none"),
        ("landmarks", ", ".join(f"{scheme} ({n})" for scheme, n in summary["landmarks"].items()) or "none"),
        ("attach joint", summary["attach_joint"] or "none"),
        ("made by", summary["recipe"] or "unknown"),
        *[("neural rig", f"{link['file']}, {link['state']}") for link in [summary["neural_rig"]] if link],
        ("attribution", summary["attribution"] or "none"),
    ]
    width = max(len(name) for name, _ in facts)
    lines = [f"{name:{width}}  {text}" for name, text in facts]
    return "\n".join([summary["face"], "", table(rows), "", *lines])


def _listing(names: list[str]) -> str:
    shown = ", ".join(names[:8])
    return f"{len(names)}: {shown}{', ...' if len(names) > 8 else ''}" if names else "none"
