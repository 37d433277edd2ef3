"""People who wear different hair blend: the first one's follows the skin of the result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from facepipe.core.errors import TopologyError
from facepipe.geometry.closest_points import closest_places
from facepipe.geometry.polygons import point_triangles
from facepipe.heads import make
from facepipe.heads.assembly import make_head
from facepipe.heads.people import MODES, Look
from facepipe.heads.surfaces import dressed
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


def test_hair_of_another_style_is_not_blended_though_it_is_of_one_topology() -> None:
    """A crop and a receding one are cards of one number and size, which lie elsewhere on the head."""
    bald = few(make_head(np.zeros(MODES)))
    crop, receding = (dressed(bald, Look(tone=3, style=style, hair="brown"), 16) for style in ("crop", "receding"))
    np.testing.assert_array_equal(mesh(crop, "Hair").face_vertex_indices, mesh(receding, "Hair").face_vertex_indices)
    sources = stack([Face.from_parts(crop), Face.from_parts(receding)])
    assert any("wears" in line and "Hair" in line for line in sources.warnings)
    np.testing.assert_allclose(mesh(sources.parts[1], "Hair").points, mesh(crop, "Hair").points, atol=1e-4)
    assert stack([Face.from_parts(crop), Face.from_parts(crop)]).warnings == ()


def test_teeth_are_no_cards(haired: FaceParts) -> None:
    toothless = replace(haired, meshes=tuple(one for one in haired.meshes if one.name != "Teeth"))
    with pytest.raises(TopologyError, match="no mesh 'Teeth'"):
        stack([Face.from_parts(haired), Face.from_parts(toothless)])
