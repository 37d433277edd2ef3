"""People who wear different hair blend: the first one's follows the skin of the result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from facepipe.core.errors import TopologyError
from facepipe.geometry.closest_points import closest_places
from facepipe.geometry.polygons import point_triangles
from facepipe.heads import make
from facepipe.parts import FaceParts, Mesh
from facepipe.stage import Face
from facepipe.verbs.blend.sources import stack


def mesh(parts: FaceParts, name: str) -> Mesh:
    return next(one for one in parts.meshes if one.name == name)


def few(parts: FaceParts) -> FaceParts:
    """With two shapes."""
    keep = ("jawOpen", "browInnerUp")
    meshes = (
        replace(one, blendshapes=tuple(shape for shape in one.blendshapes if shape.name in keep))
        for one in parts.meshes
    )
    return replace(parts, meshes=tuple(meshes), sliders=(), animations=(), played=None)


def away(parts: FaceParts) -> np.ndarray:
    """(n,) how far the hair is from the skin, cm."""
    head = mesh(parts, "Head")
    triangles = point_triangles(head.face_vertex_counts, head.face_vertex_indices)
    return closest_places(mesh(parts, "Hair").points, head.points, triangles).distances


@pytest.fixture(scope="module")
def haired() -> FaceParts:
    people = (make(seed, textures=16) for seed in range(1, 30))
    return few(next(parts for parts in people if any(one.name == "Hair" for one in parts.meshes)))


def test_hair_that_another_has_not_follows_its_skin(haired: FaceParts) -> None:
    bald = few(make(7))
    sources = stack([Face.from_parts(haired), Face.from_parts(bald)])
    assert [one.name for one in sources.parts[1].meshes] == [one.name for one in haired.meshes]
    assert any("wears" in line and "Hair" in line for line in sources.warnings)
    np.testing.assert_allclose(mesh(sources.parts[1], "Head").points, mesh(bald, "Head").points, atol=1e-5)
    assert np.median(np.abs(away(sources.parts[1]) - away(haired))) < 0.1
    moved = mesh(sources.parts[1], "Hair").points - mesh(haired, "Hair").points
    assert np.linalg.norm(moved, axis=1).mean() > 0.05


def test_teeth_are_no_cards(haired: FaceParts) -> None:
    toothless = replace(haired, meshes=tuple(one for one in haired.meshes if one.name != "Teeth"))
    with pytest.raises(TopologyError, match="no mesh 'Teeth'"):
        stack([Face.from_parts(haired), Face.from_parts(toothless)])
