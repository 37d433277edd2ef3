"""Blends of heads as they come: of other topologies, formats and programs."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import small_head
from command_line import Capsys, done, failed
from faces import replace_mesh
from small_sources import WORDS, made
from small_sources import points as points_of

import facepipe
from facepipe.exporting import export
from facepipe.geometry.similarity import fit_similarity
from facepipe.heads import make
from facepipe.importers import read_face
from facepipe.parts import Blendshape, FaceParts
from facepipe.performing import again
from facepipe.stage import save_parts
from facepipe.verbs.blend import BlendFaces
from facepipe.verbs.whole_faces import whole_face, whole_points

PERSON = 3


def test_a_face_from_an_export_is_of_its_topology(folder: Path) -> None:
    export("b.usda", "b.glb")
    plain = facepipe.blend(["a.usda", "b.usda"], out="plain.usda")
    report = facepipe.blend(["a.usda", "b.glb"], out="c.usda")
    assert (plain.conformed, report.conformed) == ({}, {})
    np.testing.assert_allclose(points_of("c.usda"), points_of("plain.usda"), atol=1e-5)


def test_names_of_meshes_do_not_matter_where_their_faces_tell(folder: Path) -> None:
    parts = made(1)
    save_parts(parts, Path("named.usda"))
    other = tuple(replace_mesh(mesh, name=f"{mesh.name}_mesh") for mesh in reversed(parts.meshes))
    save_parts(dataclasses.replace(parts, meshes=other), Path("swapped.usda"))
    facepipe.blend(["a.usda", "named.usda"], out="c.usda")
    report = facepipe.blend(["a.usda", "swapped.usda"], out="d.usda")
    assert report.conformed == {}
    np.testing.assert_array_equal(points_of("d.usda"), points_of("c.usda"))


def test_a_blend_can_be_an_export_that_is_not_edited(folder: Path, capsys: Capsys) -> None:
    done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    done(capsys, "blend", "a.usda", "b.usda", "-o", "c.glb", *WORDS)
    np.testing.assert_allclose(read_face("c.glb").evaluate(), points_of("c.usda"), atol=1e-5)
    message = failed(capsys, "blend", "--edit", "c.glb", "--default", "1,0", "-o", "d.usda")
    assert "c.glb: suffix '.glb', expected one of .usd" in message


def test_landmarks_beside_sources_are_kept_in_the_recipe(folder: Path) -> None:
    Path("b.landmarks.json").write_text("{}")
    facepipe.blend(["a.usda", "b.usda"], out="c.usda")
    recipe = facepipe.open("c.usda").parts().recipe
    assert recipe is not None
    assert recipe.sources == ("./a.usda", "./b.usda", "./b.landmarks.json")


def with_half(parts: FaceParts) -> FaceParts:
    """The face with shapes of half the motion."""

    def halved(shape: Blendshape) -> Blendshape:
        return dataclasses.replace(shape, offsets=0.5 * np.asarray(shape.offsets), inbetweens=())

    meshes = (
        replace_mesh(mesh, blendshapes=tuple(halved(shape) for shape in mesh.blendshapes)) for mesh in parts.meshes
    )
    return dataclasses.replace(parts, meshes=tuple(meshes))


@pytest.mark.slow
def test_a_head_of_another_topology_gives_its_shape_and_shapes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mesh of the first becomes a person who is known on that mesh, and who opens the jaw by half."""
    monkeypatch.chdir(tmp_path)
    save_parts(small_head.lean(small_head.make(), "jawOpen"), tmp_path / "first.usda")
    save_parts(small_head.lean(with_half(make(PERSON)), "jawOpen"), tmp_path / "person.usda")
    export("person.usda", "person.glb")
    words = {"sources": ("first.usda", "person.glb"), "weights": {"default": [0, 1]}, "align": "none"}
    report = facepipe.blend(**words, out="c.usda")
    assert list(report.conformed) == ["person.glb"]
    assert report.conformed["person.glb"].mean_mm < 0.2
    assert any("person.glb" in line and "takes its shape" in line for line in report.warnings)
    first, found = (facepipe.open(name).parts() for name in ("first.usda", "c.usda"))
    assert [mesh.name for mesh in found.meshes] == [mesh.name for mesh in first.meshes]
    assert found.shapes == ("jawOpen",)
    truth = whole_points(small_head.make(PERSON))
    points = whole_points(found)  # with the anchor where the first has it
    off = np.linalg.norm(fit_similarity(points, truth, scale=False).apply(points) - truth, axis=1)
    apart = np.linalg.norm(whole_points(first) - truth, axis=1)
    assert off.mean() < 0.5 * apart.mean()
    assert report.conformed["person.glb"].shapes == ("jawOpen",)
    half = 0.5 * whole_face(small_head.make(PERSON), "truth").deltas["jawOpen"]
    off, moves = (np.linalg.norm(one, axis=1) for one in (whole_face(found, "c").deltas["jawOpen"] - half, half))
    assert off[moves > 0.3].mean() < 0.15 * moves[moves > 0.3].mean()
    before = Path("c.usda").read_bytes()
    again(Path("c.usda"), BlendFaces)
    assert Path("c.usda").read_bytes() == before


@pytest.mark.slow
def test_a_first_head_of_another_program_gets_what_it_lacks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    bare = small_head.lean(small_head.make())
    meshes = tuple(replace_mesh(mesh, regions={}) for mesh in bare.meshes)
    save_parts(dataclasses.replace(bare, meshes=meshes, sliders=()), tmp_path / "bare.usda")
    save_parts(small_head.lean(make(PERSON), "jawOpen"), tmp_path / "person.usda")
    report = facepipe.blend(["bare.usda", "person.usda"], out="c.glb", weights={"mouth": [0, 1], "default": [1, 0]})
    assert any(line.startswith("bare.usda: has no shapes, no regions: made") for line in report.warnings)
    found = read_face("c.glb").parts()
    assert {"jawOpen", "eyeBlinkLeft", "mouthSmileRight"} <= {*found.shapes}
    moved = np.linalg.norm(whole_points(found) - whole_points(bare), axis=1)
    mouth = np.concatenate([mesh.regions["mouth"] for mesh in found.meshes])
    assert moved[mouth > 0.9].mean() > 4 * moved[mouth < 0.01].mean()
