"""A neutral authored over its template: points in any space, normals, shapes, joints and clips that fit them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scan_domes
from faces import tiny_face, with_head
from oracle import bake, difference

import facepipe
from facepipe.checks import validate
from facepipe.core.errors import FacepipeError, InputError, TopologyError
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.geometry.similarity import Similarity
from facepipe.parts import FaceParts, Mesh, Recipe
from facepipe.rig import build
from facepipe.stage import Face, save_parts
from facepipe.verbs.author_neutral import AuthorNeutral, AuthorNeutralReport, carried_skeleton
from facepipe.verbs.whole_faces import whole_face, whole_points

MOVE = Similarity(
    rotation=np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]]),
    translation=np.array([30.0, -20.0, 12.0]),
    scale=1.3,
)


def authored(
    parts: FaceParts, points: np.ndarray, folder: Path, **settings: object
) -> tuple[Face, AuthorNeutralReport]:
    """The face reopened from the layer over its template."""
    save_parts(parts, folder / "template.usda")
    with facepipe.open(folder / "template.usda").deriving(folder / "out.usda") as face:
        report = AuthorNeutral(**settings)(face, points, recipe=Recipe(verb="fit-neutral"))  # type: ignore[arg-type]
    return facepipe.open(folder / "out.usda"), report


def bent(points: np.ndarray) -> np.ndarray:
    """Points moved smoothly by up to some millimetres."""
    return points + 3.0 * np.sin(points[:, [1, 2, 0]] / 12.0 + [0.0, 1.0, 2.0])


def elsewhere(parts: FaceParts) -> FaceParts:
    """The same sort of face in metres, Z up, with meshes and skeleton in spaces of their own."""
    space = np.eye(4)
    space[:3, :3], space[:3, 3] = 0.01 * MOVE.scale * MOVE.rotation, (0.2, -0.1, 1.6)
    meshes = tuple(
        replace(
            mesh,
            transform=space,
            skin=mesh.skin and replace(mesh.skin, geom_bind_transform=space @ np.diag([0.7, 0.7, 0.7, 1.0])),
        )
        for mesh in parts.meshes
    )
    return replace(parts, meters_per_unit=1.0, up_axis="Z", meshes=meshes)


@pytest.mark.parametrize("parts", [scan_domes.face(), tiny_face(), elsewhere(tiny_face())])
def test_the_stage_reopens_with_the_points_that_were_put_in(parts: FaceParts, tmp_path: Path) -> None:
    points = bent(whole_points(parts))
    face, report = authored(parts, points, tmp_path)
    assert np.abs(whole_points(face.parts()) - points).max() < 2e-7 * np.abs(points).max() + 1e-5
    assert report.authored[-1] == "recipe"
    checks = [[one.check for one in validate(tmp_path / f"{name}.usda")] for name in ("out", "template")]
    assert checks[0] == checks[1]
    before, after = whole_face(parts, "a"), whole_face(face.parts(), "b")
    assert list(after.deltas) == list(before.deltas)
    for name, delta in before.deltas.items():
        assert np.allclose(after.deltas[name], delta, atol=1e-4)
    for field in ("sliders", "bone_limits", "materials", "attribution"):
        assert repr(getattr(face.parts(), field)) == repr(getattr(parts, field))


@pytest.mark.parametrize("parts", [scan_domes.face(), tiny_face()])
def test_skin_and_bind_pose_fit_the_new_points(parts: FaceParts, tmp_path: Path) -> None:
    points = bent(whole_points(parts))
    face, _ = authored(parts, points, tmp_path)
    assert difference(face, bake(face, {}), 0.1 * points) < 1e-5
    for old, new in zip(parts.meshes, face.parts().meshes, strict=True):
        if old.skin is not None and new.skin is not None:
            assert np.array_equal(new.skin.joint_indices, old.skin.joint_indices)
            assert np.allclose(new.skin.joint_weights, old.skin.joint_weights, atol=1e-6)


def test_what_moves_nothing_authors_nothing(tmp_path: Path) -> None:
    parts = scan_domes.face()
    save_parts(parts, tmp_path / "one.usda")
    stored = facepipe.open(tmp_path / "one.usda").parts()
    face, report = authored(stored, whole_points(stored), tmp_path)
    assert report.authored == ("recipe",)
    assert np.array_equal(face.parts().skeleton.bind_transforms, stored.skeleton.bind_transforms)


@pytest.mark.parametrize("parts", [scan_domes.face(), tiny_face()])
def test_joints_go_where_the_whole_face_goes(parts: FaceParts) -> None:
    rig = build(parts)
    moved = carried_skeleton(parts, MOVE.apply(rig.points))
    places = parts.skeleton.bind_transforms[:, :3, 3]
    assert np.allclose(moved.bind_transforms[:, :3, 3], MOVE.apply(places), atol=1e-9)
    assert np.allclose(moved.bind_transforms[:, :3, :3], parts.skeleton.bind_transforms[:, :3, :3], atol=1e-9)
    worlds = moved.rest_transforms.copy()
    for joint, parent in enumerate(moved.parents):
        worlds[joint] = worlds[parent] @ worlds[joint] if parent >= 0 else worlds[joint]
    assert np.allclose(worlds, moved.bind_transforms, atol=1e-9)  # the rest was the bind pose


def test_a_joint_goes_with_the_points_that_hang_at_it() -> None:
    parts = scan_domes.face()
    rig = build(parts)
    head = len(parts.meshes[0].points)
    points = rig.points.copy()
    points[head:] = MOVE.apply(points[head:])  # the eyeball alone
    moved = carried_skeleton(parts, points).bind_transforms[:, :3, 3]
    places = parts.skeleton.bind_transforms[:, :3, 3]
    assert np.allclose(moved[2], MOVE.apply(places[2]), atol=1e-9)
    assert np.allclose(moved[:2], places[:2], atol=1e-9)


def test_joints_without_points_go_with_the_face() -> None:
    parts = tiny_face()
    skin = parts.meshes[0].skin
    assert skin is not None
    held = replace(skin, joint_weights=np.tile([0.0, 1.0, 0.0], (len(skin.joint_weights), 1)).astype(np.float32))
    parts = with_head(parts, skin=held)
    moved = carried_skeleton(parts, MOVE.apply(build(parts).points))
    assert np.allclose(moved.bind_transforms[:, :3, 3], MOVE.apply(parts.skeleton.bind_transforms[:, :3, 3]))


def test_clips_stand_on_the_new_rest_pose(tmp_path: Path) -> None:
    parts = scan_domes.face()
    points = bent(whole_points(parts))
    face, _ = authored(parts, points, tmp_path)
    rest, moved = (face.evaluate(joint_transforms=face.sample("talk", index)[0]) for index in (0, 1))
    assert np.abs(10.0 * rest - points).max() < 1e-3
    lower = np.asarray(parts.meshes[0].skin.joint_weights)[:, 1]  # type: ignore[union-attr]
    expected = lower[:, None] * [0.0, -0.5, 0.0]
    assert np.allclose((moved - rest)[: len(lower)], expected, atol=1e-4)


def given(values: np.ndarray | None) -> np.ndarray:
    assert values is not None
    return values


def normals_of(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    found = point_normals(points, point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices))
    assert mesh.normals is not None
    return found if len(mesh.normals) == len(points) else found[mesh.face_vertex_indices]


def test_normals_follow_the_surface_and_keep_what_was_put_in_by_hand(tmp_path: Path) -> None:
    parts = scan_domes.face()
    face, _ = authored(parts, bent(whole_points(parts)), tmp_path)
    for mesh in face.parts().meshes:
        assert np.allclose(given(mesh.normals), normals_of(mesh, mesh.points), atol=2e-3)
    head = parts.meshes[0]
    assert head.normals is not None
    tilted = np.add(head.normals, [0.3, 0.0, 0.0])
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    by_hand = replace(parts, meshes=(replace(head, normals=tilted), *parts.meshes[1:]))
    face, _ = authored(by_hand, bent(whole_points(parts)), tmp_path)
    after = face.parts().meshes[0]
    assert np.allclose(np.linalg.norm(given(after.normals), axis=1), 1.0, atol=1e-5)
    assert np.mean((after.normals - normals_of(after, after.points))[:, 0]) > 0.15


def test_normal_offsets_are_those_of_the_new_surface(tmp_path: Path) -> None:
    parts = scan_domes.face()
    face, _ = authored(parts, bent(whole_points(parts)), tmp_path)
    mesh = face.parts().meshes[0]
    shape = next(blendshape for blendshape in mesh.blendshapes if blendshape.name == "jawOpen")
    opened = np.array(mesh.points, np.float64)
    opened[shape.point_indices] += shape.offsets
    expected = normals_of(mesh, opened) - normals_of(mesh, mesh.points)
    assert np.allclose(given(shape.normal_offsets), expected[shape.point_indices], atol=2e-3)
    assert [inbetween.name for inbetween in shape.inbetweens] == ["half"]


def test_shapes_can_be_given_anew(tmp_path: Path) -> None:
    parts = scan_domes.face()
    points = bent(whole_points(parts))
    delta = np.zeros_like(points)
    delta[40:90] = [0.5, -2.0, 0.3]
    delta[200] = 5e-5  # under 1e-4 mm
    wide = np.random.default_rng(1).normal(size=points.shape)
    shapes = {"jawOpen": delta, "smile": np.zeros_like(points), "wide": wide}
    face, report = authored(parts, points, tmp_path, shapes=shapes)
    found = whole_face(face.parts(), "out").deltas
    assert list(found) == ["jawOpen", "smile", "wide"]
    assert np.allclose(found["jawOpen"][40:90], delta[40:90], atol=1e-5)
    assert not found["jawOpen"][200].any()
    assert not found["smile"].any()
    assert np.allclose(found["wide"], wide, atol=1e-5)
    own = {shape.name: shape for shape in face.parts().meshes[0].blendshapes}
    assert own["jawOpen"].normal_offsets is not None
    assert own["wide"].normal_offsets is None
    assert len(own["smile"].point_indices) == 1
    assert own["jawOpen"].inbetweens == ()
    assert report.warnings == ("inbetweens of jawOpen are left out",)
    assert validate(tmp_path / "out.usda") == ()


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        (lambda points: points[:-1], TopologyError, "expected"),
        (lambda points: np.where(np.arange(len(points))[:, None] == 7, np.nan, points), InputError, "NaN"),
    ],
)
def test_points_that_do_not_fit_author_nothing(
    change: object, error: type[FacepipeError], text: str, tmp_path: Path
) -> None:
    parts = scan_domes.face()
    points = whole_points(parts)
    for own, shapes in ((change(points), {}), (points, {"jawOpen": change(points)})):  # type: ignore[operator]
        with pytest.raises(error, match=text) as message:
            authored(parts, own, tmp_path, shapes=shapes)
        assert "\n" not in str(message.value)
        assert not (tmp_path / "out.usda").exists()
