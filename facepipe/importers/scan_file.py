"""Scans from files: PLY, OBJ, STL, OFF, glTF, VRM, FBX and USD, meshes or point clouds.

Coordinates, and so the unit, are those of the file, in its world space. Points at one place are one point, so that
seams of texture coordinates don't tear the surface. Skins, shapes and animations of a file are left out, but for what
they say of where the face is.
"""

from __future__ import annotations

import io
import logging
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.images import open_image, pixels
from facepipe.core.reading import read_bytes
from facepipe.geometry.colors import from_srgb
from facepipe.geometry.polygons import merge_points, point_triangles, triangulate
from facepipe.geometry.vectors import transformed
from facepipe.importers import kind_of, load
from facepipe.importers.scan_ply import read_ply
from facepipe.importers.wavefront import MAX_BYTES, read_materials, read_obj, read_text
from facepipe.parts import Material, Mesh, TextureInput, UvSet, material_faces
from facepipe.scans import Scan, ScanHints, ScanPicture, ScanTexture

USD = (".usda", ".usdc", ".usd", ".usdz")
_NOWHERE = logging.NullHandler()
_HEADER, _TRIANGLE = 84, 50  # bytes of a binary STL
_NEXT_SOLID = re.compile(rb"endsolid[^\n]*\n\s*solid[^\n]*", re.IGNORECASE)
_OFF = re.compile(r"(?:ST)?C?N?OFF\s+([0-9]{1,10})\s+([0-9]{1,10})(?:\s+[0-9]{1,10})?\s*")
LARGEST = 1e15  # of a coordinate: its cube stays finite in float64, and so do volumes
_PLAIN = 1e-3  # colours that differ less are a material, no picture of a face


def read_stl(path: Path) -> Scan:
    """The triangles of an STL file, text or binary, three points each.

    :raises InputError: neither, cut short, without triangles, NaN or infinity
    """
    data = read_bytes(path, MAX_BYTES)
    count = int.from_bytes(data[_HEADER - 4 : _HEADER], "little")
    if len(data) != _HEADER + _TRIANGLE * count:
        if b"\0" in data or data.lstrip()[:5].lower() != b"solid":
            what = f"{len(data)} bytes, expected {_HEADER + _TRIANGLE * count} for the {count} triangles of its header"
            raise InputError(path, f"no STL, or cut short: {what}")
        count = data.lower().count(b"endfacet")
        data = _NEXT_SOLID.sub(b"", data)  # many solids take trimesh the square of their number
    return _read(path, data, "stl", count)


def read_off(path: Path) -> Scan:
    """The triangles and quads of an OFF file, points in its order; colours and normals are left out.

    :raises InputError: no text of that format, cut short, faces of other sizes or without points, NaN or infinity
    """
    rows = [row for line in read_text(path).split("\n") if (row := line.partition("#")[0].strip())]
    start = 1 if _OFF.fullmatch(rows[0] if rows else "") else 2  # the counts may have a row of their own
    header = _OFF.fullmatch(" ".join(rows[:start]))
    if header is None:
        raise InputError(path, "no OFF header, expected 'OFF' and the numbers of points and faces")
    points, faces = int(header[1]), int(header[2])
    if len(rows) - start < points + faces:
        raise InputError(path, f"cut short: {len(rows) - start} rows of {points} points and {faces} faces")
    corners = [row.split(None, 1)[0] for row in rows[start + points : start + points + faces]]
    other = next((number for number, one in enumerate(corners) if one not in ("3", "4")), None)
    if other is not None:
        raise InputError(f"{path} -> face {other}", f"{corners[other][:40]!r} corners, expected 3 or 4")
    triangles = corners.count("3") + 2 * corners.count("4")
    return _read(path, "\n".join(rows).encode(), "off", triangles)


def _read(path: Path, data: bytes, kind: str, triangles: int) -> Scan:
    """What trimesh makes of the bytes.

    :raises InputError: it can't read them, or finds another number of triangles, or numbers that are not finite
    """
    import trimesh

    if not triangles:
        raise InputError(path, "no triangles, expected a surface")
    logging.getLogger("trimesh").addHandler(_NOWHERE)  # else Python prints its notes where nobody has set up logging
    try:
        with warnings.catch_warnings():  # numpy's, of text at whose middle a number ends
            warnings.simplefilter("ignore")
            mesh = trimesh.load_mesh(io.BytesIO(data), file_type=kind, process=False)
    except Exception as error:  # of any kind: it trusts its files
        raise InputError(path, f"can't be read: {' '.join(str(error).split())[:120]}") from None
    if len(mesh.faces) != triangles:
        raise InputError(path, f"damaged: {len(mesh.faces)} triangles can be read of {triangles}")
    points, corners = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    if not np.isfinite(points).all():
        raise InputError(path, "NaN or infinity, expected finite numbers")
    if corners.min() < 0 or corners.max() >= len(points):
        raise InputError(path, f"a face with a point outside 0 to {len(points) - 1}")
    return Scan(name=path.stem, points=points, triangles=corners.astype(np.int32))


def read_scan(path: Path) -> Scan:
    """The scan in `path`: PLY, OBJ, STL, OFF, glTF, VRM, FBX or USD, by its suffix (`READERS`).

    Colours come from the points, or else from the texture or colour of the material at each point.

    :raises InputError: another suffix, or a file that can't be used: no points, cut short, NaN or infinity, coordinates
        over 1e15, or fewer than 3 places
    """
    path = Path(path)
    if path.suffix.lower() not in READERS:
        raise InputError(path, f"suffix '{path.suffix}', expected one of {', '.join(READERS)}")
    try:
        scan = READERS[path.suffix.lower()](path)
        if not scan.hints.vertices:
            scan = replace(scan, hints=replace(scan.hints, vertices={"": scan.points}))
        # points at one place are one point, with the first one's normal and colour; triangles that collapse are dropped
        first, of_point = merge_points(scan.points)
        if len(first) < len(scan.points):
            triangles = of_point[scan.triangles]
            a, b, c = triangles.T
            whole = (a != b) & (b != c) & (c != a)
            if len(triangles) and not whole.any():
                raise InputError(scan.name, "all triangles are degenerate, expected a surface")
            scan = replace(
                scan,
                points=scan.points[first],
                triangles=triangles[whole].astype(np.int32),
                normals=None if scan.normals is None else scan.normals[first],
                colors=None if scan.colors is None else scan.colors[first],
                texture=None if scan.texture is None else scan.texture.on_triangles(whole),
                hints=scan.hints.on_triangles(whole),
            )
    except FacepipeError as error:
        raise error if str(path) in str(error) else error.under(path) from None
    if not np.isfinite(scan.points).all() or np.abs(scan.points).max() > LARGEST:
        raise InputError(path, f"coordinates over {LARGEST:g}, expected smaller ones")
    if len(scan.points) < 3:
        raise InputError(path, f"points at {len(scan.points)} different places, expected a surface")
    return scan


def _read_obj(path: Path) -> Scan:
    obj = read_obj(path)
    if not len(obj.face_vertex_counts):
        return Scan(name=path.stem, points=obj.points, colors=obj.colors)
    library = read_materials(path, obj.libraries)
    mesh = Mesh(
        name="Scan",
        points=obj.points,
        face_vertex_counts=obj.face_vertex_counts,
        face_vertex_indices=obj.face_vertex_indices,
        uv_sets=() if obj.uv_indices is None else (UvSet(values=obj.uvs, indices=obj.uv_indices),),
        colors=obj.colors,
        material_faces=material_faces(obj.materials, obj.face_material),
    )
    materials = {name: one for name, one in library.materials.items() if name in obj.materials}
    # groups divide an object further, where a file has both
    names, of_face = (obj.groups, obj.face_group) if len(obj.groups) > 1 else (obj.objects, obj.face_object)
    piece = of_face[triangulate(obj.face_vertex_counts).faces]
    hints = ScanHints(pieces=names, piece=piece, vertices={"": obj.points})
    return replace(scan_of([mesh], materials, path.stem), warnings=tuple(library.warnings), hints=hints)


def _read_face(path: Path) -> Scan:
    from facepipe.importers.scan_hints import hints_of

    imported = load("usd" if path.suffix.lower() in USD else kind_of(path), path)
    materials = {material.name: material for material in imported.parts.materials}
    scan = scan_of(list(imported.parts.meshes), materials, path.stem)
    return replace(scan, warnings=imported.warnings, hints=hints_of(imported.parts))


def scan_of(meshes: Sequence[Mesh], materials: Mapping[str, Material], name: str) -> Scan:
    """All meshes in world space as one scan; points that no face uses are left out."""
    points, triangles, colors, textured, start = [], [], [], [], 0
    pictures: list[ScanPicture] = []
    for mesh in meshes:
        corners = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices).astype(np.int64)
        used, corners = np.unique(corners, return_inverse=True)
        local = np.asarray(mesh.points, dtype=np.float64)[used]
        points.append(transformed(local, mesh.transform))
        # a mirroring transform turns triangles round
        order = (0, 1, 2) if np.linalg.det(mesh.transform[:3, :3]) >= 0 else (0, 2, 1)
        triangles.append(corners.reshape(-1, 3)[:, order] + start)
        textured.append(_textured(mesh, materials, order, pictures))
        own = _point_colors(mesh, materials)
        colors.append(np.full((len(used), 3), 0.18) if own is None else own[used])  # mid grey beside others' colours
        start += len(used)
    joined, texture = np.concatenate(colors), None
    if pictures:
        uvs, numbers = map(np.concatenate, zip(*textured, strict=True))
        texture = ScanTexture(uvs=uvs, picture=numbers, pictures=tuple(pictures))
    return Scan(
        name=name,
        points=np.concatenate(points),
        triangles=np.concatenate(triangles).astype(np.int32),
        colors=None if np.ptp(joined, axis=0).max() < _PLAIN else joined,
        texture=texture,
    )


def _textured(
    mesh: Mesh, materials: Mapping[str, Material], order: tuple[int, int, int], pictures: list[ScanPicture]
) -> tuple[FloatArray, IntArray]:
    """UVs (t, 3, 2) of a mesh's triangles, and the number (t,) of the picture that each shows, -1 for none.

    :param order: of the corners of a triangle
    :param pictures: gets those that it does not have yet
    """
    corners, faces = triangulate(mesh.face_vertex_counts)
    uvs, numbers = np.zeros((len(corners), 3, 2)), np.full(len(corners), -1)
    names = [mesh.material, *(bound.material for bound in mesh.material_faces)]
    shown = np.zeros(len(mesh.face_vertex_counts), np.int64)  # which of these each face has
    for number, bound in enumerate(mesh.material_faces, 1):
        shown[bound.faces] = number
    for number, name in enumerate(names):
        color = materials[name].diffuse_color if name is not None and name in materials else None
        uv_set = None
        if isinstance(color, TextureInput) and mesh.colors is None:
            uv_set = next((one for one in mesh.uv_sets if one.name == color.uv_set), None)
        chosen = shown[faces] == number
        if uv_set is None or not isinstance(color, TextureInput) or not chosen.any():
            continue
        rows = np.asarray(mesh.face_vertex_indices if uv_set.indices is None else uv_set.indices)
        uvs[chosen] = np.asarray(uv_set.values)[rows[corners[chosen]]]
        picture = ScanPicture(data=color.texture.data, gain=color.scale[:3], bias=color.bias[:3])
        if picture not in pictures:
            pictures.append(picture)
        numbers[chosen] = pictures.index(picture)
    return uvs[:, order], numbers


READERS: dict[str, Callable[[Path], Scan]] = {
    ".ply": read_ply,
    ".obj": _read_obj,
    ".stl": read_stl,
    ".off": read_off,
    **dict.fromkeys((".glb", ".gltf", ".vrm", ".fbx", *USD), _read_face),
}


_TEXELS = 8  # a point: beyond, a texture holds pores that points can only make noise of


def _point_colors(mesh: Mesh, materials: Mapping[str, Material]) -> FloatArray | None:
    """(n, 3) linear colours of the points; None where the mesh has neither colours nor a coloured material.

    :raises InputError: a texture that is no image
    """
    if mesh.colors is not None:
        return np.clip(np.asarray(mesh.colors, dtype=np.float64), 0.0, 1.0)
    used, first = np.unique(mesh.face_vertex_indices, return_index=True)
    corner = np.full(
        len(mesh.points), -1, np.int64
    )  # a face corner of every point, the first; -1 for points of no face
    corner[used] = first
    named = [(material_face.material, material_face.faces) for material_face in mesh.material_faces]
    faces = np.repeat(np.arange(len(mesh.face_vertex_counts)), mesh.face_vertex_counts)
    colors = np.full((len(mesh.points), 3), np.nan)
    for name, chosen in [(mesh.material, None), *named]:
        if name is None or name not in materials:
            continue
        among = np.ones(len(mesh.face_vertex_counts), bool)
        if chosen is not None:
            among[:] = False
            among[chosen] = True
        at = np.flatnonzero((corner >= 0) & among[faces[corner]])
        found = _material_colors(mesh, materials[name], at, corner[at])
        if found is not None:
            colors[at] = found
    missing = np.isnan(colors[:, 0])
    if missing.all():
        return None
    colors[missing] = 0.18
    return np.asarray(np.clip(colors, 0.0, 1.0))


def _material_colors(mesh: Mesh, material: Material, points: IntArray, corners: IntArray) -> FloatArray | None:
    """(k, 3) colours at `points`."""
    color = material.diffuse_color
    if not isinstance(color, TextureInput):
        return np.tile(color, (len(points), 1))
    uv_set = next((one for one in mesh.uv_sets if one.name == color.uv_set), None)
    if uv_set is None:
        return None
    most = _TEXELS * len(mesh.points)
    # (h, w, 3) linear pixels, top row first, averaged down to about `most`
    where = f"texture {color.texture.name}"
    image = open_image(color.texture.data, where)
    factor = int(np.sqrt(image.width * image.height / max(most, 1)))
    texels = from_srgb(pixels(image, "RGB", where, max(factor, 1)) / 255.0)
    values = np.asarray(uv_set.values, dtype=np.float64)
    u, v = (values[points] if uv_set.indices is None else values[uv_set.indices[corners]]).T
    # bilinear, v up; textures repeat
    height, width = texels.shape[:2]
    x, y = u % 1.0 * width - 0.5, (1.0 - v) % 1.0 * height - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    across, down = (x - left)[:, None], (y - top)[:, None]
    columns, rows = (left % width, (left + 1) % width), (top % height, (top + 1) % height)
    upper = texels[rows[0], columns[0]] * (1 - across) + texels[rows[0], columns[1]] * across
    lower = texels[rows[1], columns[0]] * (1 - across) + texels[rows[1], columns[1]] * across
    texel = upper * (1 - down) + lower * down
    return np.asarray(texel * np.array(color.scale[:3]) + np.array(color.bias[:3]))
