"""Meshes and materials of a face in one: teeth, gums and tongue; both eyes; all hair. Engines draw each for itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.parts import (
    Blendshape,
    FaceParts,
    Inbetween,
    Landmarks,
    Material,
    MaterialFaces,
    Mesh,
    Skin,
    TextureInput,
    UvSet,
)
from facepipe_gltf.atlas import PICTURED, Atlas

_WHOLE = 0.5  # a point is in a region from here on
_CARDS = "hair"
_ROUNDING = 1e-4  # that UVs may leave a picture


def merged(parts: FaceParts) -> FaceParts:
    """The face with the meshes of a role in one, and the materials of each of these in as few as can be.

    A role is a region that a mesh lies in whole, or hair: cards that light comes through. Meshes of other spaces, bound
    or skinned otherwise, of other UV sets, and materials that differ in more than pictures stay by themselves.
    """
    known = {material.name: material for material in parts.materials}
    groups: dict[tuple[object, ...], list[Mesh]] = {}
    for mesh in parts.meshes:
        role = role_of(mesh, known)
        groups.setdefault(("", mesh.name) if role is None else (role, *_space(mesh)), []).append(mesh)
    meshes, made = [], dict[str, Material]()
    names = {group[0].name for group in groups.values() if len(group) == 1}
    surfaces = set(known)
    for (kind, *_), group in groups.items():
        if len(group) == 1:
            meshes += group
            continue
        whole = _one_mesh(_free(str(kind).capitalize(), names), group)
        whole, own = _one_material(whole, known, surfaces)
        made |= own
        meshes.append(whole)
    used = {name for mesh in meshes for name in _bound(mesh)} | {
        other for material in parts.materials for other in material.variants.values()
    }
    materials = tuple(material for material in (*parts.materials, *made.values()) if material.name in used)
    return replace(parts, meshes=tuple(meshes), materials=materials)


def _free(name: str, names: set[str]) -> str:
    """The name, or another that is not taken; it is from then on."""
    found, number = name, 2
    while found in names:
        found, number = f"{name}{number}", number + 1
    names.add(found)
    return found


def _bound(mesh: Mesh) -> list[str]:
    """The names of its materials, the mesh's own first."""
    own = [] if mesh.material is None else [mesh.material]
    return list(dict.fromkeys([*own, *(one.material for one in mesh.material_faces)]))


def role_of(mesh: Mesh, known: Mapping[str, Material]) -> str | None:
    """A region that a mesh lies in whole, "hair" for cards that light comes through, or None: skin.

    :param known: materials by name
    """
    used = [known[name] for name in _bound(mesh) if name in known]
    if mesh.double_sided and used and all(not _opaque(one) for one in used):
        return _CARDS
    within = [name for name, mask in mesh.regions.items() if len(mask) and np.min(mask) >= _WHOLE]
    return within[0] if used and len(within) == 1 else None


def _opaque(material: Material) -> bool:
    return not isinstance(material.opacity, TextureInput) and material.opacity >= 1.0


def _space(mesh: Mesh) -> tuple[object, ...]:
    """What meshes have to agree in to become one."""
    skin = mesh.skin
    bound = None if skin is None else (np.round(skin.geom_bind_transform, 9).tobytes(), skin.dual_quaternion)
    uvs = tuple(uv_set.name for uv_set in mesh.uv_sets)
    kinds = (mesh.normals is None, mesh.colors is None, mesh.double_sided, len(uvs) == 1 or mesh.name)
    return (np.round(mesh.transform, 9).tobytes(), bound, uvs, kinds)


def _one_mesh(name: str, meshes: Sequence[Mesh]) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.points) for mesh in meshes)])
    faces = np.cumsum([0, *(len(mesh.face_vertex_counts) for mesh in meshes)])
    count = int(starts[-1])
    regions = {region: np.zeros(count) for mesh in meshes for region in mesh.regions}
    of_material: dict[str, list[IntArray]] = {}
    for mesh, start, first in zip(meshes, starts, faces, strict=False):
        for region, mask in mesh.regions.items():
            regions[region][start : start + len(mask)] = mask
        own = np.arange(len(mesh.face_vertex_counts))
        taken = np.concatenate([[], *(one.faces for one in mesh.material_faces)]).astype(np.int64)
        if mesh.material is not None:
            of_material.setdefault(mesh.material, []).append(first + np.setdiff1d(own, taken))
        for one in mesh.material_faces:
            of_material.setdefault(one.material, []).append(first + np.asarray(one.faces))
    landmarks = {
        scheme if scheme not in meshes[0].landmarks or mesh is meshes[0] else f"{scheme}_{mesh.name}": Landmarks(
            indices=(np.asarray(one.indices) + start).astype(np.int32), names=one.names
        )
        for mesh, start in zip(meshes, starts, strict=False)
        for scheme, one in mesh.landmarks.items()
    }
    return Mesh(
        name=name,
        points=np.concatenate([mesh.points for mesh in meshes]),
        face_vertex_counts=np.concatenate([mesh.face_vertex_counts for mesh in meshes]),
        face_vertex_indices=np.concatenate(
            [mesh.face_vertex_indices + start for mesh, start in zip(meshes, starts, strict=False)]
        ).astype(np.int32),
        transform=meshes[0].transform,
        normals=_one_normals(meshes),
        uv_sets=_one_uv_set(meshes),
        colors=None if meshes[0].colors is None else np.concatenate([np.asarray(mesh.colors) for mesh in meshes]),
        skin=_one_skin(meshes),
        blendshapes=_one_shapes(meshes, starts),
        regions=regions,
        landmarks=landmarks,
        material_faces=tuple(
            MaterialFaces(material=material, faces=np.concatenate(found).astype(np.int32))
            for material, found in of_material.items()
            if sum(map(len, found))
        ),
        double_sided=meshes[0].double_sided,
    )


def _one_normals(meshes: Sequence[Mesh]) -> FloatArray | None:
    """Of points where all meshes have such, else of corners."""
    if any(mesh.normals is None for mesh in meshes):
        return None
    normals = [np.asarray(mesh.normals) for mesh in meshes]
    if any(len(own) != len(mesh.points) for own, mesh in zip(normals, meshes, strict=True)):
        pairs = zip(normals, meshes, strict=True)
        normals = [own[mesh.face_vertex_indices] if len(own) == len(mesh.points) else own for own, mesh in pairs]
    return np.concatenate(normals)


def _one_uv_set(meshes: Sequence[Mesh]) -> tuple[UvSet, ...]:
    if not meshes[0].uv_sets:
        return ()
    sets = [mesh.uv_sets[0] for mesh in meshes]
    starts = np.cumsum([0, *(len(one.values) for one in sets)])
    numbers = [
        (mesh.face_vertex_indices if one.indices is None else one.indices) + start
        for mesh, one, start in zip(meshes, sets, starts, strict=False)
    ]
    values = np.concatenate([one.values for one in sets])
    return (UvSet(name=sets[0].name, values=values, indices=np.concatenate(numbers).astype(np.int32)),)


def _one_skin(meshes: Sequence[Mesh]) -> Skin | None:
    skins = [mesh.skin for mesh in meshes if mesh.skin is not None]
    if not skins:
        return None
    most = max(skin.joint_indices.shape[1] for skin in skins)

    def wide(values: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
        return np.pad(values, ((0, 0), (0, most - values.shape[1])))

    return replace(
        skins[0],
        joint_indices=np.concatenate([wide(skin.joint_indices) for skin in skins]),
        joint_weights=np.concatenate([wide(skin.joint_weights) for skin in skins]),
    )


def _one_shapes(meshes: Sequence[Mesh], starts: IntArray) -> tuple[Blendshape, ...]:
    """Shapes of one name as one; where a mesh lacks an inbetween of the others, it goes straight there."""
    found = []
    for name in dict.fromkeys(shape.name for mesh in meshes for shape in mesh.blendshapes):
        own = [
            (shape, int(start))
            for mesh, start in zip(meshes, starts, strict=False)
            for shape in mesh.blendshapes
            if shape.name == name
        ]
        sculpts = [sculpt for shape, _ in own for _, _, sculpt in shape.sculpts]
        turned = all(sculpt.normal_offsets is not None for sculpt in sculpts)
        taken, inbetweens = set[str](), list[Inbetween]()
        for weight, label in {one.weight: one.name for shape, _ in reversed(own) for one in shape.inbetweens}.items():
            inbetweens.append(
                Inbetween(
                    name=_free(label, taken),
                    weight=weight,
                    offsets=np.concatenate([_at(shape, weight, "offsets") for shape, _ in own]),
                    normal_offsets=np.concatenate([_at(shape, weight, "normal_offsets") for shape, _ in own])
                    if turned
                    else None,
                )
            )
        found.append(
            Blendshape(
                name=name,
                point_indices=np.concatenate([shape.point_indices + start for shape, start in own]).astype(np.int32),
                offsets=np.concatenate([shape.offsets for shape, _ in own]),
                normal_offsets=np.concatenate([_at(shape, 1.0, "normal_offsets") for shape, _ in own])
                if turned
                else None,
                inbetweens=tuple(sorted(inbetweens, key=lambda one: one.weight)),
                label=own[0][0].label,
            )
        )
    return tuple(found)


def _at(shape: Blendshape, weight: float, field: str) -> FloatArray:
    """(k, 3) offsets of a shape, or of its normals, at a weight: its sculpt there, else between those beside it."""
    sculpts = sorted(((at, getattr(sculpt, field)) for _, at, sculpt in shape.sculpts), key=lambda one: one[0])
    weights = np.array([0.0, *(one for one, _ in sculpts)])
    values = [np.zeros_like(sculpts[0][1]), *(own for _, own in sculpts)]
    after = int(np.clip(np.searchsorted(weights, weight), 1, len(weights) - 1))
    share = (weight - weights[after - 1]) / (weights[after] - weights[after - 1])
    return np.asarray(values[after - 1] + share * (values[after] - values[after - 1]))


def _one_material(mesh: Mesh, known: Mapping[str, Material], names: set[str]) -> tuple[Mesh, dict[str, Material]]:
    """The mesh with its materials that differ in pictures alone in one each, and these."""
    if not mesh.uv_sets:
        return mesh, {}
    uv_set, counts = mesh.uv_sets[0], np.asarray(mesh.face_vertex_counts)
    values = np.asarray(uv_set.values, np.float64)[uv_set.indices]
    of_corner = np.repeat(np.arange(len(counts)), counts)
    corners = {one.material: np.isin(of_corner, one.faces) for one in mesh.material_faces}
    kinds: dict[object, list[str]] = {}
    for name in _bound(mesh):
        kinds.setdefault(_kind(known[name]) if name in known else name, []).append(name)
    made, called = dict[str, Material](), dict[str, str]()
    for group in kinds.values():
        looks = _looks([known[name] for name in group]) if len(group) > 1 else []
        found = {name: _tile(values[corners[name]], known[name]) for _, own in looks for name in own}
        tiles = {name: tile for name, tile in found.items() if tile is not None}
        if len(group) == 1 or (len(looks) > 1 and len(tiles) < len(found)):
            called |= {name: name for name in group}
            continue
        whole = _free(mesh.name, names)
        called |= dict.fromkeys(group, whole)
        if len(looks) == 1:
            made[whole] = replace(looks[0][0], name=whole)
            continue
        atlas = Atlas([look for look, _ in looks], uv_set.name)
        made[whole] = atlas.material(whole)
        for number, (_, own) in enumerate(looks):
            for name in own:
                values[corners[name]] = atlas.uvs(number, values[corners[name]] - tiles[name])
    bound: dict[str, list[IntArray]] = {}
    for one in mesh.material_faces:
        bound.setdefault(called[one.material], []).append(np.asarray(one.faces))
    flat, numbers = np.unique(values, axis=0, return_inverse=True)
    uvs = replace(uv_set, values=flat.astype(np.float32), indices=numbers.reshape(-1).astype(np.int32))
    faces = tuple(
        MaterialFaces(material=name, faces=np.sort(np.concatenate(own)).astype(np.int32)) for name, own in bound.items()
    )
    alone = faces[0].material if len(faces) == 1 else None
    return replace(mesh, uv_sets=(uvs,), material=alone, material_faces=() if alone else faces), made


def _looks(materials: Sequence[Material]) -> list[tuple[Material, list[str]]]:
    """Materials that look alike as one each, and the names of those."""
    found: list[tuple[Material, list[str]]] = []
    for material in materials:
        look = replace(material, name="", label=None)
        for known, names in found:
            if known == look:
                names.append(material.name)
                break
        else:
            found.append((look, [material.name]))
    return found


def _kind(material: Material) -> tuple[object, ...]:
    """What materials have to agree in to become one."""
    how = "opaque" if _opaque(material) else ("test" if material.opacity_threshold > 0 else "blend")
    other = {name: value for name, value in vars(material).items() if name not in (*PICTURED, "name", "label")}
    other["variants"] = tuple(sorted(material.variants.items()))
    return (how, *(other[name] for name in sorted(other)))


def _tile(values: FloatArray, material: Material) -> FloatArray | None:
    """(2,) the corner of the tile that UVs (n, 2) lie in, which is one of pictures that repeat; None: they leave it."""
    if not values.size:
        return np.zeros(2)
    corner = np.floor(values.min(axis=0) + _ROUNDING)
    repeats = all(used.wrap_s == used.wrap_t == "repeat" for used in material.textured.values())
    inside = (values.max(axis=0) <= corner + 1 + _ROUNDING).all() and (repeats or not corner.any())
    return np.asarray(corner) if inside else None
