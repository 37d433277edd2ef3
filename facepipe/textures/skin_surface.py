"""The skin that photos are baked to: the mesh with the face's landmarks, and the textures of its colours."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from facepipe.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.images import open_image
from facepipe.geometry.colors import from_srgb
from facepipe.geometry.landmarks import eye_distance
from facepipe.geometry.polygons import edges, point_areas, point_normals, triangulate
from facepipe.geometry.texels import Texels, membrane, texels_of
from facepipe.geometry.vectors import transformed
from facepipe.parts import FaceParts, Material, Mesh, TextureInput
from facepipe.pictures.occlusion import visible_sky
from facepipe.stage import Face
from facepipe.stage.materials import author_opacity

SMALLEST, LARGEST = 64, 4096  # texels a side
SCHEME = "multipie68"
LEFT = (*range(17, 22), *range(36, 42), 31, 48, 3, 6)  # landmarks whose mirrors are known
RIGHT = (*range(26, 21, -1), 45, 44, 43, 42, 47, 46, 35, 54, 13, 10)
_SKY_RESOLUTION = 256  # map pixels
_OPEN = 0.15  # share of the sky: insides of mouth, nostrils and eye sockets see less
_SAME = 0.03  # of the eyes' distance: a mirrored point may lie so far from another
_BROWS = slice(17, 27)  # landmarks
_REACH = 0.25  # of the eyes' distance: cards of brows lie so near to them


@dataclass(frozen=True, kw_only=True)
class SkinTexture:
    """A texture of the skin's colours."""

    materials: tuple[str, ...]  # that show it
    source: TextureInput
    uv_corners: FloatArray  # (t, 3, 2) of the triangles that show it
    triangles: IntArray  # (t, 3) their points
    size: int  # texels a side

    @cached_property
    def texels(self) -> Texels:
        """Where its texels lie: of 2048 a side 0.5 s and 120 MB, and nothing where none are baked."""
        return texels_of(self.uv_corners, self.triangles, self.size)


@dataclass(frozen=True, kw_only=True)
class SkinSurface:
    """A mesh of n points among those of all meshes."""

    mesh: Mesh
    first: int  # its first point among those of all meshes
    triangles: IntArray  # (t, 3) its own, by its points
    opaque: IntArray  # (o, 3) of all meshes that no light goes through, by the points of all
    points: FloatArray  # (n, 3) world, the neutral person
    outside: BoolArray  # (n,) nothing hides it from all sides: not the mouth's inside, nor the eyes' sockets
    mirror: IntArray  # (n,) point of the other side, -1 where there is none
    textures: tuple[SkinTexture, ...]

    @property
    def landmarks(self) -> IntArray:
        """(68,) points."""
        return np.asarray(self.mesh.landmarks[SCHEME].indices)

    @property
    def span(self) -> slice:
        """Its points among those of all meshes."""
        return slice(self.first, self.first + len(self.points))

    def eye_distance(self, points: FloatArray) -> float:
        """Distance of the eyes' outer corners on its points (n, 3)."""
        return eye_distance(points[self.landmarks])

    @cached_property
    def areas(self) -> FloatArray:
        """(n,) of each point's share of the surface, in squares of the eyes' distance."""
        areas = point_areas(self.points, self.triangles) / self.eye_distance(self.points) ** 2
        return np.asarray(np.maximum(areas, 1e-12))

    @cached_property
    def edges(self) -> IntArray:
        """(e, 2) its edges."""
        pairs, _ = edges(self.mesh.face_vertex_counts, self.mesh.face_vertex_indices)
        return pairs

    def smooth(self, values: FloatArray, weights: FloatArray, reach: float) -> FloatArray:
        """(n, c) `membrane` of values (n, c), over a reach in shares of the eyes' distance."""
        return membrane(self.points / self.eye_distance(self.points), self.triangles, values, weights, reach)

    def other_side(self, values: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Values (n, c) and weights (n,) of the other side of the face; weight 0 where there is none."""
        mirror = np.maximum(self.mirror, 0)
        return values[mirror], np.where(self.mirror >= 0, weights[mirror], 0.0)


def skin_of(parts: FaceParts, neutral: FloatArray, size: int | None) -> SkinSurface:
    """The skin of a face.

    :param neutral: (n, 3) world points of all meshes
    :param size: texels a side of the textures; None: as large as they are
    :raises InputError: no mesh has landmarks, or its materials have no texture of colours
    """
    mesh = next((mesh for mesh in parts.meshes if SCHEME in mesh.landmarks), None)
    if mesh is None:
        raise InputError(parts.name, f"no landmarks '{SCHEME}', expected a face that was fitted to photos")
    textures = textures_of(parts, mesh, size)
    if not textures:
        raise InputError(f"{parts.name} -> {mesh.name}", "no texture of colours, expected a material with one")
    first = sum(len(other.points) for other in parts.meshes[: parts.meshes.index(mesh)])
    # triangles of each mesh without those of materials that let light through
    opacity = {material.name: material.opacity for material in parts.materials}
    solid, start = [], 0
    for other in parts.meshes:
        corners, faces = triangulate(other.face_vertex_counts)
        whole = np.array([opacity.get(name, 1.0) == 1.0 for name in names_of(other)])[of_faces(other)]
        solid.append(np.asarray(other.face_vertex_indices, dtype=np.int64)[corners[whole[faces]]] + start)
        start += len(other.points)
    opaque = np.concatenate(solid)
    corners, _ = triangulate(mesh.face_vertex_counts)
    triangles = np.asarray(mesh.face_vertex_indices, dtype=np.int64)[corners]
    span = slice(first, first + len(mesh.points))
    normals = point_normals(neutral, opaque)
    sky = visible_sky(neutral, normals, opaque, np.zeros(len(neutral), bool), _SKY_RESOLUTION)
    return SkinSurface(
        mesh=mesh,
        first=first,
        triangles=triangles,
        opaque=opaque,
        points=neutral[span],
        outside=np.asarray(sky.share(normals) > _OPEN)[span],
        mirror=mirrored_points(transformed(mesh.points, mesh.transform), np.asarray(mesh.landmarks[SCHEME].indices)),
        textures=textures,
    )


def names_of(mesh: Mesh) -> tuple[str, ...]:
    """Its materials: that of the whole mesh, then those of faces."""
    return (mesh.material or "", *(bound.material for bound in mesh.material_faces))


def of_faces(mesh: Mesh) -> IntArray:
    """(faces,) which of `names_of` each face shows."""
    number = np.zeros(len(mesh.face_vertex_counts), np.int64)
    for place, bound in enumerate(mesh.material_faces, 1):
        number[np.asarray(bound.faces, dtype=np.int64)] = place
    return number


def template_texels(texture: SkinTexture) -> Float32Array:
    """(m, 3) linear colours of a texture's texels as its material shows them."""
    from PIL import Image

    source, size = texture.source, texture.texels.size
    picture = open_image(source.texture.image(), f"texture {source.texture.name}").convert("RGB")
    picture = picture.resize((size, size), Image.Resampling.BICUBIC)
    # a table of 256 levels a channel, not millions of powers
    linear = from_srgb(np.arange(256, dtype=np.float32)[:, None] / np.float32(255))
    table = np.clip(linear * np.array(source.scale[:3]) + np.array(source.bias[:3]), 0, 1).astype(np.float32)
    levels = np.asarray(picture).reshape(-1, 3)

    def shown(part: Texels) -> FloatArray:
        own = np.take(levels, part.at, axis=0)
        return np.stack([np.take(table[:, channel], own[:, channel]) for channel in range(3)], axis=1)

    return texture.texels.by_runs(shown)


def textures_of(parts: FaceParts, mesh: Mesh, size: int | None) -> tuple[SkinTexture, ...]:
    """The textures of colours of a mesh, each with where it lies on it; none: its materials have none.

    :param size: texels a side; None: as large as they are
    """
    materials = {material.name: material for material in parts.materials}
    corners, faces = triangulate(mesh.face_vertex_counts)
    triangles = np.asarray(mesh.face_vertex_indices, dtype=np.int64)[corners]
    shown: dict[tuple[str, str], list[int]] = {}
    for place, name in enumerate(names_of(mesh)):
        source = materials[name].diffuse_color if name in materials else None
        if isinstance(source, TextureInput):
            shown.setdefault((source.texture.name, source.uv_set), []).append(place)
    textures = []
    for (_, uv_set), places in shown.items():
        chosen = np.isin(of_faces(mesh)[faces], places)
        names = tuple(dict.fromkeys(names_of(mesh)[place] for place in places))
        material = materials[names[0]]
        assert isinstance(material.diffuse_color, TextureInput)
        source = material.diffuse_color
        uv = next((one for one in mesh.uv_sets if one.name == uv_set), None)
        if uv is None or not chosen.any():
            continue
        rows = triangles if uv.indices is None else np.asarray(uv.indices, dtype=np.int64)[corners]
        side = size
        if not side:
            image = open_image(source.texture.image(), f"texture {source.texture.name}")
            side = int(np.clip(max(image.size), SMALLEST, LARGEST))
        textures.append(
            SkinTexture(
                materials=names,
                source=source,
                uv_corners=np.asarray(uv.values)[rows[chosen]],
                triangles=triangles[chosen],
                size=side,
            )
        )
    return tuple(textures)


def mirrored_points(points: FloatArray, landmarks: IntArray) -> IntArray:
    """(n,) of each point (n, 3) the one at its mirror image, -1 where there is none.

    The plane of symmetry is that between landmarks (68,) of both sides.
    """
    left, right = points[landmarks[list(LEFT)]], points[landmarks[list(RIGHT)]]
    normal = (right - left).sum(axis=0)
    normal /= max(float(np.linalg.norm(normal)), 1e-12)
    offset = float(((left + right) / 2 @ normal).mean())
    image = points - 2 * (points @ normal - offset)[:, None] * normal
    distance, nearest = cKDTree(points).query(image)
    reach = _SAME * eye_distance(points[landmarks])
    return np.where(distance <= reach, nearest, -1)


def hide_brow_cards(face: Face, skin: SkinSurface) -> tuple[str, ...]:
    """Make cards that lie on the brows transparent, within `Face.deriving`; their materials."""
    cards = brow_cards(face, skin)
    for prim in cards:
        author_opacity(face.stage.GetPrimAtPath(prim), 0.0)
    return tuple(material.name for material in cards.values())


def brow_cards(face: Face, skin: SkinSurface) -> dict[str, Material]:
    """The materials of cards that lie on the brows, by their prims."""
    rest = transformed(skin.mesh.points, skin.mesh.transform)
    brows, reach = rest[skin.landmarks[_BROWS]], _REACH * skin.eye_distance(rest)
    near = {
        mesh.material
        for mesh in face.meshes
        if cKDTree(brows).query(transformed(mesh.points, mesh.transform))[0].max() < reach
    }
    cut = {one.name: one for one in face.materials if one.name in near and isinstance(one.opacity, TextureInput)}
    return {prim: cut[name] for prim, name in face.material_names.items() if name in cut}
