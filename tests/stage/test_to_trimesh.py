"""A face as trimesh's meshes: the points and triangles of its export, whoever is set on it and however it lies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gltf_reader
import numpy as np
import pytest
import small_head as sample
import trimesh
from facepipe_gltf import Options, export
from faces import replace_mesh, tiny_face
from import_data import shared

import facepipe
from facepipe.core.errors import InputError
from facepipe.importers import makehuman
from facepipe.parts import FaceParts, Slider
from facepipe.stage import Face, save_parts

Triangles = set[tuple[int, int, int]]


def mirrored_z_up() -> FaceParts:
    """In centimetres, Z up, its loose mesh mirrored and the other bound by a mirror."""
    parts = tiny_face()
    mirror = np.diag([-2.0, 1.0, 1.0, 1.0])
    head, teeth = parts.meshes
    assert head.skin is not None
    head = replace_mesh(head, skin=replace(head.skin, geom_bind_transform=mirror), colors=np.full((36, 3), 0.25))
    meshes = (head, replace_mesh(teeth, transform=mirror))
    return replace(parts, meshes=meshes, meters_per_unit=0.01, up_axis="Z")


def person(parts: FaceParts) -> FaceParts:
    """Somebody else: every slider a third of the way to its end."""
    sliders = tuple(
        replace(slider, value=slider.default + (slider.maximum - slider.default) / 3) for slider in parts.sliders
    )
    return replace(parts, sliders=sliders)


def real_person() -> FaceParts:
    return person(makehuman.read(shared("makehuman/makehuman_head.npz"), makehuman.Options()).parts)


def turned(triangles: np.ndarray) -> Triangles:
    """Each from its lowest point on, in its own sense."""
    return {tuple(np.roll(triangle, -int(np.argmin(triangle))).tolist()) for triangle in triangles}


def exported(glb: gltf_reader.Gltf, name: str) -> Triangles:
    """The triangles of a mesh in a .glb, as numbers of the stage's points."""
    found: Triangles = set()
    for primitive in glb.mesh(name)["primitives"]:
        points = glb.decoded(primitive["attributes"]["_FACEPIPE_POINT"]).astype(int)
        found |= turned(points[glb.decoded(primitive["indices"]).astype(int)].reshape(-1, 3))
    return found


@pytest.mark.parametrize(
    "made", [mirrored_z_up, lambda: person(sample.make()), real_person], ids=["mirrored", "sample", "makehuman"]
)
def test_it_is_what_an_export_delivers(made: Callable[[], FaceParts], tmp_path: Path) -> None:
    save_parts(made(), tmp_path / "face.usdc")
    face = facepipe.open(tmp_path / "face.usdc")
    export(face, tmp_path / "face.glb", Options(influences=8))
    glb = gltf_reader.read(tmp_path / "face.glb")
    expected, scene = glb.evaluate({}), face.to_trimesh()
    assert scene.units == "m"
    assert [*scene.geometry] == [mesh.name for mesh in face.meshes]
    for name, mesh in scene.geometry.items():
        assert np.abs(mesh.vertices - expected[name]).max() < 1e-5 * face.head_height * face.meters_per_unit
        assert turned(mesh.faces) == exported(glb, name)


def test_the_template_and_other_poses_are_asked_for_by_name() -> None:
    slider = Slider(name="jaw", shapes=(("jawOpen", 1.0),))
    face = Face.from_parts(person(replace(tiny_face(), sliders=(slider,))))
    at_rest = face.to_trimesh("rest").geometry["Head"].vertices
    assert (at_rest == face.split(face.evaluate())["Head"] * face.meters_per_unit).all()
    assert np.abs(face.to_trimesh().geometry["Head"].vertices - at_rest).max() > 1e-3 * face.meters_per_unit
    with pytest.raises(InputError, match="nobody"):
        face.to_trimesh("nobody")


def test_display_colours_come_along_and_files_of_trimesh_hold_the_surface(tmp_path: Path) -> None:
    scene = Face.from_parts(mirrored_z_up()).to_trimesh()
    assert (scene.geometry["Head"].visual.vertex_colors == [137, 137, 137, 255]).all()  # sRGB of 0.25
    scene.export(tmp_path / "face.ply")
    back = trimesh.load_mesh(tmp_path / "face.ply", process=False)
    assert np.allclose(back.area, sum(mesh.area for mesh in scene.geometry.values()), rtol=1e-5)
