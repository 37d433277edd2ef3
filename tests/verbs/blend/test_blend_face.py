"""The blended face as a whole: its rig, what it carries over, and what is exported from it."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import agreement
import facepipe_gltf
import facepipe_onnx
import node
import numpy as np
import pytest
from blend_faces import (
    REGION_WEIGHTS,
    blended,
    by_region,
    head,
    head_height,
    kinds,
    livelier,
    misaligned,
    only_shapes,
    same,
    session,
    steady,
    weighted,
)
from oracle import bake_all, random_coefficients
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from small_head import make

import facepipe
from facepipe.checks import validate
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.parts import Skeleton
from facepipe.rig import build, matrix_coefficients
from facepipe.rig.animation import local_transforms
from facepipe.stage import Face, save_parts
from facepipe.verbs.blend import Blend, BlendSession, Weights

RIGGED = ("sample", "makehuman")
RANGE_MM = 0.2  # joints leave the range of their distances by no more than this, or by 5% of the distance
RANGE_SHARE = 0.05


@functools.cache
def by_features(kind: str) -> Face:
    """Misaligned sources blended by region, on a stage."""
    return blended(session(kind, 2, "misaligned"), by_region("features"))


def places(skeleton: Skeleton) -> np.ndarray:
    return np.asarray(skeleton.bind_transforms)[:, :3, 3]


@kinds(*RIGGED)
@pytest.mark.parametrize("weights", [(0.3, 0.7), (0.2, 0.3, 0.5)], ids=str)
def test_joints_move_with_the_weighted_mean(kind: str, weights: tuple[float, ...]) -> None:
    """By the very translation of the points; joints in eyeballs, which keep their shape, stay at their middle."""
    blend = session(kind, len(weights), "neutral")
    result = blended(blend, Weights(default=weights))
    joints = weighted(np.array(weights), np.stack([places(face.skeleton) for face in blend.faces]))
    points = weighted(np.array(weights), blend.sources.points)
    free = np.setdiff1d(np.arange(len(points)), blend.kept.points)
    bridges = blend.graph.joint_bridges
    following = np.isin(np.arange(len(joints)), bridges.followers[np.isin(bridges.leaders, blend.kept.points)])
    moved_by = places(result.skeleton) - joints
    off = np.concatenate([moved_by[~following], (build(result.parts()).points - points)[free]])
    steady(off, 1e-6 * head_height(blend))
    same(moved_by[following], np.broadcast_to(off[0], (following.sum(), 3)), 1e-5 * head_height(blend))


@kinds(*RIGGED)
@pytest.mark.parametrize("variant", ["neutral", "misaligned neutral"])
@pytest.mark.parametrize("name", REGION_WEIGHTS)
def test_joints_keep_their_distances_to_the_points_around_them(kind: str, name: str, variant: str) -> None:
    """The mean distance to the 16 nearest points lies in the range of the sources', give or take a little."""
    blend = session(kind, 2, variant)
    neutral, own = blend.neutral(by_region(name)), blend.joint_worlds[:, :, :3, 3]
    nearest = cKDTree(blend.sources.points.mean(axis=0)).query(own.mean(axis=0), k=16)[1]

    def distances(points: np.ndarray, joints: np.ndarray) -> np.ndarray:
        spread = np.linalg.norm(points[nearest] - joints[:, None], axis=2).mean(axis=1)
        return np.asarray(spread * blend.sources.mm_per_unit)

    sources = np.stack([distances(*one) for one in zip(blend.sources.points, own, strict=True)])
    found = distances(neutral.points, neutral.joints)
    beyond = np.maximum(found - sources.max(axis=0), sources.min(axis=0) - found)
    assert (beyond <= np.maximum(RANGE_MM, RANGE_SHARE * sources.mean(axis=0))).all()


@kinds(*RIGGED)
def test_rest_is_the_bind_pose_where_it_was(kind: str) -> None:
    for face in (*session(kind, 2, "misaligned").faces, by_features(kind)):
        same(face.evaluate(), build(face.parts()).points, 1e-5 * face.head_height)


@kinds(*RIGGED)
def test_orientations_lie_between_those_of_the_sources(kind: str) -> None:
    """On the arc from one to the other, in the same order as the weights."""
    blend = session(kind, 2, "misaligned neutral")

    def turns(face: Face) -> Rotation:
        return Rotation.from_matrix(np.asarray(face.skeleton.bind_transforms)[:, :3, :3])

    first, second = map(turns, blend.faces)
    whole = (first.inv() * second).magnitude()
    assert whole.max() > 0.01
    before = np.zeros(len(whole))
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        own = turns(blended(blend, Weights(default=(1 - share, share))))
        there, rest = (first.inv() * own).magnitude(), (own.inv() * second).magnitude()
        np.testing.assert_allclose(there + rest, whole, atol=1e-5)
        assert (there >= before - 1e-6).all()
        before = there
    np.testing.assert_allclose(before, whole, atol=1e-5)


@kinds(*RIGGED)
def test_bone_coefficients_of_clips_stay(kind: str) -> None:
    """Relative to rest every pose unit and clip says the same as in the base."""
    base, result = session(kind, 2, "misaligned").faces[0], by_features(kind)
    assert [animation.name for animation in result.animations] == [animation.name for animation in base.animations]
    compared = 0
    for old, new in zip(base.animations, result.animations, strict=True):
        assert (old.joints, old.shapes) == (new.joints, new.shapes)
        if old.joints:
            numbers = [base.skeleton.joints.index(joint) for joint in old.joints]
            relative = [
                np.linalg.inv(np.asarray(face.skeleton.rest_transforms)[numbers]) @ local_transforms(face.skeleton, one)
                for face, one in ((base, old), (result, new))
            ]
            np.testing.assert_allclose(matrix_coefficients(relative[1]), matrix_coefficients(relative[0]), atol=2e-5)
            compared += 1
    assert compared > 1


@kinds(*RIGGED)
def test_what_does_not_depend_on_form_is_carried_over(kind: str) -> None:
    base, result = session(kind, 2, "misaligned").faces[0].parts(), by_features(kind).parts()
    assert result.sliders == base.sliders
    assert result.materials == base.materials
    assert result.skeleton.joints == base.skeleton.joints
    assert (result.bone_limits is None) == (base.bone_limits is None)
    if base.bone_limits is not None and result.bone_limits is not None:
        np.testing.assert_array_equal(result.bone_limits.upper, base.bone_limits.upper)
        np.testing.assert_array_equal(result.bone_limits.lower, base.bone_limits.lower)
    for own, old in zip(result.meshes, base.meshes, strict=True):
        assert (own.name, own.anchor, own.material) == (old.name, old.anchor, old.material)
        assert [blendshape.name for blendshape in own.blendshapes] == [
            blendshape.name for blendshape in old.blendshapes
        ]
        pairs = [(own.face_vertex_indices, old.face_vertex_indices)]
        pairs += [(own.regions[name], old.regions[name]) for name in old.regions]
        pairs += [(own.point_subsets[name], old.point_subsets[name]) for name in old.point_subsets]
        pairs += [(own.landmarks[name].indices, old.landmarks[name].indices) for name in old.landmarks]
        pairs += [(one.values, two.values) for one, two in zip(own.uv_sets, old.uv_sets, strict=True)]
        assert own.skin is not None
        assert old.skin is not None
        pairs.append((own.skin.geom_bind_transform, old.skin.geom_bind_transform))
        for one, two in pairs:
            np.testing.assert_array_equal(one, two)


def test_skin_weights_are_blended_where_sources_differ() -> None:
    """Dense weights are the weighted sum of the sources', with as many influences as these have."""
    blend = session("sample", 2, "neutral")
    result = blended(blend, Weights(default=(0.5, 0.5)))
    own, *sources = (face.rig().influences.toarray() for face in (result, *blend.faces))
    mean = 0.5 * (sources[0] + sources[1])
    fits = (mean > 0).sum(axis=1) <= 4
    assert fits.mean() > 0.5
    np.testing.assert_allclose(own[fits], mean[fits], atol=1e-6)
    np.testing.assert_allclose(own.sum(axis=1), 1.0, atol=1e-6)


def test_normals_of_the_result_are_those_of_its_points() -> None:
    """Normals and normal offsets: the sample has both, and they are unit and point as the surface does."""
    result = by_features("sample")
    for mesh in result.meshes:
        if mesh.name != "Head" or mesh.normals is None:
            continue
        triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
        surface = point_normals(np.asarray(mesh.points, np.float64), triangles)
        rows = surface if len(mesh.normals) == len(surface) else surface[mesh.face_vertex_indices]
        cosines = (np.asarray(mesh.normals) * rows).sum(axis=1)
        assert np.percentile(cosines, 1) > np.cos(np.radians(10))
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)
        shape = next(blendshape for blendshape in mesh.blendshapes if blendshape.name == "jawOpen")
        posed = np.array(mesh.points, np.float64)
        posed[shape.point_indices] += shape.offsets
        expected = (point_normals(posed, triangles) - surface)[shape.point_indices]
        assert shape.normal_offsets is not None
        np.testing.assert_allclose(shape.normal_offsets, expected, atol=1e-4)


@kinds(*RIGGED)
def test_usdskel_deforms_the_result_as_the_rig_does(kind: str) -> None:
    face, rng = by_features(kind), np.random.default_rng(7)
    joints = len(face.skeleton.joints)
    poses = [({name: 1.0}, np.tile(np.repeat([0.0, 0.0, 1.0], 3), (joints, 1))) for name in face.shapes[:5]]
    poses += [({}, random_coefficients(rng, joints, 10.0 / face.mm_per_unit)) for _ in range(5)]
    local = [(weights, face.rig().local_transforms(own)) for weights, own in poses]
    expected = np.stack([face.evaluate(weights, coefficients=own) for weights, own in poses])
    assert np.ptp(expected, axis=0).max() > 0.01 * face.head_height
    assert np.linalg.norm(bake_all(face, local) - expected, axis=2).max() <= 1e-5 * face.head_height


@kinds(pytest.param("sample", marks=pytest.mark.slow), pytest.param("ict", marks=pytest.mark.slow), "makehuman")
def test_the_result_is_an_override_layer_that_validates_and_exports(kind: str, tmp_path: Path) -> None:
    """No finding on the stage, the GLB and the ONNX, and none of the Khronos validator."""
    for number in range(2):
        parts = make(number + 1) if kind == "sample" else head(kind, number)
        save_parts(misaligned(livelier(parts)) if number else parts, tmp_path / f"{number}.usdc")
    sources = [facepipe.open(tmp_path / f"{number}.usdc") for number in range(2)]
    blend = BlendSession(sources)
    with sources[0].deriving(tmp_path / "out.usda") as face:
        report = Blend(weights=by_region("features"))(face, blend)
    assert report.authored
    result = facepipe.open(tmp_path / "out.usda")
    assert validate(tmp_path / "out.usda") == ()
    facepipe_gltf.export(result, tmp_path / "out.glb", facepipe_gltf.Options())
    facepipe_onnx.export(result, tmp_path / "out.onnx", facepipe_onnx.Options())
    for name in ("out.glb", "out.onnx"):
        assert [one for one in validate(tmp_path / name) if one.severity != "info"] == []
    issues = node.validate([tmp_path / "out.glb"])[tmp_path / "out.glb"]["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0)
    posed = build(replace(result.parts(), sliders=())).points
    same(posed, blend.neutral(by_region("features")).points, 1e-6 * result.head_height)
    residual = result.primvar("facepipe:seamResidual")
    assert residual.shape == (len(posed),)


@pytest.mark.parametrize(
    "kind", ["sample", pytest.param("ict", marks=pytest.mark.slow), pytest.param("makehuman", marks=pytest.mark.slow)]
)
def test_glb_and_onnx_of_the_result_agree_with_the_rig(kind: str, tmp_path: Path) -> None:
    """The checks of `agreement`: UsdSkel, GLB, onnxruntime and the Khronos validator, every shape and pose."""
    parts = agreement.limited(by_features(kind).parts(), agreement.INFLUENCES)
    face = agreement.saved(parts, tmp_path / "face.usdc")
    poses = agreement.poses_of(face)
    points = np.stack([face.evaluate(pose.weights, coefficients=pose.coefficients) for pose in poses])
    judged = agreement.Judged(face, poses, points, tmp_path)
    agreement.rig_is_usdskel(judged)
    agreement.glb_read_back_is_the_rig(judged)
    agreement.onnx_is_the_rig(judged)


@kinds("sample", "ict")
def test_a_session_gives_for_other_weights_what_a_fresh_one_does(kind: str) -> None:
    parts = [only_shapes(head(kind, number), "jawOpen", "mouthSmileLeft", "eyeBlinkLeft") for number in range(2)]
    faces = [Face.from_parts(parts[0]), Face.from_parts(misaligned(livelier(parts[1])))]
    blend = BlendSession(faces)
    for name in REGION_WEIGHTS:
        blend.solve(by_region(name))
    again = blend.solve(by_region("features"))
    fresh = BlendSession(faces).solve(by_region("features"))
    np.testing.assert_array_equal(again.neutral.points, fresh.neutral.points)
    np.testing.assert_array_equal(again.neutral.joints, fresh.neutral.joints)
    for sculpt, one, two in zip(again.sculpts, again.offsets, fresh.offsets, strict=True):
        np.testing.assert_array_equal(one, two, err_msg=sculpt.name)
