"""Skinning of unusual faces, sources and joints: usable weights, a warning, or one line."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import failed
from faces import grid_mesh
from skin_joints import TWO, bare, changed, head, retopologised, skinned, weights_of, without_joints

from facepipe.core.errors import FacepipeError, InputError
from facepipe.geometry.gradient_system import cotangent_weights
from facepipe.geometry.warp import fit_warp
from facepipe.parts import FaceParts, Landmarks, Mesh, Skin
from facepipe.stage import Face, save_parts
from facepipe.verbs.skin import JointSet, JointSpec, SkinFace
from facepipe.verbs.skin.surface import surface_of

Array = np.ndarray[Any, Any]


def flattened(mesh: Mesh) -> Mesh:
    """Every fiftieth face squeezed into a point."""
    points, starts = mesh.points.copy(), np.cumsum(mesh.face_vertex_counts) - mesh.face_vertex_counts
    for start in starts[::50]:
        corners = mesh.face_vertex_indices[start : start + 3]
        points[corners] = points[corners[0]]
    return replace(mesh, points=points)


def test_triangles_without_area_are_skinned_over() -> None:
    skinned(changed(bare(), flattened), SkinFace(joints=TWO))
    skinned(changed(bare(), flattened), SkinFace(source=Face.from_parts(retopologised(head("sample")))))
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        weights = cotangent_weights(line, np.array([[0, 1, 2], [0, 1, 3], [1, 2, 3], [1, 1, 2]]))[1]
    assert np.isfinite(weights).all()


def test_points_of_no_face_change_nothing_else() -> None:
    def more(mesh: Mesh) -> Mesh:
        points = np.concatenate([mesh.points, np.full((4, 3), 1e7)])
        return Mesh(
            name=mesh.name,
            points=points,
            face_vertex_counts=mesh.face_vertex_counts,
            face_vertex_indices=mesh.face_vertex_indices,
            landmarks=mesh.landmarks,
        )

    with_strays = skinned(changed(bare(), more), SkinFace(joints=TWO))[1]
    without = skinned(bare(), SkinFace(joints=TWO))[1]
    count = len(bare().meshes[0].points)
    np.testing.assert_allclose(with_strays[:count], without[:count], atol=1e-6)
    with pytest.raises(InputError, match="mm from the face"):  # strays don't stretch it
        skinned(changed(bare(), more), SkinFace(joints=JointSet(joints=(JointSpec(path="a", position=(1e5, 0, 0)),))))


@pytest.mark.parametrize("scales", [(0, 0, 0), (1, 0, 0)])
def test_a_face_without_area_is_refused(scales: tuple[float, ...]) -> None:
    meshes = tuple(replace(mesh, points=mesh.points * scales) for mesh in bare().meshes)
    with pytest.raises(InputError, match="no triangle with an area"):
        SkinFace(joints=TWO)(Face.from_parts(replace(bare(), meshes=meshes)))


def test_the_part_with_triangles_is_the_face() -> None:
    edges = replace(
        grid_mesh("Wires", 6),
        face_vertex_counts=np.full(35, 2, np.int32),
        face_vertex_indices=np.repeat(np.arange(36), 2)[1:-1].astype(np.int32),
    )
    parts = FaceParts(name="Face", meshes=(edges, grid_mesh("Sheet", 4)))
    face = Face.from_parts(parts)
    assert surface_of(face.parts(), "x").inside.min() == len(edges.points)


def landmarks(change: Callable[[Array], Array]) -> FaceParts:
    def other(mesh: Mesh) -> Mesh:
        found = change(np.array(mesh.landmarks["multipie68"].indices))
        return replace(mesh, landmarks={"multipie68": Landmarks(indices=found.astype(np.int32))})

    return changed(bare(), other)


def mirrored(parts: FaceParts) -> FaceParts:
    return replace(parts, meshes=tuple(replace(mesh, points=mesh.points * [-1, 1, 1]) for mesh in parts.meshes))


def test_landmarks_that_are_none_are_refused() -> None:
    order = np.random.default_rng(0).permutation(68)
    for parts, message in (
        (landmarks(lambda old: old * 0), "all landmarks at one place"),
        (landmarks(lambda old: old[order]), "of their spread"),
        (mirrored(bare()), "from the face's right to its left"),
    ):
        with pytest.raises(InputError, match=message) as caught:
            SkinFace(source=Face.from_parts(retopologised(head("sample"))))(Face.from_parts(parts))
        assert "\n" not in str(caught.value)


def test_lips_that_share_their_landmarks_are_warped() -> None:
    def closed(old: Array) -> Array:
        old[[61, 62, 63]] = old[[67, 66, 65]]
        return old

    _, _, report = skinned(landmarks(closed), SkinFace(source=Face.from_parts(retopologised(head("sample")))))
    assert report.transfer is not None
    assert report.transfer.surface_mm["mean"] < 1.0
    source, target = np.random.default_rng(2).normal(scale=40, size=(2, 20, 3))
    source[3], target[3] = source[7], target[7]
    assert np.isfinite(fit_warp(source, target, 0.5).apply(source)).all()


def test_points_without_weights_in_the_source_go_with_its_root() -> None:
    def none(mesh: Mesh) -> Mesh:
        assert mesh.skin is not None
        return replace(mesh, skin=replace(mesh.skin, joint_weights=mesh.skin.joint_weights * 0))

    _, weights, report = skinned(bare(), SkinFace(source=Face.from_parts(changed(retopologised(head("sample")), none))))
    assert f"{len(bare().meshes[0].points)} points have no weights" in report.warnings[0]
    assert weights[: len(bare().meshes[0].points), 0].min() == pytest.approx(1)


def test_on_one_topology_points_keep_their_own_weights() -> None:
    """Another identity: bulged, turned, in other units, its meshes in another order."""
    source = head("sample")
    other = without_joints(replace(bare(), meters_per_unit=0.001, meshes=bare().meshes[::-1]))
    grown = tuple(replace(mesh, points=mesh.points * [9, 11, 10] + [0, 0, 20]) for mesh in other.meshes)
    face, weights, report = skinned(replace(other, meshes=grown), SkinFace(source=Face.from_parts(source)))
    assert report.transfer is not None
    assert report.transfer.same_topology
    assert report.transfer.surface_mm["max"] < 20.0
    start = np.cumsum([0, *(len(mesh.points) for mesh in source.meshes)])
    own = weights_of(Face.from_parts(source))
    expected = np.concatenate([own[a:b] for a, b in pairwise(start)][::-1])
    np.testing.assert_allclose(weights, expected, atol=1.1e-3)  # less than a thousandth is left out
    places = face.skeleton.bind_transforms[:, :3, 3]
    eye = face.skeleton.joints.index(next(name for name in face.skeleton.joints if name.endswith("eyeLeft")))
    np.testing.assert_allclose(
        places[eye], source.skeleton.bind_transforms[eye, :3, 3] * [9, 11, 10] + [0, 0, 20], atol=1.5
    )


def test_a_damaged_source_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = head("sample")
    binds = source.skeleton.bind_transforms.copy()
    binds[5, :3, :3] = 0
    save_parts(replace(source, skeleton=replace(source.skeleton, bind_transforms=binds)), tmp_path / "damaged.usdc")
    save_parts(bare(), tmp_path / "face.usdc")
    words = ["skin", str(tmp_path / "face.usdc"), "--from", str(tmp_path / "damaged.usdc")]
    assert "damaged.usdc" in failed(capsys, *words, "-o", tmp_path / "out.usda", folder=tmp_path)
    assert not (tmp_path / "out.usda").exists()


def test_many_loose_parts_take_the_joint_that_holds_them() -> None:
    rng = np.random.default_rng(0)
    points = head("sample").meshes[0].points
    roots = points[rng.integers(0, len(points), 200)] * 1.02
    quad = np.array([[0.0, 0, 0], [0.2, 0, 0], [0.2, 0.2, 0], [0, 0.2, 0]])
    cards = Mesh(
        name="Cards",
        points=(roots[:, None] + quad).reshape(-1, 3),
        face_vertex_counts=np.full(200, 4, np.int32),
        face_vertex_indices=np.arange(800, dtype=np.int32),
    )
    joint = head("sample").skeleton.joints.index("root/neck/head")
    skin = Skin(joint_indices=np.full((800, 1), joint, np.int32), joint_weights=np.ones((800, 1)))
    source = replace(head("sample"), meshes=(*head("sample").meshes, replace(cards, skin=skin)))
    weights = skinned(
        replace(bare(), meshes=(*bare().meshes, cards)), SkinFace(source=Face.from_parts(retopologised(source)))
    )[1]
    np.testing.assert_allclose(weights[-800:-4, joint], 1, atol=1e-6)  # the source lacks the last card


def test_options_of_another_way_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_parts(bare(), tmp_path / "face.usdc")
    (tmp_path / "joints.json").write_text(json.dumps({"joints": {"a": {"position": [0, 0, 0]}}}))
    words = ["skin", str(tmp_path / "face.usdc"), "--joints", str(tmp_path / "joints.json")]
    for flag in ("--smoothing", "--iterations", "--evenness"):
        err = failed(capsys, *words, flag, "1", "-o", tmp_path / "out.usda", folder=tmp_path)
        assert f"{flag}: given without" in err
    assert "expected one of .usd" in failed(capsys, *words, "-o", tmp_path / "out.txt", folder=tmp_path)
    with pytest.raises(FacepipeError, match="1025 joints, expected 1 to 1024"):
        JointSet(joints=tuple(JointSpec(path=f"a{i}", position=(0, 0, 0)) for i in range(1025)))
