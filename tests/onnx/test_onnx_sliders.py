"""The graph of sliders: what it computes, against the rig, UsdSkel and the GLB."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import facepipe_gltf
import gltf_reader
import numpy as np
import pytest
from facepipe_onnx import Deformer, Options, export_parts, validate
from faces import tiny_face
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from oracle import bake_all
from slider_faces import BEND, jointless, makehuman_with_sliders, random_values, sample_with_sliders, without_scales

from facepipe.parts import FaceParts, Skeleton, Slider
from facepipe.rig import Rig, build, coefficient_matrices, slide
from facepipe.stage import Face

TOLERANCE = 1e-5
VECTORS = 100
FACES: dict[str, Callable[[], FaceParts]] = {"sample": sample_with_sliders, "makehuman": makehuman_with_sliders}


class Made(NamedTuple):
    parts: FaceParts
    face: Face
    rig: Rig
    graph: Deformer


def made(parts: FaceParts, folder: Path, **options: object) -> Made:
    path = folder / "sliders.onnx"
    export_parts(parts, path, Options(sliders=True, pose="rest", **options))  # type: ignore[arg-type]
    assert validate(path) == ()
    return Made(parts, Face.from_parts(parts), build(parts), Deformer(path))


def some_weights(rig: Rig, rng: np.random.Generator) -> dict[str, float]:
    """Shape weights in float32."""
    return {name: float(np.float32(rng.uniform(0, 0.5))) for name in rig.shapes[:12]}


def check(one: Made, values: dict[str, float], weights: dict[str, float], *, blend: bool = True) -> None:
    """Every output is the rig's under these sliders and weights; with `blend` also what a GPU makes of them."""
    height = one.face.head_height
    found = one.graph.evaluate(weights, sliders=values)
    coefficients, driven = slide(one.parts.sliders, one.rig.joints, values)
    total = {name: driven.get(name, 0.0) + weights.get(name, 0.0) for name in one.rig.shapes}
    if one.rig.joints:
        errors = np.abs(found["coefficients"] - coefficients).max(axis=0)
        assert errors[:3].max() < TOLERANCE * height
        assert errors[3:].max() < TOLERANCE
        matrices = one.rig.joint_worlds(one.rig.rest @ coefficient_matrices(coefficients)) @ one.rig.inverse_bind
        assert np.abs(found["skinning_matrices"] - matrices).max() < TOLERANCE * height
    if one.rig.shapes:
        activations = one.rig.activations(one.rig.weight_vector(total))
        assert np.abs(found["morph_weights"] - activations).max() < TOLERANCE
    expected = one.face.evaluate(weights, sliders=values)
    if "points" in found:
        assert np.abs(found["points"] - expected).max() < TOLERANCE * height
    if blend:
        assert np.abs(blended(one, found) - expected).max() < TOLERANCE * height


def blended(one: Made, found: dict[str, np.ndarray]) -> np.ndarray:
    """(n, 3) points as a GPU makes them of morph weights and skinning matrices."""
    points = one.rig.points
    if one.rig.targets:
        points = points + (one.rig.deltas @ found["morph_weights"].astype(np.float64)).reshape(-1, 3)
    own = one.rig.parent_world[None]
    matrices = found.get("skinning_matrices", np.zeros((0, 4, 4))).astype(np.float64)
    return one.rig.skin(points, np.concatenate([matrices, own]))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name == "makehuman" else name for name in FACES]
)
def test_agrees_with_the_rig(name: str, tmp_path: Path) -> None:
    one = made(FACES[name](), tmp_path, points=True)
    rng = np.random.default_rng(1)
    for number in range(VECTORS):
        check(one, random_values(one.parts, rng), some_weights(one.rig, rng), blend=number % 10 == 0)


@pytest.mark.parametrize("name", FACES)
def test_agrees_with_usdskel(name: str, tmp_path: Path) -> None:
    one = made(without_scales(FACES[name]()), tmp_path, points=True)
    rng = np.random.default_rng(2)
    poses, found = [], []
    for _ in range(VECTORS):
        values, weights = random_values(one.parts, rng), some_weights(one.rig, rng)
        found.append(one.graph.evaluate(weights, sliders=values)["points"])
        coefficients, driven = slide(one.parts.sliders, one.rig.joints, values)
        total = {name: driven.get(name, 0.0) + weights.get(name, 0.0) for name in one.rig.shapes}
        poses.append((total, one.rig.local_transforms(coefficients)))
    errors = np.linalg.norm(np.stack(found) - bake_all(one.face, poses), axis=-1)
    assert errors.max() < TOLERANCE * one.face.head_height


def test_values_not_given_are_those_of_the_face(tmp_path: Path) -> None:
    parts = tiny_face()
    sliders = (
        Slider(name="a", value=0.7, channels=(("root/jaw", "rx", 0.5),)),
        Slider(name="b", minimum=-1.0, default=0.25, shapes=(("jawOpen", 0.8),)),
    )
    one = made(replace(parts, sliders=sliders), tmp_path)
    check(one, {}, {})
    check(one, {"b": 0.5}, {"mouthSmileLeft": 0.4})
    assert one.graph.evaluate()["coefficients"][1, 3] == pytest.approx(0.35)


def test_far_beyond_the_range_is_exactly_its_end(tmp_path: Path) -> None:
    one = made(sample_with_sliders(), tmp_path)
    for end, far in (("minimum", -1e30), ("maximum", 1e30)):
        ends = {slider.name: getattr(slider, end) for slider in one.parts.sliders}
        at_end, beyond = one.graph.evaluate(sliders=ends), one.graph.evaluate(sliders=dict.fromkeys(ends, far))
        for name, values in at_end.items():
            assert np.array_equal(values, beyond[name])


grid = st.integers(-192, 192).map(lambda number: number / 64)  # exact in float32
knots = st.lists(st.tuples(grid, st.floats(-2, 2, width=32)), min_size=2, max_size=5, unique_by=lambda knot: knot[0])


def curved(curve: list[tuple[float, float]], low: float, high: float) -> FaceParts:
    """The tiny face with a slider that moves one channel by a curve, and one straight on."""
    slider = Slider(
        name="one",
        minimum=low,
        maximum=high,
        default=low,
        channels=(("root/jaw", "tx", 0.7), ("root", "ty", -0.4)),
        channel_curves=(tuple(curve), None),
    )
    return replace(tiny_face(), sliders=(slider, Slider(name="two", shapes=(("jawOpen", 1.0),))))


def curve_error(parts: FaceParts, values: list[float], folder: Path) -> float:
    """The largest difference of bone coefficients to the rig's."""
    export_parts(parts, folder / "sliders.onnx", Options(sliders=True))
    graph = Deformer(folder / "sliders.onnx")
    errors = []
    for value in values:
        rounded = float(np.float32(value))
        expected = slide(parts.sliders, parts.skeleton.joints, {"one": rounded})[0]
        errors.append(np.abs(graph.evaluate(sliders={"one": rounded})["coefficients"] - expected).max())
    return float(max(errors))


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(curve=knots, low=grid, reach=st.integers(16, 192), values=st.lists(st.floats(-7, 7), max_size=6))
def test_any_curve(
    curve: list[tuple[float, float]], low: float, reach: int, values: list[float], tmp_path: Path
) -> None:
    """Monotone curves with knots in and out of the range."""
    at, amounts = (sorted(column) for column in zip(*curve, strict=True))
    high = low + reach / 64
    parts = curved(list(zip(at, amounts, strict=True)), low, high)
    assert curve_error(parts, [*values, low, high, *at], tmp_path) < TOLERANCE


@pytest.mark.parametrize("width", [1e-2, 1e-4, 1e-6])
def test_steep_curves_stay_exact_beside_their_step(width: float, tmp_path: Path) -> None:
    curve = [(0.0, 0.0), (0.5, 0.1), (float(np.float32(0.5 + width)), 1.9), (1.0, 2.0)]
    values = [*np.linspace(-0.5, 0.5, 20), *np.linspace(0.5 + 2 * width, 1.5, 20)]
    assert curve_error(curved(curve, 0.0, 1.0), values, tmp_path) < TOLERANCE


def test_constants_of_curves_hold_joints_away_from_rest(tmp_path: Path) -> None:
    """A bias: what curves add at the default, or on both sides of it."""
    sliders = (
        Slider(name="bias", channels=(("root/jaw/lip", "tx", 1.0),), channel_curves=(((0.0, 0.4), (1.0, 0.4)),)),
        Slider(name="open", channels=(("root", "rx", 0.3),), channel_curves=(((0.0, 0.2), (1.0, 0.9)),)),
        Slider(name="still", minimum=0.5, maximum=0.5, default=0.5, channels=(("root/jaw", "sz", 0.2),)),
        Slider(
            name="down",
            minimum=-1.0,
            shapes=(("mouthSmileLeft", 0.5),),
            shape_curves=(((-1.0, 1.0), (0.0, 0.0)),),
        ),
    )
    one = made(replace(tiny_face(), sliders=sliders), tmp_path, points=True)
    rng = np.random.default_rng(3)
    for _ in range(10):
        check(one, random_values(one.parts, rng), some_weights(one.rig, rng))
    assert one.graph.evaluate()["coefficients"][2, 0] == pytest.approx(0.4)


@pytest.mark.parametrize("joints", [(), ("root",), ("root/jaw",), ("root/jaw/lip",), ("root", "root/jaw/lip")])
@pytest.mark.parametrize("parent", [False, True])
def test_joints_that_nothing_moves_are_constants(joints: tuple[str, ...], parent: bool, tmp_path: Path) -> None:
    """Whichever joints move; under a body joint where there is one."""
    sliders = tuple(Slider(name=f"s{i}", channels=((joint, "rz", 0.5),)) for i, joint in enumerate(joints))
    shapes = Slider(name="expression", shapes=(("jawOpen", 1.0),))
    one = made(replace(tiny_face(), sliders=(*sliders, shapes)), tmp_path, parent=parent, points=True)
    check(one, dict.fromkeys(one.graph.sliders, 0.8), {})
    if parent:
        body = np.eye(4)
        body[:3] = np.random.default_rng(4).normal(size=(3, 4))
        found = one.graph.evaluate(sliders=dict.fromkeys(one.graph.sliders, 0.8), parent=body)
        coefficients, weights = slide(one.parts.sliders, one.rig.joints, dict.fromkeys(one.graph.sliders, 0.8))
        worlds = one.rig.joint_worlds(one.rig.local_transforms(coefficients), body)
        assert np.abs(found["skinning_matrices"] - worlds @ one.rig.inverse_bind).max() < 1e-5
        expected = one.rig.evaluate(weights, coefficients=coefficients, parent_world=body)
        assert np.abs(found["points"] - expected).max() < TOLERANCE * one.face.head_height * np.abs(body).max()


def test_moving_fewer_joints_takes_a_smaller_graph(tmp_path: Path) -> None:
    parts = sample_with_sliders()
    sizes = []
    for kept in (len(parts.sliders), 2):
        report = export_parts(
            replace(parts, sliders=parts.sliders[:kept]), tmp_path / f"{kept}.onnx", Options(sliders=True)
        )
        sizes.append((report.counts["nodes"], report.bytes))
    assert sizes[1][0] <= sizes[0][0]
    assert sizes[1][1] < 0.7 * sizes[0][1]


@pytest.mark.parametrize("up_axis", ["Y", "Z"])
def test_drives_the_vertices_of_the_glb(up_axis: str, tmp_path: Path) -> None:
    """Skinning matrices and morph weights applied to what the GLB holds, by the recipe in the sidecar."""
    parts = tiny_face()
    turned = np.eye(4)
    turned[:3, :3] = [[0.0, -2.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 2.0]]
    turned[:3, 3] = (1.0, -2.0, 3.0)
    skeleton = replace(parts.skeleton, transform=turned)
    sliders = (
        Slider(name="jaw", channels=(("root/jaw", "rx", 0.5), ("root/jaw", "sy", 0.3)), channel_curves=(BEND, None)),
        Slider(name="smile", shapes=(("mouthSmileLeft", 0.7), ("jawOpen", 0.6))),
    )
    head = parts.meshes[0]
    turned_face = replace(parts, skeleton=skeleton, sliders=sliders, meshes=(head,), up_axis=up_axis)  # type: ignore[arg-type]
    one = made(turned_face, tmp_path)
    facepipe_gltf.export(one.face, tmp_path / "face.glb")
    glb = gltf_reader.read(tmp_path / "face.glb")
    outputs = {entry["name"]: entry for entry in one.graph.metadata["outputs"]}
    described = outputs["skinning_matrices"]
    for values in ({"jaw": 0.6, "smile": 0.9}, {"jaw": 1.0, "smile": 0.2}):
        found = one.graph.evaluate({"jawOpen": 0.1}, sliders=values)
        numbers = one.graph.metadata["meshes"][0]["targets"]
        names = [outputs["morph_weights"]["targets"][number]["name"] for number in numbers]
        assert names == glb.targets("Head")
        back = np.array(described["skeleton_from_gltf"])
        matrices = np.array(described["gltf_from_world"]) @ found["skinning_matrices"] @ back
        skin = glb.list("skins")[0]
        assert [path.rpartition("/")[2] for path in described["joints"]] == glb.joint_names()
        worlds = glb.worlds()
        worlds[skin["joints"]] = matrices @ np.linalg.inv(glb.decoded(skin["inverseBindMatrices"]))
        points = glb.evaluate(worlds=worlds, target_weights={"Head": found["morph_weights"][numbers]})["Head"]
        world = one.face.evaluate({"jawOpen": 0.1}, sliders=values)
        expected = world @ np.array(described["gltf_from_world"])[:3, :3].T
        assert np.abs(points - expected).max() < TOLERANCE * np.ptp(expected, axis=0).max()


def test_batch_is_the_vectors_one_by_one(tmp_path: Path) -> None:
    one = made(sample_with_sliders(), tmp_path, batch=3, points=True)
    rng = np.random.default_rng(5)
    values = [random_values(one.parts, rng) for _ in range(3)]
    rows = np.array([[row[name] for name in one.graph.sliders] for row in values])
    weights = rng.uniform(0, 0.5, (3, len(one.graph.shapes)))
    found = one.graph.run({"sliders": rows, "weights": weights})
    (tmp_path / "single").mkdir()
    single = made(one.parts, tmp_path / "single", points=True).graph
    for i in range(3):
        alone = single.run({"sliders": rows[i], "weights": weights[i]})
        for name, expected in alone.items():
            assert np.allclose(found[name][i], expected[0], atol=1e-4), name


def test_a_face_without_shapes(tmp_path: Path) -> None:
    parts = tiny_face()
    bare = tuple(replace(mesh, blendshapes=()) for mesh in parts.meshes)
    slider = Slider(name="jaw", channels=(("root/jaw", "rx", 0.5),))
    one = made(replace(parts, meshes=bare, sliders=(slider,)), tmp_path, points=True)
    assert one.graph.outputs == ("coefficients", "skinning_matrices", "points")
    check(one, {"jaw": 0.4}, {})


def test_skeleton_alone(tmp_path: Path) -> None:
    """Skinning matrices need no mesh."""
    parts = tiny_face()
    slider = Slider(name="jaw", channels=(("root/jaw", "rx", 0.5),))
    skeleton = Skeleton(
        joints=parts.skeleton.joints,
        bind_transforms=parts.skeleton.bind_transforms,
        rest_transforms=parts.skeleton.rest_transforms,
    )
    export_parts(FaceParts(skeleton=skeleton, sliders=(slider,)), tmp_path / "s.onnx", Options(sliders=True))
    found = Deformer(tmp_path / "s.onnx").evaluate(sliders={"jaw": 1.0})
    assert found["coefficients"][1, 3] == pytest.approx(0.5)


@pytest.mark.parametrize("points", [False, True])
@pytest.mark.parametrize("name", ["tiny", "sample"])
def test_a_face_without_joints(name: str, points: bool, tmp_path: Path) -> None:
    """Morph weights alone; a body joint can carry the points."""
    whole = tiny_face() if name == "tiny" else sample_with_sliders()
    parts = jointless(whole)
    moved = np.eye(4)
    moved[:3] = [[0.0, -2.0, 0.0, 1.0], [2.0, 0.0, 0.0, -2.0], [0.0, 0.0, 2.0, 3.0]]
    sliders = (
        Slider(
            name="smile", minimum=-1.0, shapes=(("mouthSmileLeft", 0.7), ("jawOpen", 0.6)), shape_curves=(BEND, None)
        ),
        Slider(name="open", default=0.2, shapes=(("jawOpen", 0.5),)),
    )
    parts = replace(parts, sliders=sliders, skeleton=Skeleton(transform=moved))
    one = made(parts, tmp_path, points=points)
    assert one.graph.outputs == ("morph_weights", *(("points",) if points else ()))
    assert one.graph.joints == ()
    rng = np.random.default_rng(6)
    for _ in range(10):
        check(one, random_values(parts, rng), some_weights(one.rig, rng))
    if points:
        carried = tmp_path / "carried"
        carried.mkdir()
        body = np.eye(4)
        body[:3] = rng.normal(size=(3, 4))
        values = random_values(parts, rng)
        found = made(parts, carried, points=True, parent=True).graph.evaluate(sliders=values, parent=body)["points"]
        expected = one.rig.evaluate(slide(sliders, (), values)[1], parent_world=body)
        assert np.abs(found - expected).max() < TOLERANCE * one.face.head_height * np.abs(body).max()
