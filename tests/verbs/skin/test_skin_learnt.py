"""Joints that are learnt from faces bring the average face to people that they were not learnt from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import Capsys, done, failed
from database_faces import person
from faces import grid_mesh, with_meshes
from import_data import arrays, shared
from scipy.spatial.transform import Rotation
from skin_joints import weights_of, without_joints

import facepipe
from facepipe.importers import makehuman
from facepipe.parts import FaceParts, Skeleton
from facepipe.rig.identity_joints import IdentityJoints, joint_ways
from facepipe.stage import Face, save_parts
from facepipe.verbs.skin import JointSet, JointSpec, SkinFace, SkinOptions
from facepipe.verbs.whole_faces import Topology, whole_points

_SIDE, _MM = 16, 6.0
_TURNED = np.array([[1.0, 0, 0, 3], [0, 0, -1, 2], [0, 1, 0, 1], [0, 0, 0, 1]])  # a skeleton's transform


def sheet() -> FaceParts:
    """A bent sheet of 90 mm in centimetres, Z up, below a skeleton that is turned."""
    mesh = grid_mesh(size=_SIDE)
    points = _MM * mesh.points
    points[:, 2] = 0.02 * points[:, 0] ** 2
    bent = replace(mesh, points=points / 10.0, uv_sets=())
    return FaceParts(
        name="Sheet", meters_per_unit=0.01, up_axis="Z", meshes=(bent,), skeleton=Skeleton(transform=_TURNED)
    )


def people(count: int, seed: int) -> list[FaceParts]:
    """The sheet as others have it: by nine known joints, larger or smaller, turned, and elsewhere."""
    base = sheet()
    rest, random = whole_points(base), np.random.default_rng(seed)
    places = rest[[_SIDE * row + column for row in (3, 8, 13) for column in (3, 8, 13)]]
    close = np.exp(-(((rest[:, None] - places) ** 2).sum(axis=2)) / (2 * 15.0**2))
    indices = np.argsort(-close, axis=1)[:, :4]
    weights = np.take_along_axis(close, indices, axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    joints = IdentityJoints(rows=np.arange(len(rest)), points=rest, places=places, indices=indices, weights=weights)
    found = []
    for _ in range(count):
        coefficients = np.tile(np.repeat([0.0, 0.0, 1.0], 3), (9, 1))
        coefficients += random.normal(0, np.repeat([1.5, 0.08, 0.08], 3), coefficients.shape)
        turn = Rotation.from_rotvec(random.normal(0, 0.1, 3)).as_matrix()
        points = random.uniform(0.9, 1.1) * (rest + joints.offsets(coefficients)) @ turn.T + random.normal(0, 20, 3)
        found.append(Topology.of(base).parts(points))  # in millimetres, Y up
    return found


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_parts(sheet(), tmp_path / "face.usda")
    for number, one in enumerate(people(16, 0)):
        save_parts(one, tmp_path / f"person{number}.usda")
    save_parts(people(1, 1)[0], tmp_path / "unseen.usda")
    return tmp_path


def lines(folder: Path) -> list[object]:
    return [word for number in range(16) for word in ("--learn-from", folder / f"person{number}.usda")]


def test_bones_come_to_a_person_that_they_were_not_learnt_from(folder: Path, capsys: Capsys) -> None:
    out, fitted = folder / "out.usda", folder / "fitted.usda"
    said = done(capsys, "skin", folder / "face.usda", *lines(folder), "--count", "9", "-o", out)
    assert "learnt from 16 faces" in said
    face = facepipe.open(out)
    assert len(face.skeleton.joints) == 10
    assert (weights_of(face) > 0).sum(axis=1).max() <= 4
    np.testing.assert_allclose(face.evaluate(), facepipe.open(folder / "face.usda").evaluate(), atol=1e-5)
    report = facepipe.fit_bones(out, targets=(str(folder / "unseen.usda"),), out=fitted)
    (target,) = report.targets.values()
    assert target.before.mean_mm > 20.0
    assert target.distances.mean_mm < 0.5


def test_limits_are_what_the_examples_need(folder: Path, capsys: Capsys) -> None:
    """A person that was learnt from stays within; scales of a tenth and turns of a radian are none of them."""
    out = folder / "out.usda"
    done(capsys, "skin", folder / "face.usda", *lines(folder), "--count", "9", "-o", out)
    limits = facepipe.open(out).parts().bone_limits
    assert limits is not None
    rest = np.repeat([0.0, 0.0, 1.0], 3)
    assert ((limits.lower <= rest) & (rest <= limits.upper)).all()
    assert (limits.upper[1:] - limits.lower[1:] > 0).all()
    assert limits.lower[:, 6:].min() > 0.2
    assert np.abs(limits.upper[:, 3:6]).max() < 1.0
    report = facepipe.fit_bones(out, targets=(str(folder / "person3.usda"),), out=folder / "fitted.usda")
    (target,) = report.targets.values()
    assert target.distances.mean_mm < 0.5


def test_a_database_teaches_what_its_faces_do(tmp_path: Path, capsys: Capsys) -> None:
    faces = [with_meshes(person(seed), blendshapes=()) for seed in range(6)]
    for number, one in enumerate(faces):
        save_parts(one, tmp_path / f"p{number}.usda")
    paths = [tmp_path / f"p{number}.usda" for number in range(6)]
    done(capsys, "database", "create", *paths[1:], "-o", tmp_path / "faces.fpdb", quiet=False)
    words = ("skin", paths[0], "--count", "4", "--influences", "2")
    done(capsys, *words, "--learn-from", tmp_path / "faces.fpdb", "-o", tmp_path / "one.usda")
    stages = [word for path in paths[1:] for word in ("--learn-from", path)]
    done(capsys, *words, *stages, "-o", tmp_path / "other.usda")
    one, other = (weights_of(facepipe.open(tmp_path / f"{name}.usda")) for name in ("one", "other"))
    np.testing.assert_allclose(one, other, atol=1e-3)


def test_a_recipe_learns_again_from_faces_that_changed(folder: Path, capsys: Capsys) -> None:
    (folder / "facepipe.toml").touch()
    out = folder / "out.usda"
    words = ("--learn-from", folder / "person0.usda", "--learn-from", folder / "person1.usda", "--count", "3")
    done(capsys, "skin", folder / "face.usda", *words, "-o", out)
    before = weights_of(facepipe.open(out))
    save_parts(people(1, 7)[0], folder / "person1.usda")
    done(capsys, "cook", out, "--force", quiet=False)
    assert np.abs(weights_of(facepipe.open(out)) - before).max() > 0.01
    done(capsys, "skin", "--edit", out, "--count", "5", "--force")
    assert len(facepipe.open(out).skeleton.joints) == 6


@pytest.mark.slow
def test_people_of_makehuman_are_nearer_than_by_as_many_joints_that_are_placed() -> None:
    """By least squares over all channels, people who are not learnt from."""
    path = shared("makehuman/makehuman_head.npz")
    names = [str(name) for name in arrays("makehuman/makehuman_head.npz")["target_names"]]
    names = [name for name in names if not name.startswith(("macro", "expression", "asym"))]

    def somebody(seed: int) -> FaceParts:
        random = np.random.default_rng(seed)
        chosen = random.choice(names, 60, replace=False)
        targets = {str(name): float(random.uniform(0, 0.6)) for name in chosen}
        made = makehuman.read(path, makehuman.Options(targets=targets)).parts
        return Topology.of(made).parts(whole_points(made))

    base = without_joints(makehuman.read(path, makehuman.Options()).parts)
    base = replace(with_meshes(base, blendshapes=(), material=None, material_faces=()), materials=())
    rest, options = whole_points(base), SkinOptions(count=30)
    places = rest[:1]
    for _ in range(29):  # as far from each other as they can be
        away = np.linalg.norm(rest[:, None] - places, axis=2).min(axis=1)
        places = np.vstack([places, rest[away.argmax()]])
    specs = tuple(JointSpec(path=f"joint{number}", position=tuple(map(float, at))) for number, at in enumerate(places))
    ways = (
        SkinFace(examples={str(seed): somebody(seed) for seed in range(16)}, options=options),
        SkinFace(joints=JointSet(joints=specs, unit="mm"), options=options),
    )
    offsets = np.array([whole_points(somebody(seed)) - rest for seed in range(100, 104)]).reshape(4, -1).T
    left = []
    for way in ways:
        face = Face.from_parts(base)
        way(face)
        face = Face(face.stage)
        weights = weights_of(face)
        indices = np.argsort(-weights, axis=1, kind="stable")[:, :4]
        at = face.skeleton.bind_transforms[:, :3, 3] * 1000.0 * base.meters_per_unit
        moves = joint_ways(rest, at, indices, np.take_along_axis(weights, indices, axis=1)).toarray()
        off = (offsets - moves @ np.linalg.lstsq(moves, offsets, rcond=None)[0]).T.reshape(4, -1, 3)
        left.append(np.linalg.norm(off, axis=2).mean())
    assert left[0] < 0.75 * left[1]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((), "expected one of them (--joints, --from, --learn-from)"),
        (("--learn-from", "face.usda"), "all faces are as the face itself, expected some that differ"),
        (("--learn-from", "person1.usda", "--joints", "j.json"), "expected one of them (--joints, --from, --learn-"),
        (("--learn-from", "person1.usda", "--optimise"), "--optimise: given with --learn-from, expected only one"),
        (("--from", "person1.usda", "--count", "3"), "--count: given without --learn-from, expected both or neither"),
        (("--learn-from", "other.usda"), "other.usda -> Head: 36 points, expected 256 as in the face"),
        (("--learn-from", "large.usda"), "large.usda: 10 times as large as the face, expected at most 4 (is its m"),
        (("--learn-from", "a.fpdb", "--learn-from", "b.fpdb"), "a database among 2 files, expected it alone"),
        (("--learn-from", "person1.usda", "--count", "0"), "option count: is 0, expected a number from 1 to 255"),
    ],
)
def test_what_nothing_can_be_learnt_from_is_refused(
    folder: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], expected: str
) -> None:
    monkeypatch.chdir(folder)
    save_parts(replace(sheet(), meshes=(grid_mesh(),)), folder / "other.usda")
    save_parts(replace(sheet(), meters_per_unit=0.1), folder / "large.usda")
    assert expected in failed(capsys, "skin", "face.usda", *words, "-o", "out.usda", folder=folder)
