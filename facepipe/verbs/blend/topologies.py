"""Sources of other topologies and of other programs: what the first one lacks is made, the others take its mesh.

Actions of another wing do both, found by their verbs: `facepipe transfer` brings landmarks, regions and shapes to the
first source, `facepipe conform` gives its mesh the shape of another head.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from facepipe.core.errors import FacepipeError, SchemaError, TopologyError
from facepipe.importers import read_face
from facepipe.kinds import Job
from facepipe.parts import FaceParts, Mesh, all_regions
from facepipe.registry import own_action
from facepipe.scans import LANDMARK_SCHEME
from facepipe.stage import Face
from facepipe.stage.files import SUFFIXES
from facepipe.verbs.blend.sources import difference
from facepipe.verbs.whole_faces import check_same_faces


@dataclass(frozen=True, kw_only=True)
class Conformed:
    """How near the first source's mesh came to a source of another topology."""

    differs: str  # the first difference of the two
    mean_mm: float  # distance of the fitted mesh from the source
    p95_mm: float  # that 95 % of its points are below
    shapes: tuple[str, ...]  # that are the source's own; the others are those of the first, carried


@dataclass(frozen=True, kw_only=True)
class Gathered:
    """Faces of one topology; the first is the layer that was given, with what was authored there."""

    faces: tuple[Face, ...]
    conformed: dict[str, Conformed]  # file of a source -> how it was fitted
    warnings: tuple[str, ...]


def read_source(path: Path) -> Face:
    """The face in a file, or the head of another program.

    :raises FacepipeError: a file that can't be used
    """
    if path.suffix.lower() in SUFFIXES:
        try:
            return read_face(path)
        except SchemaError:
            made = own_action("transfer")(head=path).made_base()
            if made is None:  # a face, but a damaged one
                raise
    else:
        made = own_action("transfer")(head=path).made_base()
    if made is None:
        return read_face(path)
    face = Face.from_parts(made[0])
    face.file, face.warnings = path, made[1]
    return face


def gathered(face: Face, paths: Sequence[Path], job: Job) -> Gathered:
    """The faces of files, all of the topology of the first.

    :param face: a layer over the first; what that lacks and others need is authored there
    :raises FacepipeError: a file that can't be used, or a head that no face is found on
    """
    first, name = face, Path(paths[0]).name
    first.file = Path(paths[0])
    parts, warnings, conformed = first.parts(), list[str](), dict[str, Conformed]()
    others = [_named_as(parts, read_source(Path(path))) for path in paths[1:]]
    unlike = [
        difference(parts, name, other.parts(), Path(path).name) for path, other in zip(paths[1:], others, strict=True)
    ]
    lacking = _lacking(parts) if any(unlike) else ()
    if lacking:
        with _conforming(next(filter(None, unlike))):
            report = own_action("transfer")(head=paths[0], only=lacking).author(first, job)
        first = Face(face.stage, face.prim)
        first.file = face.file
        warnings.append(f"{name}: has no {', no '.join(lacking)}: made, as `facepipe transfer` does")
        warnings += _lines(name, report.warnings)
    faces = [first]
    for path, other, differs in zip(paths[1:], others, unlike, strict=True):
        if not differs:
            faces.append(other)
            continue
        copy, conformed[str(path)], lines = _conformed(first, Path(path), differs, job)
        faces.append(copy)
        warnings += lines
    return Gathered(faces=tuple(faces), conformed=conformed, warnings=tuple(warnings))


def _conformed(first: Face, path: Path, differs: str, job: Job) -> tuple[Face, Conformed, list[str]]:
    """The first face in the shape of a head, how near it came, and what is to be said of it."""
    copy = Face.from_parts(_bare(first.parts()))
    with _conforming(differs):
        report = own_action("conform")(head=path, colors=False, relief=False, own_shapes=True).author(copy, job)
    mean, p95, own = report.quality.surface_mean_mm, report.quality.surface_p95_mm, report.own_shapes
    off = f"{mean:.2f} mm off (mean), 95 % below {p95:.2f} mm"
    shapes = f"{len(own)} shapes are its own" if own else "it has no shapes of these names"
    lines = [f"{differs}: that mesh takes its shape, {off}; {shapes}", *_lines(path.name, report.warnings)]
    copy = Face(copy.stage, copy.prim)
    copy.file = path
    return copy, Conformed(differs=differs, mean_mm=mean, p95_mm=p95, shapes=own), lines


def _bare(parts: FaceParts) -> FaceParts:
    """The face without what a blend takes of its first source alone."""
    meshes = tuple(replace(mesh, material=None, material_faces=()) for mesh in parts.meshes)
    return replace(parts, meshes=meshes, materials=(), animations=(), photos=(), recipe=None)


@contextmanager
def _conforming(differs: str) -> Iterator[None]:
    """:raises TopologyError: of what differs, and why nothing was to be done about it"""
    try:
        yield
    except FacepipeError as error:
        where, _, what = differs.partition(": ")
        raise TopologyError(where, f"{what}; can't be conformed: {error}") from None


def _lines(name: str, warnings: Sequence[str]) -> list[str]:
    """Warnings of an action, of the file that it was about; a blend finds sizes by itself."""
    lines = [line for line in warnings if "--unit" not in line and "no usual unit" not in line]
    return [line if name in line else f"{name}: {line}" for line in lines]


def _lacking(parts: FaceParts) -> tuple[str, ...]:
    """What a face needs so that others come on its mesh, as the action calls it."""
    there = {
        "shapes": parts.shapes,
        "regions": all_regions(parts.meshes),
        "landmarks": [mesh for mesh in parts.meshes if LANDMARK_SCHEME in mesh.landmarks],
    }
    return tuple(what for what, found in there.items() if not found)


def _named_as(base: FaceParts, other: Face) -> Face:
    """The face with meshes called as those of the base with the same faces, where it has others of no such name."""
    parts = other.parts()
    names, taken = [mesh.name for mesh in base.meshes], {mesh.name for mesh in parts.meshes}
    called: dict[str, str] = {}
    for mesh in base.meshes:
        if mesh.name not in taken:
            twins = [one.name for one in parts.meshes if one.name not in names and _alike(one, mesh)]
            # of two eyeballs of the same faces, none is the left one by that
            if len(twins) == 1 and sum(_alike(one, mesh) for one in base.meshes) == 1:
                called[twins[0]] = mesh.name
    if not called:
        return other
    meshes = tuple(replace(mesh, name=called.get(mesh.name, mesh.name)) for mesh in parts.meshes)
    face = Face.from_parts(replace(parts, meshes=meshes))
    face.file, face.warnings = other.file, other.warnings
    return face


def _alike(mesh: Mesh, base: Mesh) -> bool:
    try:
        check_same_faces(mesh.name, mesh, base, base.name)
    except TopologyError:
        return False
    return True
