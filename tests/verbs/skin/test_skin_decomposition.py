"""Weights refined for example shapes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from faces import grid_mesh, replace_mesh
from scipy.spatial.transform import Rotation
from skin_joints import HELD, head, landmark_joints, weights_of, without_joints

from facepipe.core.errors import InputError
from facepipe.geometry.polygons import edges
from facepipe.geometry.skin_decomposition import _Solver, decompose
from facepipe.parts import Blendshape, FaceParts
from facepipe.stage import Face
from facepipe.verbs.skin import JointSet, JointSpec, SkinFace, SkinOptions
from facepipe.verbs.skin.from_joints import from_joints
from facepipe.verbs.skin.surface import surface_of

Array = np.ndarray[Any, Any]


def examples(count: int = 6, joints: int = 3, seed: int = 0) -> tuple[Array, Array, Array, Array]:
    """Rest points, edges, the weights and shapes of rigid joints that move a sheet."""
    rng = np.random.default_rng(seed)
    mesh = grid_mesh(size=14)
    pairs = edges(mesh.face_vertex_counts, mesh.face_vertex_indices)[0]
    rest = mesh.points * 5.0
    places = rng.uniform(rest.min(axis=0), rest.max(axis=0), (joints, 3))
    weights = np.exp(-(np.linalg.norm(rest[:, None] - places, axis=2) ** 2) / 400.0)
    weights /= weights.sum(axis=1, keepdims=True)
    shapes = np.zeros((count, *rest.shape))
    for shape in shapes:
        for joint in range(joints):
            turn = Rotation.from_rotvec(rng.normal(scale=0.3, size=3)).as_matrix()
            shape += weights[:, joint, None] * ((rest - places[joint]) @ turn.T + places[joint] + rng.normal(size=3))
    return rest, pairs, weights, shapes


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_weights_of_rigid_joints_are_found_again(seed: int) -> None:
    rest, pairs, weights, shapes = examples(seed=seed)
    start = weights + np.random.default_rng(seed).uniform(0.05, 0.6, weights.shape)
    start /= start.sum(axis=1, keepdims=True)
    candidates = np.tile(np.arange(3), (len(rest), 1))
    found = decompose(rest, shapes, pairs, candidates, start, most=3, iterations=80, evenness=1e-6)
    rms = [float(np.sqrt((one**2).mean())) for one in (found.before, found.after)]
    assert rms[1] < 0.1 * rms[0]
    assert np.abs(found.weights.sum(axis=1) - 1).max() < 1e-9
    assert found.weights.min() >= 0


def test_what_fits_already_stays() -> None:
    rest, pairs, weights, shapes = examples()
    candidates = np.tile(np.arange(3), (len(rest), 1))
    found = decompose(rest, shapes, pairs, candidates, weights, most=3, iterations=5, evenness=0.3)
    assert found.after.max() <= found.before.max() + 1e-9
    assert np.sqrt((found.after**2).mean()) <= np.sqrt((found.before**2).mean())


@pytest.mark.parametrize("most", [1, 2])
def test_no_more_weights_than_wanted_and_none_that_was_forbidden(most: int) -> None:
    rest, pairs, weights, shapes = examples(joints=5)
    start = np.where(np.arange(5) == np.arange(len(rest))[:, None] % 5, 0.0, weights)
    start /= start.sum(axis=1, keepdims=True)
    candidates = np.tile(np.arange(5), (len(rest), 1))
    found = decompose(rest, shapes, pairs, candidates, start, most=most, iterations=4, evenness=0.3).weights
    assert (found > 0).sum(axis=1).max() <= most
    assert not found[start == 0].any()
    np.testing.assert_allclose(found.sum(axis=1), 1)


def test_more_evenness_is_smoother() -> None:
    rest, pairs, weights, shapes = examples()
    shapes = shapes + np.random.default_rng(1).normal(scale=2.0, size=shapes.shape)
    candidates = np.tile(np.arange(3), (len(rest), 1))
    rough = []
    for evenness in (1e-4, 1.0):
        found = decompose(rest, shapes, pairs, candidates, weights, most=3, iterations=5, evenness=evenness).weights
        away = found[pairs[:, 0]] - found[pairs[:, 1]] - weights[pairs[:, 0]] + weights[pairs[:, 1]]
        rough.append(np.abs(away).mean())
    assert rough[1] < 0.8 * rough[0]


@pytest.mark.slow
def test_the_joints_come_nearer_to_the_shapes_of_a_face() -> None:
    options = SkinOptions(iterations=4)
    plain, face = (Face.from_parts(without_joints(head("sample"))) for _ in range(2))
    joints = landmark_joints(face, HELD["sample"])
    SkinFace(joints=joints, options=options)(plain)
    report = SkinFace(joints=joints, options=options, optimise=True)(face)
    again = Face(face.stage)
    assert report.fit is not None
    assert report.fit.shapes == 52
    assert report.fit.rms_after_mm < 0.8 * report.fit.rms_before_mm
    np.testing.assert_array_equal(again.skeleton.bind_transforms, Face(plain.stage).skeleton.bind_transforms)
    weights = weights_of(again)
    assert (weights > 0).sum(axis=1).max() <= 4
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
    assert report.largest_step_per_mm < 0.8
    whole = from_joints(face.parts(), surface_of(face.parts(), "x"), joints, options)
    group = surface_of(face.parts(), "x").group
    assert not weights[whole.weights[group] == 0].any()  # so that nothing crosses the lips that did not before


def test_a_joint_does_not_turn_about_a_line_of_points() -> None:
    """What points on a line say nothing of stays as it was."""
    line = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    weights = np.ones((3, 1))
    shapes = line[None] + np.array([0.0, 0.5, 0.0])
    solver = _Solver(line, shapes, np.zeros((0, 2), int), np.zeros((3, 1), int), weights, 1.0)
    solver.fit_transforms(weights)
    np.testing.assert_allclose(solver._R[0, 0], np.eye(3), atol=1e-9)
    np.testing.assert_allclose(solver._t[0, 0], [0.0, 0.5, 0.0], atol=1e-9)


def test_errors_are_millimetres_over_the_points_that_shapes_move() -> None:
    """A joint that can't follow: the sheet gets a tenth larger about its middle, which moves all points but one."""
    mesh = grid_mesh(size=3)
    ways = 0.1 * (mesh.points - mesh.points.mean(axis=0))
    moved = np.linalg.norm(ways, axis=1) > 0
    grown = Blendshape(name="grown", point_indices=np.flatnonzero(moved), offsets=ways[moved])
    parts = FaceParts(name="Sheet", meshes=(replace_mesh(mesh, blendshapes=(grown,)),), meters_per_unit=0.01)
    joints = JointSet(joints=(JointSpec(path="a", position=(0, 0, 0)),))
    report = SkinFace(joints=joints, optimise=True, options=SkinOptions(iterations=1))(Face.from_parts(parts)).fit
    assert report is not None
    expected = 10.0 * np.linalg.norm(ways[moved], axis=1)
    assert (report.shapes, report.points) == (1, 8)
    for rms, largest in ((report.rms_before_mm, report.max_before_mm), (report.rms_after_mm, report.max_after_mm)):
        assert rms == pytest.approx(np.sqrt((expected**2).mean()), rel=1e-5)
        assert largest == pytest.approx(expected.max(), rel=1e-5)


def test_without_shapes_there_is_nothing_to_optimise_for() -> None:
    face = Face.from_parts(FaceParts(name="Sheet", meshes=(grid_mesh(),)))
    joints = JointSet(joints=(JointSpec(path="a", position=(0, 0, 0)),))
    with pytest.raises(InputError, match="no blendshapes to optimise for"):
        SkinFace(joints=joints, optimise=True)(face)
