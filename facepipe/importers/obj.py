"""A folder of OBJ files on one topology: a neutral, one file a shape, and landmarks from a JSON file beside.

Points keep their order, faces their corners; UVs, material groups with their .mtl, and vertex colours (sRGB in files)
come along. Of other groups (`g`) that part a mesh a warning gives the names.
Normals are left out: they'd belong to the neutral alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import first_names, handles
from facepipe.core.reading import file_beside, files_in, read_json
from facepipe.declare import check_ranges
from facepipe.importers.options import ObjOptions
from facepipe.importers.wavefront import (
    Obj,
    compact_uvs,
    face_corners,
    read_materials,
    read_obj,
    read_offsets,
    sparse_shapes,
)
from facepipe.parts import FaceParts, Landmarks, Material, Mesh, material_faces
from facepipe.stage.recipes import Imported, import_recipe

_DEFAULT = "multipie68"
_MOST_BYTES = 1 << 24
Options = ObjOptions


def read_landmarks(path: Path, point_count: int) -> dict[str, Landmarks]:
    """Scheme -> landmarks.

    :raises InputError: not such JSON, or a point out of range
    """
    content = read_json(path, _MOST_BYTES)
    if isinstance(content, Mapping) and "indices" in content:
        names, points = content.get("names"), content["indices"]
        if names:
            texts = isinstance(names, list) and all(isinstance(name, str) for name in names)
            paired = dict(zip(names, points, strict=False)) if texts and isinstance(points, list) else {}
            if not (paired and len(paired) == len(names) == len(points)):
                raise InputError(path, "expected as many different names as indices")
            points = paired
        content = {str(content.get("scheme", _DEFAULT)): points}
    elif not isinstance(content, Mapping) or not any(isinstance(value, list | Mapping) for value in content.values()):
        content = {_DEFAULT: content}
    schemes = {}
    for scheme, value in content.items():
        where = f"{path} -> {ascii(scheme)[:40]}"
        if not (scheme.isascii() and scheme.isidentifier()):
            raise InputError(where, "expected a scheme name of letters, digits and underscores")
        points = list(value.values()) if isinstance(value, Mapping) else value
        if not isinstance(points, list) or not points:
            raise InputError(where, "expected a list of points, or an object of name and point")
        for point in points:
            if isinstance(point, bool) or not isinstance(point, int) or not 0 <= point < point_count:
                raise InputError(where, f"point {str(point)[:40]}, expected a whole number from 0 to {point_count - 1}")
        names = tuple(value) if isinstance(value, Mapping) else ()
        schemes[scheme] = Landmarks(indices=np.array(points, dtype=np.int32), names=names)
    return schemes


def read(source: Path, options: Options) -> Imported:
    """Read a folder with a neutral and shapes, or a single OBJ file as a face without shapes.

    The neutral's `o` objects become meshes where no two share a point, otherwise there is one mesh ``Head``.
    ``landmarks.json`` in the folder (forms: `landmark_file`) gives landmarks by 0-based points of the neutral.

    :raises InputError: no neutral, or a file that can't be used
    :raises TopologyError: a shape whose points or faces are not the neutral's
    """
    check_ranges(options)
    neutral_file, shape_files = _files(source, options.neutral)
    neutral = read_obj(neutral_file)
    if len(neutral.face_vertex_counts) == 0:
        raise InputError(neutral_file, "no faces (f lines), expected a mesh")
    shapes = {name: read_offsets(path, neutral) for name, path in shape_files.items()}
    library = read_materials(neutral_file, neutral.libraries)
    warnings = library.warnings
    landmark_file = file_beside(source, "landmarks.json") if source.is_dir() else None
    landmarks = read_landmarks(landmark_file, len(neutral.points)) if landmark_file else {}
    if neutral.uv_indices is None and len(neutral.uvs):
        warnings.append(f"{neutral_file.name}: some face corners have no UV, the UVs are left out")
    # one per `usemtl` name, in their order, under their own names
    missing = [ascii(name) for name in neutral.materials if name not in library.materials]
    if missing and neutral.libraries:
        warnings.append(f"materials not in a library, grey: {', '.join(missing)}")
    names = handles(neutral.materials, "Material")
    materials = tuple(
        replace(library.materials.get(original, Material(name=name)), name=name)
        for name, original in zip(names, neutral.materials, strict=True)
    )
    files = [neutral_file, *shape_files.values(), *library.files, *([landmark_file] if landmark_file else [])]
    parts = FaceParts(
        meters_per_unit=options.meters_per_unit,
        up_axis=options.up_axis,
        meshes=_meshes(neutral, shapes, [material.name for material in materials], landmarks, options, warnings),
        materials=materials,
        recipe=import_recipe("obj", {source: files}, options),
    )
    return Imported(parts=parts, warnings=tuple(warnings))


def _files(source: Path, neutral: str) -> tuple[Path, dict[str, Path]]:
    """The neutral and the shapes by name, in the order of names."""
    if source.is_file():
        return source, {}
    objs = files_in(source, (".obj",))
    wanted = neutral.lower().removesuffix(".obj")
    neutrals = [path for path in objs if path.stem.lower() == wanted]
    if len(neutrals) != 1:
        what = f"{len(neutrals)} files named {wanted}.obj in any case" if neutrals else f"no {neutral}.obj there"
        raise InputError(source, f"{what}, expected one neutral beside the shapes")
    shapes: dict[str, Path] = {}
    for path in objs:
        name = path.stem
        if path != neutrals[0] and shapes.setdefault(name, path) != path:
            raise InputError(path, f"its shape would be named {name} like {shapes[name].name}'s")
    return neutrals[0], shapes


def _meshes(
    neutral: Obj,
    shapes: Mapping[str, FloatArray],
    materials: list[str],
    landmarks: Mapping[str, Landmarks],
    options: Options,
    warnings: list[str],
) -> tuple[Mesh, ...]:
    pieces = [("Head", np.arange(len(neutral.points)), np.arange(len(neutral.face_vertex_counts)))]
    objects, of_corner = np.unique(neutral.face_object), np.repeat(neutral.face_object, neutral.face_vertex_counts)
    points = [np.unique(neutral.face_vertex_indices[of_corner == number]) for number in objects]
    # objects that share points stay one mesh: their border would open as either moves
    if len(objects) > 1 and sum(map(len, points)) == len(np.unique(neutral.face_vertex_indices)):
        pieces = [
            (neutral.objects[number] if number >= 0 else "Head", own, np.flatnonzero(neutral.face_object == number))
            for number, own in zip(objects, points, strict=True)
        ]
    names = handles([name for name, _, _ in pieces], "Mesh")
    used = sum(len(own) for _, own, _ in pieces)
    if used < len(neutral.points):
        warnings.append(f"{len(neutral.points) - used} points belong to no face of an object, left out")
    groups = [np.unique(neutral.face_group[faces]) for _, _, faces in pieces]
    parted = np.unique(np.concatenate([one[one >= 0] for one in groups if len(one) > 1] or [np.zeros(0, np.int32)]))
    if len(parted):
        named = first_names([neutral.groups[number] for number in parted], 6)
        warnings.append(f"groups (g lines) of faces of one mesh, left out: {named}")
    meshes = []
    for name, (_, own, faces) in zip(names, pieces, strict=True):
        corners = face_corners(neutral.face_vertex_counts, faces)
        uv_sets = (compact_uvs(neutral.uvs, neutral.uv_indices[corners]),) if neutral.uv_indices is not None else ()
        meshes.append(
            Mesh(
                name=name,
                points=neutral.points[own],
                face_vertex_counts=neutral.face_vertex_counts[faces],
                face_vertex_indices=np.searchsorted(own, neutral.face_vertex_indices[corners]).astype(np.int32),
                uv_sets=uv_sets,
                colors=None if neutral.colors is None else neutral.colors[own],
                blendshapes=sparse_shapes(shapes, own, options.threshold),
                landmarks={
                    scheme: replace(marks, indices=np.searchsorted(own, marks.indices).astype(np.int32))
                    for scheme, marks in landmarks.items()
                    if np.isin(marks.indices, own).all()
                },
                material_faces=material_faces(materials, neutral.face_material[faces]),
            )
        )
    moved = {shape.name for mesh in meshes for shape in mesh.blendshapes}
    still = [name for name in shapes if name not in moved]
    if still:
        warnings.append(f"shapes that move no point, left out: {', '.join(still)}")
    lost = [scheme for scheme in landmarks if not any(scheme in mesh.landmarks for mesh in meshes)]
    if lost:
        warnings.append(f"landmarks that lie on several meshes, left out: {', '.join(lost)}")
    return tuple(meshes)
