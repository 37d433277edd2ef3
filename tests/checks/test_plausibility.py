"""Faces of a size or a stance that no head has: what says so, what mends it, and real heads that are left alone."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import exit_code
from facepipe_gltf import read as gltf
from faces import with_meshes
from import_data import shared
from small_head import make

import facepipe
from facepipe.checks import validate
from facepipe.importers import load
from facepipe.parts import FaceParts, Mesh, Skeleton
from facepipe.rig import implausible
from facepipe.stage import save_parts


@pytest.fixture(scope="module")
def sample() -> FaceParts:
    """The sample's meshes alone, without what moves them."""
    meshes = with_meshes(make(), skin=None, blendshapes=(), material=None, material_faces=()).meshes
    return FaceParts(name="sample", meshes=meshes, skeleton=Skeleton())


def turned(parts: FaceParts, axes: str, up_axis: str = "Y") -> FaceParts:
    """The face with its points along other axes: ``+x-z+y`` says what its x, y and z become."""
    rows = [("xyz".index(axes[i + 1]), -1.0 if axes[i] == "-" else 1.0) for i in (0, 2, 4)]

    def own(mesh: Mesh) -> Mesh:
        points = np.empty_like(mesh.points)
        for i, (to, sign) in enumerate(rows):
            points[:, to] = sign * mesh.points[:, i]
        return replace(mesh, points=points)

    return replace(parts, meshes=tuple(map(own, parts.meshes)), up_axis=up_axis)  # type: ignore[arg-type]


def with_mesh(parts: FaceParts, height: float, below: float) -> FaceParts:
    """The face with a box as wide as high under it, of stage units."""
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), np.float32).reshape(3, -1).T * height / 2
    box = Mesh(
        name="Body",
        points=(corners - (0, height / 2 + below, 0)).astype(np.float32),
        face_vertex_counts=np.array([3], np.int32),
        face_vertex_indices=np.arange(3, dtype=np.int32),
    )
    return replace(parts, meshes=(*parts.meshes, box))


def bare(parts: FaceParts) -> FaceParts:
    """The face without landmarks."""
    return with_meshes(parts, landmarks={})


def avatar(height: float, up: str = "Y", long: float = 1.0) -> FaceParts:
    """A body with joints, `height` metres from sole to crown before `up` is applied, hair and all.

    :param up: the axis that it stands along; its stage says Y
    :param long: times as high a skull and hair as a person has
    """
    places = {"Hips": 0.53, "Hips/Spine": 0.6, "Hips/Spine/Neck": 0.83, "Hips/Spine/Neck/Head": 0.87}
    points = np.random.default_rng(0).uniform((-0.25, 0, -0.09), (0.25, 0.87, 0.09), (60, 3))
    skull = np.random.default_rng(1).uniform((-0.05, 0.85, -0.06), (0.05, 0.87 + 0.13 * long, 0.06), (60, 3))
    crown = np.array([[0, 0.87 + 0.13 * long, 0], [0, 0, 0]])
    to = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) if up == "Z" else np.eye(3)
    world = np.tile(np.eye(4), (4, 1, 1))
    for i, y in enumerate(places.values()):
        world[i, :3, 3] = to @ (0, y * height, 0)
    rest = world.copy()
    rest[1:] = np.linalg.inv(world[:-1]) @ world[1:]
    body = Mesh(
        name="Body",
        points=(np.concatenate([points, skull, crown]) * height @ to.T).astype(np.float32),
        face_vertex_counts=np.array([3], np.int32),
        face_vertex_indices=np.arange(3, dtype=np.int32),
    )
    skeleton = Skeleton(joints=tuple(places), bind_transforms=world, rest_transforms=rest)
    return FaceParts(name="avatar", meshes=(body,), skeleton=skeleton, meters_per_unit=1.0)


BODIES: dict[str, tuple[FaceParts, str]] = {
    "a person": (avatar(1.74), ""),
    "a child": (avatar(0.9), ""),
    "a chibi with hair": (avatar(0.9, long=2.5), ""),
    "174 m": (avatar(174.0), "the head is 22.6 m high above its joint, expected 150 to 400 mm; `facepipe import` with"),
    "174 m, what is offered": (avatar(174.0), "--meters-per-unit 0.01 fixes"),
    "a doll": (avatar(0.0174), "--meters-per-unit 100 fixes"),
    "lying down": (
        avatar(1.74, "Z"),
        "the body doesn't stand upright: its head lies +Z of the hips, expected +Y; `facepipe import` with --up-axis Z",
    ),
    "without joints": (replace(avatar(1.74), skeleton=Skeleton()), ""),
    "174 m without joints": (
        replace(avatar(174.0), skeleton=Skeleton()),
        "the model is 174 m long, expected a head, or a body of at most 3 m; `facepipe import` with "
        "--meters-per-unit 0.01 fixes",
    ),
}


@pytest.mark.parametrize("name", BODIES)
def test_the_head_of_a_body_is_measured_not_its_box(name: str) -> None:
    body, expected = BODIES[name]
    lines = implausible(body)
    assert len(lines) == (1 if expected else 0), lines
    assert all(expected in line for line in lines)


HEADS: dict[str, tuple[Callable[[FaceParts], FaceParts], str]] = {
    "as it is": (lambda face: face, ""),
    "Z up": (lambda face: turned(face, "+x+z-y", "Z"), ""),
    "a child": (lambda face: replace(face, meters_per_unit=0.0075), ""),
    "with shoulders": (lambda face: with_mesh(face, 40, 10), ""),
    "with a body": (lambda face: with_mesh(face, 160, 10), ""),
    "without landmarks": (bare, ""),
    "a plane": (lambda face: bare(replace(face, meters_per_unit=1.0, meshes=(flat(face.meshes[0]),))), ""),
    "nothing": (lambda face: replace(face, meshes=()), ""),
    "metres for centimetres": (lambda face: replace(face, meters_per_unit=1.0), "m high by its landmarks"),
    "inches for metres": (lambda face: replace(face, meters_per_unit=0.01 * 0.0254), "mm high by its landmarks"),
    "without landmarks, in metres": (lambda face: bare(replace(face, meters_per_unit=1.0)), "m high, expected"),
    "Z up for Y up": (lambda face: replace(face, up_axis="Z"), "with --up-axis Y"),
    "Y up for Z up": (lambda face: turned(face, "+x+z-y"), "with --up-axis Z"),
    "lying on a cheek": (
        lambda face: turned(face, "+y-x+z"),
        "eyes lie -X of the chin, expected +Y; turning",
    ),
    "upside down": (lambda face: turned(face, "-x-y+z"), "eyes lie -Y of the chin"),
    "looking back": (lambda face: turned(face, "-x+y-z"), "looks along -Z, expected +Z"),
    "looking aside": (lambda face: turned(face, "-z+y+x"), "looks along +X, expected +Z"),
    "looking back, Z up": (lambda face: turned(face, "-x+z+y", "Z"), "looks along +Y, expected -Y"),
}


def flat(mesh: Mesh) -> Mesh:
    """The mesh pressed to a plane."""
    return replace(mesh, points=mesh.points * np.float32([1, 1, 0]))


@pytest.mark.parametrize("name", HEADS)
def test_what_no_head_shows(sample: FaceParts, name: str) -> None:
    change, expected = HEADS[name]
    lines = implausible(change(sample))
    assert len(lines) == (1 if expected else 0), lines
    assert all(expected in line for line in lines)


def test_the_unit_that_is_offered_makes_a_head(sample: FaceParts) -> None:
    for unit in (1.0, 10.0, 0.00001):
        (line,) = implausible(replace(sample, meters_per_unit=unit))
        offered = line.partition("--meters-per-unit ")[2].partition(" ")[0]
        assert implausible(replace(sample, meters_per_unit=float(offered))) == ()
        assert offered == "0.01"
    assert "--meters-per-unit fixes" in implausible(replace(sample, meters_per_unit=0.3048))[0]


def test_inspect_validate_and_export_say_it(
    sample: FaceParts, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(tmp_path / "big.usda")
    save_parts(replace(sample, meters_per_unit=1.0), file)
    (line,) = implausible(facepipe.open(file).parts())
    assert exit_code("inspect", file, "--json") == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["warnings"] == [line]
    assert line in said.err
    assert exit_code("export", file, "-o", tmp_path / "big.glb", "--json") == 0
    said = capsys.readouterr()
    assert line in json.loads(said.out)["warnings"]
    assert line in said.err
    assert [one.message for one in validate(file) if one.check == "facepipe:Plausible"] == [line]


@pytest.mark.parametrize("kind", ["usd", "gltf"])
def test_import_takes_the_unit_and_the_axis_it_is_given(sample: FaceParts, tmp_path: Path, kind: str) -> None:
    save_parts(turned(replace(sample, meters_per_unit=1.0), "+x+z-y"), tmp_path / "face.usda")
    source = tmp_path / ("face.usda" if kind == "usd" else "face.glb")
    if kind == "gltf":
        assert exit_code("export", tmp_path / "face.usda", "-o", source) == 0
    words = ["import", kind, str(source), str(tmp_path / "out.usda"), "--meters-per-unit", "0.01", "--up-axis", "Z"]
    assert exit_code(*words) == 0
    face, before = facepipe.open(tmp_path / "out.usda"), facepipe.open(tmp_path / "face.usda")
    assert (face.meters_per_unit, face.up_axis) == (0.01, "Z")
    assert implausible(face.parts()) == ()
    np.testing.assert_allclose(np.ptp(face.evaluate(), axis=0), np.ptp(before.evaluate(), axis=0), rtol=1e-5)
    assert exit_code(*words[:3], tmp_path / "bad.usda", "--meters-per-unit", "0") == 2
    assert not (tmp_path / "bad.usda").exists()


@pytest.mark.slow
def test_real_heads_are_left_alone() -> None:
    for kind, file in (("ict", "ict_facekit/ict_facekit.npz"), ("makehuman", "makehuman/makehuman_head.npz")):
        assert implausible(load(kind, shared(file)).parts) == ()
    scan = shared("scans/LeePerrySmith.glb")  # head and shoulders in a unit that it doesn't state
    assert implausible(load("gltf", scan, gltf.Options(meters_per_unit=0.04)).parts) == ()
    assert "7.95 m high" in implausible(load("gltf", scan).parts)[0]
