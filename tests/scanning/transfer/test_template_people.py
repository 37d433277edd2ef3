"""Faces of other topologies as templates: how people differ is known on them, and heads take their shapes and mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_head
from command_line import done, failed
from scipy.spatial.transform import Rotation
from solids import ball

import facepipe
from facepipe.core.errors import InputError
from facepipe.heads import make
from facepipe.importers import read_face
from facepipe.parts import FaceParts, Mesh
from facepipe.scanning.rebuild.template import Template
from facepipe.scanning.transfer.marks import with_landmarks
from facepipe.scanning.transfer.people import check_place, people_of, people_on
from facepipe.stage import save_parts
from facepipe.verbs.whole_faces import whole_face, whole_points

Capsys = pytest.CaptureFixture[str]
PERSON = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`template.usda`, of another topology than the built-in head, `plain.usda`, the same without landmarks, and a
    person's `head.usda` without shapes."""
    folder = tmp_path_factory.mktemp("people")
    template = small_head.lean(small_head.make(), "jawOpen")
    save_parts(template, folder / "template.usda")
    save_parts(_plain(template), folder / "plain.usda")
    save_parts(small_head.lean(make(PERSON)), folder / "head.usda")
    return folder


@pytest.mark.slow
def test_people_on_another_topology_are_people() -> None:
    template = Template.of(small_head.make(), "small head")
    identity = people_on(template).identity
    assert identity.mean.shape == template.points.shape
    skin = template.rows[template.face]
    people = np.stack([whole_points(small_head.make(seed)) for seed in (1, 2, PERSON)])
    shown = np.stack([identity.points(identity.coefficients(person)) for person in people])
    off, apart = (np.linalg.norm((one - people)[:, skin], axis=2).mean() for one in (shown, template.points))
    assert off < 0.2 * apart  # 0.8 mm, of people 3 to 7 mm from the template


@pytest.mark.slow
@pytest.mark.parametrize("name", ["template.usda", "plain.usda"])
def test_a_head_takes_the_shapes_of_a_template_of_another_topology(folder: Path, tmp_path: Path, name: str) -> None:
    """They are those of the template but for a factor, as other people's faces are larger or smaller."""
    report = facepipe.transfer(head=folder / "head.usda", template=folder / name, out=tmp_path / "out.usda")
    lines = [line for line in report.warnings if "plain.usda: has no multipie68 landmarks: found on it" in line]
    assert len(lines) == (name == "plain.usda")
    found = whole_face(read_face(tmp_path / "out.usda").parts(), "found").deltas
    assert list(found) == ["jawOpen"]
    truth = whole_face(make(PERSON), "truth").deltas["jawOpen"]
    moves = np.linalg.norm(truth, axis=1)
    larger = np.sum(found["jawOpen"] * truth) / np.sum(truth**2)
    assert 0.85 < larger < 1.15
    off = np.linalg.norm(found["jawOpen"] - larger * truth, axis=1)
    assert off[moves > 0.3].mean() < 0.1 * larger * moves[moves > 0.3].mean()


@pytest.mark.slow
def test_a_template_of_another_topology_takes_the_shape_of_a_head(folder: Path, capsys: Capsys) -> None:
    words = ("conform", folder / "head.usda", "--template", folder / "template.usda", "-o", folder / "conformed.usda")
    done(capsys, *words, quiet=False)
    found, template = (read_face(folder / name).parts() for name in ("conformed.usda", "template.usda"))
    assert [mesh.name for mesh in found.meshes] == [mesh.name for mesh in template.meshes]
    for mesh, before in zip(found.meshes, template.meshes, strict=True):
        np.testing.assert_array_equal(mesh.face_vertex_indices, before.face_vertex_indices)
    off = np.linalg.norm(whole_points(found) - whole_points(small_head.make(PERSON)), axis=1)
    apart = np.linalg.norm(whole_points(template) - whole_points(small_head.make(PERSON)), axis=1)
    assert off.mean() < 0.5 * apart.mean()


@pytest.mark.slow
def test_landmarks_that_a_template_lacks_are_found() -> None:
    parts = small_head.lean(small_head.make(PERSON))
    assert with_landmarks(parts, "head") == (parts, ())
    found, notes = with_landmarks(_plain(parts), "plain")
    assert notes[0].startswith("plain: has no multipie68 landmarks: found on it")
    truth, marks = (whole_points(one)[_marks(one)] for one in (parts, found))
    assert len(np.unique(_marks(found))) == 68
    assert np.linalg.norm(marks - truth, axis=1).mean() < 2.0  # mm: edges of this mesh are 6


def _turned(parts: FaceParts, degrees: float, times: float = 1.0) -> FaceParts:
    """The face turned about the line between its ears, and larger, all of it."""
    turn = np.eye(4)
    turn[:3, :3] = times * Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    meshes = tuple(replace(mesh, transform=turn @ mesh.transform) for mesh in parts.meshes)
    return replace(parts, meshes=meshes, skeleton=replace(parts.skeleton, transform=turn @ parts.skeleton.transform))


@pytest.mark.parametrize("make_head", [small_head.make, make])
def test_a_template_is_upright_and_of_the_size_of_people(make_head: Callable[[], FaceParts]) -> None:
    parts = small_head.lean(make_head())
    with pytest.raises(InputError, match=r"^head: its face is turned by 90 degrees, expected upright"):
        people_of(Template.of(_turned(parts, 90.0), "head"))
    with pytest.raises(InputError, match=r"its face is 0.01 times as large as people's, expected 0.5 to 2"):
        people_of(Template.of(_turned(parts, 0.0, 0.01), "head"))


@pytest.mark.parametrize(("verb", "flag"), [("transfer", "--from"), ("conform", "--template")])
def test_a_template_is_in_its_unit(verb: str, flag: str, tmp_path: Path, capsys: Capsys) -> None:
    parts = small_head.lean(small_head.make())
    save_parts(parts, tmp_path / "head.usda")
    save_parts(replace(parts, meters_per_unit=1.0), tmp_path / "metres.usda")
    words = (verb, tmp_path / "head.usda", flag, tmp_path / "metres.usda", "-o", tmp_path / "out.usda")
    line = failed(capsys, *words, folder=tmp_path)
    assert "metres.usda -> metersPerUnit: its face is 100 times as large as people's, expected 0.5 to 2" in line
    assert "a unit of 1000 mm may be wrong (it would be in cm)" in line


def test_a_template_may_look_down_and_be_a_child() -> None:
    parts = small_head.lean(small_head.make())
    marks = whole_points(parts)[_marks(parts)]
    check_place(Template.of(_turned(parts, 25.0, 0.7), "child"), marks)
    with pytest.raises(InputError, match="turned by 35 degrees"):
        check_place(Template.of(_turned(parts, 35.0), "child"), marks)


@pytest.mark.slow
@pytest.mark.parametrize(("verb", "flag"), [("transfer", "--from"), ("conform", "--template")])
def test_a_template_shows_a_face(verb: str, flag: str, tmp_path: Path, capsys: Capsys) -> None:
    save_parts(small_head.lean(small_head.make()), tmp_path / "head.usda")
    points, triangles = ball(12)
    mesh = Mesh(
        name="Ball",
        points=points,
        face_vertex_counts=np.full(len(triangles), 3, np.int32),
        face_vertex_indices=triangles.ravel().astype(np.int32),
    )
    save_parts(FaceParts(name="ball", meshes=(mesh,)), tmp_path / "ball.usda")
    words = (verb, tmp_path / "head.usda", flag, tmp_path / "ball.usda", "-o", tmp_path / "out.usda")
    assert "ball.usda: no face found on it" in failed(capsys, *words, folder=tmp_path)


def _plain(parts: FaceParts) -> FaceParts:
    return replace(parts, meshes=tuple(replace(mesh, landmarks={}) for mesh in parts.meshes))


def _marks(parts: FaceParts) -> np.ndarray:
    """(68,) whole points of the landmarks."""
    starts = np.cumsum([0, *(len(mesh.points) for mesh in parts.meshes)])
    (found,) = (
        start + mesh.landmarks["multipie68"].indices
        for start, mesh in zip(starts, parts.meshes, strict=False)
        if "multipie68" in mesh.landmarks
    )
    return np.asarray(found)
