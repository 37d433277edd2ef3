"""Show what a face holds: meshes, joints, shapes, regions, landmarks, animations, materials, sliders, neural rig.

example: facepipe inspect head.usdc
example: facepipe inspect head.glb
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.reports import Report, Watch, table
from facepipe.declare import source
from facepipe.kinds import Inspector, action

if TYPE_CHECKING:
    from facepipe.stage import Face


@dataclass(frozen=True, kw_only=True)
class InspectReport(Report):
    """Counts and names of everything on a face."""

    face: str
    meters_per_unit: float
    up_axis: str
    head_height_mm: float
    meshes: tuple[Mapping[str, Any], ...]  # name, points, faces, shapes, influences, uv_sets, regions (counts)
    joints: tuple[str, ...]  # paths
    joint_names: tuple[str, ...]  # the source's
    shapes: tuple[str, ...]
    shape_names: Mapping[str, Any] | None  # of which convention they are
    inbetweens: int
    regions: tuple[str, ...]
    landmarks: Mapping[str, int]  # scheme -> how many
    animations: tuple[str, ...]
    sliders: tuple[str, ...]
    materials: tuple[str, ...]
    variants: tuple[str, ...]  # of the materials
    photos: tuple[str, ...]
    levels: Mapping[str, int]  # of detail -> faces
    person: str
    attach_joint: str | None
    attribution: str
    recipe: str | None  # its verb
    neural_rig: Mapping[str, str] | None  # file, state
    file: Mapping[str, Any] | None = None  # what a file that is no stage is made of: counts and bytes

    def as_text(self, out: Path) -> str:
        """The report as tables for people."""
        from facepipe.rig.conventions import convention_text

        meshes = self.meshes
        columns = ("name", "points", "faces", "shapes", "influences", "uv_sets", "regions")
        total = ["in all", *(sum(mesh[column] for mesh in meshes) for column in ("points", "faces"))]
        rows: list[Any] = [["mesh", *columns[1:]], *[[mesh[column] for column in columns] for mesh in meshes], total]
        facts = [
            ("units", f"{self.meters_per_unit:g} m, {self.up_axis} up"),
            ("head height", f"{self.head_height_mm:.1f} mm"),
            *[
                (key, _listing(getattr(self, "joint_names" if key == "joints" else key)))
                for key in ("joints", "shapes", "regions", "animations", "sliders", "materials")
            ],
            *[("variants", _listing(self.variants)) for _ in self.variants[:1]],
            *[("photos", _listing(self.photos)) for _ in self.photos[:1]],
            *[
                ("levels", ", ".join(f"{name} ({count:,} faces)" for name, count in levels.items()))
                for levels in [self.levels]
                if levels
            ],
            *[("shapes' names", convention_text(self.shape_names)) for _ in self.shapes[:1]],
            ("person", self.person),
            ("inbetweens", self.inbetweens or "none"),
            ("landmarks", ", ".join(f"{scheme} ({n})" for scheme, n in self.landmarks.items()) or "none"),
            ("attach joint", self.attach_joint or "none"),
            ("made by", self.recipe or "unknown"),
            *[("neural rig", f"{link['file']}, {link['state']}") for link in [self.neural_rig] if link],
            ("attribution", self.attribution or "none"),
        ]
        width = max(len(name) for name, _ in facts)
        lines = [f"{name:{width}}  {text}" for name, text in facts]
        return "\n".join([self.face, "", table(rows), "", *lines, *(_file_lines(self.file) if self.file else ())])


@action("inspect", "show what a face holds")
@dataclass(frozen=True, kw_only=True)
class Inspect(Inspector[InspectReport]):
    """The action."""

    face: Path = source("face stage")

    def look(self, watch: Watch) -> InspectReport:
        from facepipe.core.errors import InputError
        from facepipe.importers import contents_of, read_face

        report = report_of(read_face(self.face))
        try:
            return replace(report, file=contents_of(self.face))
        except InputError as error:  # of a part that a face is read without
            return replace(report, warnings=(*report.warnings, f"bytes are not counted: {error}"))


def report_of(face: Face) -> InspectReport:
    """What a face holds, with what is implausible about it as warnings."""
    from facepipe.core.reading import digest
    from facepipe.rig import implausible
    from facepipe.rig.conventions import convention_of, shapes_of
    from facepipe.stage.recipes import read_neural_rig_link

    parts, link = face.parts(), read_neural_rig_link(face.prim)
    neural_rig: dict[str, str] | None = None
    if link is not None and link.path is None:
        neural_rig = {"file": link.file, "state": link.refusal or "lost"}
    elif link is not None and link.path is not None:
        same = digest([link.path]) == link.digest
        neural_rig = {"file": link.file, "state": "as applied" if same else "changed since"}
    return InspectReport(
        face=face.where,
        meters_per_unit=face.meters_per_unit,
        up_axis=face.up_axis,
        head_height_mm=round(face.head_height * face.mm_per_unit, 3),
        meshes=tuple(
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
        ),
        joints=tuple(parts.skeleton.joints),
        joint_names=tuple(parts.skeleton.names),
        shapes=tuple(face.shapes),
        shape_names=convention_of(face.shapes, shapes_of(parts.meshes)),
        inbetweens=sum(len(shape.inbetweens) for mesh in parts.meshes for shape in mesh.blendshapes),
        regions=tuple(sorted({name for mesh in parts.meshes for name in mesh.regions})),
        landmarks={
            scheme: len(landmarks.indices) for mesh in parts.meshes for scheme, landmarks in mesh.landmarks.items()
        },
        animations=tuple(animation.name for animation in parts.animations),
        sliders=tuple(slider.name for slider in parts.sliders),
        materials=tuple(material.name for material in parts.materials),
        variants=parts.variants,
        photos=tuple(photo.name for photo in parts.photos),
        levels={
            name: sum(len(mesh.face_vertex_counts) for mesh in face.at_level(number).meshes)
            for number, name in enumerate(face.levels)
        },
        person=_person(face),
        attach_joint=parts.attach_joint,
        attribution=parts.attribution,
        recipe=parts.recipe.verb if parts.recipe else None,
        neural_rig=neural_rig,
        warnings=tuple(implausible(parts)),
    )


def _person(face: Face) -> str:
    """Who the face is, and the section that its neutral is of."""
    basis, who = face.person_basis, face.person().description
    return who if basis is None or not basis.section else f"{who}, on a section of {len(basis.section):,} bytes"


def _file_lines(file: Mapping[str, Any]) -> list[str]:
    """What a file is made of, as a table of its parts and a line on the rest."""
    counts, parts = ("vertices", "triangles", "primitives", "targets"), file["parts"]
    rows: list[Any] = [["part", *counts, "kB", "kB of targets"]]
    for name, part in parts.items():
        sizes = [_kilobytes(part[key]) for key in ("geometry", "target_bytes")]
        rows.append([name, *(part[key] for key in counts), *sizes])
    sizes = [_kilobytes(sum(part[key] for part in parts.values())) for key in ("geometry", "target_bytes")]
    rows.append(["in all", *(file[key] for key in counts), *sizes])
    rest = [f"{name} {_kilobytes(file[name])}" for name in ("textures", "animations", "skins", "json", "other")]
    held = f"{file['materials']} materials, {file['images']} images"
    return ["", table(rows), "", f"file: {_kilobytes(file['bytes'])} kB, {held}; kB of {', '.join(rest)}"]


def _kilobytes(size: int) -> str:
    return f"{size / 1000:,.0f}"


def _listing(names: tuple[str, ...]) -> str:
    shown = ", ".join(names[:8])
    return f"{len(names)}: {shown}{', ...' if len(names) > 8 else ''}" if names else "none"
