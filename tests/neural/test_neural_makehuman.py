"""A neural rig of a real head in an engine: the Khronos validator, three.js, and the points of its own graph."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from facepipe_onnx import Deformer, Options, export_parts, validate
from gltf_export import Writing, limited, motion, writing, written
from gltf_reader import Gltf
from import_data import SHARED, shared
from neural_graphs import TOLERANCE, Made, asked, skinned
from neural_rig_teacher import HEAD, Teacher, teacher
from node import node_packages, three_load
from with_torch import torch

from facepipe.neural import (
    Motion,
    SampleMotionOptions,
    TrainNeuralRig,
    TrainNeuralRigOptions,
    with_neural_rig,
)
from facepipe.verbs.whole_faces import MILLIMETRES, world_to_world

__all__ = ["torch", "writing", "written"]

pytestmark = [pytest.mark.needs_torch, pytest.mark.gate, pytest.mark.slow]

QUICK = TrainNeuralRigOptions(shapes=24, width=32, steps=200)


@pytest.fixture(scope="module")
def taught() -> tuple[Teacher, Motion]:
    shared(HEAD)
    first = teacher(SHARED)
    few = tuple(limited(mesh, 4) for mesh in first.parts.meshes)  # as many influences as the GLB holds
    first = replace(first, parts=replace(first.parts, meshes=few))
    return first, first.motion(SampleMotionOptions(spread=200, sweep=3, together=60))


@pytest.fixture(scope="module", params=["bones", "points"])
def made(
    request: pytest.FixtureRequest, taught: tuple[Teacher, Motion], tmp_path_factory: pytest.TempPathFactory
) -> Made:
    first, frames = taught
    if request.param == "points":
        frames = replace(frames, bones=None, coefficients=None)
    rig = TrainNeuralRig(options=QUICK)(frames).rig
    parts, folder, graphs = with_neural_rig(first.parts, rig, "head"), tmp_path_factory.mktemp("graphs"), []
    for points in (False, True):
        path = folder / f"{points}.onnx"
        export_parts(parts, path, Options(sliders=True, points=points))
        assert validate(path) == ()
        graphs.append(Deformer(path))
    return Made(parts, rig, *graphs)


def poses(one: Made, count: int) -> np.ndarray:
    """(count, c) values, most controls far from their defaults."""
    return np.asarray(np.random.default_rng(4).random((count, len(one.rig.controls))))


def test_skinned_by_gltf_is_the_graph_of_points(made: Made, writing: Writing) -> None:
    glb, _ = writing(made.parts)
    to = world_to_world(made.parts.meters_per_unit, made.parts.up_axis, MILLIMETRES)
    worst, moved = 0.0, 0.0
    for row in poses(made, 6):
        points = made.points.evaluate(sliders=made.fed(row))["points"] @ to[:3, :3].T
        engine = 1e3 * skinned(made, glb, made.matrices.evaluate(sliders=made.fed(row)))
        worst, moved = max(worst, np.abs(engine - points).max()), max(moved, np.abs(points - made.rig.rest).max())
    assert moved > 0.02 * made.height
    assert worst < TOLERANCE * made.height


def test_three_deforms_it_as_our_evaluator(made: Made, writing: Writing) -> None:
    node_packages()
    glb, report = writing(made.parts)
    (row,) = poses(made, 1)
    found = made.matrices.evaluate(sliders=made.fed(row))
    expected, start = skinned(made, glb, found), 0
    shown = three_load(report.path, *asked(made.parts, glb, made.matrices, found))
    answer = {mesh["name"]: mesh for mesh in shown["meshes"]}
    assert list(answer) == [mesh.name for mesh in made.parts.meshes]
    for mesh in made.parts.meshes:
        own = expected[start + np.array(answer[mesh.name]["points"], int)]
        start += len(mesh.points)
        assert 1e3 * np.abs(np.array(answer[mesh.name]["positions"]) - own).max() < TOLERANCE * made.height


def test_a_quantised_file_is_within_the_error_that_is_reported(made: Made, writing: Writing) -> None:
    files, sizes, bound = [], [], 0.0
    for quantize in (False, True):
        glb, report = writing(made.parts, f"{quantize}.glb", quantize=quantize)
        files, sizes, bound = [*files, glb], [*sizes, report.bytes], report.error_mm or 0.0
    assert sizes[1] < 0.75 * sizes[0]
    for row in poses(made, 3):
        found = made.matrices.evaluate(sliders=made.fed(row))
        plain, small = (posed(made, glb, found) for glb in files)
        off = 1e3 * np.linalg.norm(small - plain, axis=1)
        assert 0.0 < off.max() < 2.0 * bound  # bones scale what it is of the face at rest


def posed(one: Made, glb: Gltf, found: dict[str, np.ndarray]) -> np.ndarray:
    """(n, 3) metres of joints that move by the graph's coefficients, and targets by its weights."""
    weights, _ = asked(one.parts, glb, one.matrices, found)
    meshes = [mesh.name for mesh in one.parts.meshes]
    activations = {name: np.array([weights[target] for target in glb.targets(name)]) for name in meshes}
    motions = motion(one.parts, glb, found["coefficients"]) if "coefficients" in found else None
    points = glb.evaluate(motion=motions, target_weights=activations)
    return np.concatenate([points[name] for name in meshes])
