"""Transforms of textures, baked into the texture coordinates that they are read at."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from facepipe.core.errors import InputError
from facepipe.parts import FaceParts, Material, Mesh, TextureInput, UvSet, UvTransform

IDENTITY: UvTransform = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
_MOST_MOVED = 64  # UV sets that one mesh gets: each is as large as the mesh, and a transform is a few bytes


def composed(outer: UvTransform, inner: UvTransform) -> UvTransform:
    """`outer` of what `inner` makes."""
    a, b, c, d, e, f = outer
    g, h, i, j, k, m = inner
    return (a * g + b * j, a * h + b * k, a * i + b * m + c, d * g + e * j, d * h + e * k, d * i + e * m + f)


def scaled_turned_moved(scale: tuple[float, float], degrees: float, offset: tuple[float, float]) -> UvTransform:
    """``R(degrees) S(scale) uv + offset``, v up, turned counter-clockwise: UsdTransform2d of the UsdPreviewSurface
    specification."""
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    (x, y), (u, v) = scale, offset
    return (cosine * x, -sine * y, u, sine * x, cosine * y, v)


def with_baked_uvs(parts: FaceParts) -> FaceParts:
    """The face with no transform left at its textures.

    Where all textures that read a UV set move it in one way, the set's values become the moved ones; else each other
    way gets a set of its own, called after the first: ``st_1``.

    :raises InputError: a mesh that would get far more sets than any has
    """
    ways: dict[str, dict[UvTransform, None]] = {}
    for material in parts.materials:
        for used in material.textured.values():
            ways.setdefault(used.uv_set, {})[used.uv_transform] = None
    if all([*own] == [IDENTITY] for own in ways.values()):
        return parts
    taken = {uvs.name for mesh in parts.meshes for uvs in mesh.uv_sets} | {*ways}
    target: dict[tuple[str, UvTransform], str] = {}
    for name, own in ways.items():
        number = 0
        for way in own:
            called = name
            while way != IDENTITY and len(own) > 1 and called in taken:
                number += 1
                called = f"{name}_{number}"
            taken.add(called)
            target[name, way] = called

    def moved(used: TextureInput) -> TextureInput:
        return replace(used, uv_set=target[used.uv_set, used.uv_transform], uv_transform=IDENTITY)

    known = {material.name: material for material in parts.materials}
    changes = {name: {key: moved(used) for key, used in one.textured.items()} for name, one in known.items()}
    materials = tuple(replace(one, **changes[one.name]) for one in parts.materials)  # type: ignore[arg-type]
    return replace(parts, meshes=tuple(_with_sets(mesh, known, target) for mesh in parts.meshes), materials=materials)


def _with_sets(mesh: Mesh, known: dict[str, Material], target: dict[tuple[str, UvTransform], str]) -> Mesh:
    """A mesh with the UV sets that its own materials read.

    :param known: materials by name
    """
    bound = dict.fromkeys([mesh.material, *(one.material for one in mesh.material_faces)])
    bound |= dict.fromkeys(other for name in bound if name in known for other in known[name].variants.values())
    used = [one for name in bound if name in known for one in known[name].textured.values()]
    sets = list(mesh.uv_sets)
    moving = dict.fromkeys((one.uv_set, one.uv_transform) for one in used if one.uv_transform != IDENTITY)
    if len(moving) > _MOST_MOVED:
        raise InputError(mesh.name, f"{len(moving)} transforms of textures, expected at most {_MOST_MOVED}")
    for source, way in moving:
        given = next((uvs for uvs in mesh.uv_sets if uvs.name == source), None)
        if given is None:
            continue
        a, b, c, d, e, f = way
        u, v = np.asarray(given.values, dtype=np.float64).T
        values = np.stack([a * u + b * v + c, d * u + e * v + f], axis=1).astype(np.asarray(given.values).dtype)
        name = target[source, way]
        moved = UvSet(name=name, values=values, indices=given.indices)
        sets = [moved if uvs.name == name else uvs for uvs in sets] + ([] if name == source else [moved])
    return replace(mesh, uv_sets=tuple(sets))
