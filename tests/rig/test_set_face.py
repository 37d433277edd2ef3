"""The face as it is set is what ships: the person becomes the rest, expressions play on top."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import facepipe_gltf
import facepipe_onnx
import gltf_reader
import numpy as np
import pytest
from command_line import done, exit_code, failed
from facepipe_onnx.runtime import Deformer
from faces import tiny_face
from oracle import bake, played
from small_head import make

import facepipe
from facepipe import heads
from facepipe.core.errors import InputError, TopologyError
from facepipe.parts import (
    Animation,
    Blendshape,
    BoneLimits,
    FaceParts,
    Inbetween,
    Mesh,
    PhotoView,
    Skeleton,
    Slider,
)
from facepipe.rig import (
    build,
    coefficient_matrices,
    person_of,
    rest_coefficients,
    sample_transforms,
    sample_weights,
    set_face,
    set_points,
    slide,
)
from facepipe.rig.set_error import SameMotion, Side, apart, apart_with_sliders, random_poses
from facepipe.rig.set_person import _rotations, set_mesh
from facepipe.stage import save_parts

Capsys = pytest.CaptureFixture[str]
TOLERANCE = 1e-5  # of the head height
EXACT = 2e-5  # stage units or mm: weights in float32 sum to 1 within 1e-7


def with_values(parts: FaceParts, values: dict[str, float]) -> FaceParts:
    known = {slider.name for slider in parts.sliders}
    assert set(values) <= known, sorted(known)
    return replace(parts, sliders=tuple(replace(slider, value=values.get(slider.name)) for slider in parts.sliders))


def pose(parts: FaceParts, name: str = "bones", seed: int = 1) -> Animation:
    """A pose of all joints, scaled, and of some shapes."""
    rng = np.random.default_rng(seed)
    joints = parts.skeleton.joints
    coefficients = rest_coefficients(len(joints)) + rng.normal(size=(len(joints), 9)) * 0.1
    shapes = tuple(dict.fromkeys(shape.name for mesh in parts.meshes for shape in mesh.blendshapes))[:2]
    return Animation(
        name=name, joints=joints, coefficients=coefficients[None], shapes=shapes, shape_weights=np.array([[0.3, 0.2]])
    )


def with_person(parts: FaceParts) -> FaceParts:
    return replace(parts, animations=(*parts.animations, pose(parts)), person="bones")


def composed(parts: FaceParts, weights: dict[str, float], expression: np.ndarray) -> np.ndarray:
    """Points of an expression on the person, from the definition."""
    rig, person = build(parts), person_of(parts)
    local = rig.rest @ coefficient_matrices(person.coefficients) @ coefficient_matrices(expression)
    both = {name: person.weights.get(name, 0.0) + weights.get(name, 0.0) for name in {*person.weights, *weights}}
    return rig.evaluate(both, joint_transforms=local)


@pytest.fixture(scope="module")
def sample() -> FaceParts:
    parts = make(3)
    own = [slider for slider in parts.sliders if not slider.shapes]
    values = {one.name: one.default + 0.6 * (one.maximum - one.default) for one in own[:8]}
    return with_values(parts, values)


@pytest.fixture(scope="module")
def person_file(sample: FaceParts, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("person") / "person.usdc"
    save_parts(sample, path)
    return path


def worst(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(one - other, axis=-1).max())


@pytest.mark.parametrize("how", ["set", "set-joints"])
def test_rest_is_the_person(sample: FaceParts, how: str) -> None:
    found, parts = set_face(sample, how), sample
    coefficients, weights = slide(parts.sliders, parts.skeleton.joints)
    expected = build(parts).evaluate(weights, coefficients=coefficients)
    rig = build(found.parts)
    assert worst(rig.evaluate(), expected) < EXACT
    assert worst(build(parts).evaluate(), expected) > 0.1  # stage units: the person is another one
    assert found.pose.startswith("set by sliders ")
    assert person_of(found.parts).is_rest  # nothing is set on it twice


@pytest.mark.parametrize("values", [{}, {"noseWidth": 0.5, "jawWidth": -0.4}, {"browShape1": 0.7, "noseWidth": 0.2}])
def test_points_alone_are_those_of_the_set_face(values: dict[str, float]) -> None:
    """Bit for bit, since payloads are made of them."""
    parts = with_values(heads.make(3), values)
    known = {slider.name for slider in parts.sliders}
    assert {*values} <= known
    found, expected = set_points(parts), set_face(parts).parts
    for one, other in zip(found.meshes, expected.meshes, strict=True):
        assert one.points.dtype == other.points.dtype
        np.testing.assert_array_equal(one.points, other.points, one.name)
    moved = [np.abs(one.points - other.points).max() for one, other in zip(found.meshes, parts.meshes, strict=True)]
    assert (max(moved) > 0) == bool(values)


@pytest.mark.parametrize("parts", [with_person(tiny_face()), with_person(make(3))], ids=["tiny", "sample"])
def test_in_the_joints_expressions_are_exact(parts: FaceParts) -> None:
    found = set_face(parts, "set-joints")
    rig = build(found.parts)
    assert found.error is not None
    for weights, expression in random_poses(rig, parts)[:5]:
        expected = composed(parts, weights, expression)
        assert worst(rig.evaluate(weights, coefficients=expression), expected) < EXACT
    assert found.error.max_mm < EXACT
    assert found.error.poses == 50
    assert found.error.shapes == len(rig.shapes)


def test_baked_shapes_are_exact_and_poses_within_the_stated_error(sample: FaceParts) -> None:
    found = set_face(sample)
    rig, joints = build(found.parts), len(sample.skeleton.joints)
    assert found.error is not None
    for name in rig.shapes:
        assert worst(rig.evaluate({name: 1.0}), composed(sample, {name: 1.0}, rest_coefficients(joints))) < EXACT
    poses = [(weights, expression) for weights, expression in random_poses(rig, sample)[:6]]
    off = []
    for weights, expression in poses:
        matrices = coefficient_matrices(expression)
        scaled = [mesh for mesh in found.parts.meshes if mesh.skin is not None]
        assert scaled  # the sample is skinned
        off.append(worst(rig.evaluate(weights, coefficients=expression), composed(sample, weights, expression)))
        assert np.isfinite(matrices).all()
    in_mm = 1000 * sample.meters_per_unit
    assert 0 < max(off) * in_mm < 2 * found.error.max_mm  # moves here are not stretched by the person's scales
    assert found.error.max_mm < 1.0


def test_faces_that_move_alike_are_as_far_apart_as_both_evaluated() -> None:
    """A person of shapes alone, on points that are moved a little."""
    parts = heads.make(3)
    own = [slider for slider in parts.sliders if slider.group == "nose" and not slider.channels]
    parts = with_values(parts, {one.name: 0.7 * one.maximum for one in own[:3]})
    found, noise = set_face(parts), np.random.default_rng(0)
    head, *others = found.parts.meshes
    head = replace(head, points=head.points + noise.normal(0, 0.01, head.points.shape) * (head.points[:, :1] > 0))
    result, person = replace(found.parts, meshes=(head, *others)), person_of(parts)
    before, after = Side(build(parts), person.weights, person.matrices), Side(build(result), {})
    still, poses = np.broadcast_to(np.eye(3), (len(parts.skeleton.joints), 3, 3)), random_poses(before.rig, parts)
    alike = SameMotion.of(before, after, still)
    assert alike is not None
    assert own
    expected = apart((before, after), still, poses)
    assert 0.03 < expected.max() < 0.1
    np.testing.assert_allclose(alike.apart(poses), expected, rtol=1e-9, atol=1e-9)
    with_sliders = apart_with_sliders(before.rig, after.rig, parts, result)
    assert alike.apart_with_sliders(parts, result) == pytest.approx(with_sliders, rel=1e-9)
    turned = replace(after.rig, rest=after.rig.rest @ coefficient_matrices(pose(parts).coefficients[0]))
    assert SameMotion.of(before, Side(turned, {}), still) is None


def test_a_rigid_person_is_exact_and_turns_normals() -> None:
    """All points follow one joint: a turn, moved and scaled evenly."""
    parts = tiny_face()
    coefficients = rest_coefficients(3)
    coefficients[0] = [0.3, -0.2, 0.1, 0.4, -0.5, 0.6, 1.2, 1.2, 1.2]
    head = parts.meshes[0]
    normals = np.random.default_rng(0).normal(size=(len(head.points), 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    parts = replace(
        parts,
        meshes=(replace(head, normals=normals), parts.meshes[1]),
        animations=(Animation(name="turned", joints=parts.skeleton.joints, coefficients=coefficients[None]),),
        person="turned",
    )
    found = set_face(parts)
    assert found.error is not None
    assert found.error.max_mm < EXACT
    turn = coefficient_matrices(coefficients)[0, :3, :3] / 1.2
    assert found.parts.meshes[0].normals is not None
    np.testing.assert_allclose(found.parts.meshes[0].normals, normals @ turn.T, atol=1e-6)
    scales = np.linalg.norm(found.parts.skeleton.rest_transforms[:, :3, :3], axis=1)
    np.testing.assert_allclose(scales, 1.0, atol=1e-12)  # no engine has to keep it


def test_normals_of_a_stretched_mesh_are_of_length_one() -> None:
    """A flat mesh twice as wide: its normals turn by the inverse transpose, diag(1 / 2, 1, 1)."""
    skin = replace(
        tiny_face().meshes[0].skin,
        joint_indices=np.zeros((4, 1), np.int32),
        joint_weights=np.ones((4, 1), np.float32),
        geom_bind_transform=np.eye(4),
    )
    mesh = Mesh(
        name="Flat",
        points=np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]),
        face_vertex_counts=np.int32([4]),
        face_vertex_indices=np.int32([0, 1, 2, 3]),
        normals=np.float32([[0.6, 0.0, 0.8]] * 4),
        skin=skin,
    )
    found = set_mesh(mesh, {}, np.tile(np.eye(4)[:3] * [[2], [1], [1]], (4, 1, 1)))
    expected = np.array([0.3, 0.0, 0.8]) / np.sqrt(0.73)
    np.testing.assert_allclose(found.normals, np.tile(expected, (4, 1)), atol=1e-6)


def test_the_smallest_rotation_between_directions_turns_about_what_is_square_to_both() -> None:
    rng = np.random.default_rng(1)
    start, end = (axes / np.linalg.norm(axes, axis=1, keepdims=True) for axes in rng.normal(size=(2, 20, 3)))
    found = _rotations(start, end)
    np.testing.assert_allclose(found @ np.swapaxes(found, 1, 2), np.tile(np.eye(3), (20, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", found, start), end, atol=1e-12)
    square = np.cross(start, end)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", found, square), square, atol=1e-12)
    np.testing.assert_array_equal(_rotations(start, -start), np.tile(np.eye(3), (20, 1, 1)))


def test_dual_quaternions_are_baked_as_they_move_points() -> None:
    parts = with_person(tiny_face())
    head = parts.meshes[0]
    assert head.skin is not None
    dual = replace(head, skin=replace(head.skin, dual_quaternion=True))
    parts = replace(parts, meshes=(dual, parts.meshes[1]))
    person = person_of(parts)
    expected = build(parts).evaluate(person.weights, coefficients=person.coefficients)
    assert worst(build(set_face(parts).parts).evaluate(), expected) < EXACT
    assert worst(build(set_face(with_person(tiny_face())).parts).evaluate(), expected) > 1e-3  # linear ones are not


def test_inbetweens_go_on_from_where_the_person_is() -> None:
    """A shape that the person has 0.3 of adds what the whole curve adds from there, at every weight."""
    parts = tiny_face()
    animation = Animation(name="open", shapes=("jawOpen",), shape_weights=np.array([[0.3]]))
    parts = replace(parts, animations=(animation,), person="open")
    found = build(set_face(parts).parts)
    for weight in (-0.5, -0.3, 0.1, 0.2, 0.45, 0.7, 1.0, 1.4):
        expected = build(parts).evaluate({"jawOpen": 0.3 + weight})
        assert worst(found.evaluate({"jawOpen": weight}), expected) < EXACT


def test_evaluate_composes_as_usdskel_does(tmp_path: Path) -> None:
    """`rest M(person) M(expression)`, authored as a SkelAnimation, is what UsdSkel bakes."""
    parts = with_person(tiny_face())
    path = tmp_path / "face.usda"
    save_parts(parts, path)
    face = facepipe.open(path)
    expression = rest_coefficients(3)
    expression[:, :6] = np.random.default_rng(5).normal(size=(3, 6)) * 0.1
    person = face.person()
    person_matrices = coefficient_matrices(person.coefficients)
    even = rest_coefficients(3)
    even[:, :6] = person.coefficients[:, :6]  # without scales: UsdSkel has no shear in an animation
    local = face.skeleton.rest_transforms @ coefficient_matrices(even) @ coefficient_matrices(expression)
    with face.deriving(tmp_path / "even.usda") as derived:
        animation = replace(pose(parts), coefficients=even[None])
        from facepipe.stage.author_changes import author_changes

        author_changes(derived, replace(parts, animations=(animation,)))
    even_face = facepipe.open(tmp_path / "even.usda")
    weights = {"jawOpen": 0.4}
    both = {"jawOpen": 0.7, "mouthSmileLeft": 0.2}
    found = even_face.evaluate(weights, coefficients=expression, pose="set")
    assert worst(found, bake(even_face, both, local)) < 1e-5
    scaled = face.skeleton.rest_transforms @ person_matrices @ coefficient_matrices(expression)
    expected = face.rig().evaluate(both, joint_transforms=scaled)
    assert worst(face.evaluate(weights, coefficients=expression, pose="set"), expected) < EXACT
    assert worst(face.evaluate(weights, coefficients=expression), expected) > 1e-3  # the template's


def test_sliders_and_coefficients_compose(sample: FaceParts, person_file: Path) -> None:
    face, joints = facepipe.open(person_file), len(sample.skeleton.joints)
    expression = rest_coefficients(joints)
    expression[:, 3] = 0.1
    own, weights = slide(face.sliders, face.skeleton.joints)
    local = face.rig().rest @ coefficient_matrices(own) @ coefficient_matrices(expression)
    expected = face.rig().evaluate({**weights, "jawOpen": weights.get("jawOpen", 0.0) + 0.5}, joint_transforms=local)
    assert worst(face.evaluate({"jawOpen": 0.5}, coefficients=expression, sliders={}), expected) < EXACT
    assert worst(face.evaluate({"jawOpen": 0.5}, coefficients=expression, pose="set"), expected) < EXACT


def test_clips_play_on_top(tmp_path: Path) -> None:
    """Each sample of each animation of a set face is the template's, on the person; the person's own pose is gone."""
    parts = with_person(make(3))
    found = set_face(parts, "set-joints").parts
    assert "bones" not in {animation.name for animation in found.animations}
    clips = [animation for animation in parts.animations if animation.name != "bones"]
    assert [animation.name for animation in found.animations] == [clip.name for clip in clips]
    rig, rest = build(found), np.asarray(parts.skeleton.rest_transforms)
    person = person_of(parts).matrices
    for before, after in zip(clips, found.animations, strict=True):
        for index in range(1 if before.times is None else min(3, len(before.times))):
            expression = np.linalg.solve(rest, sample_transforms(parts.skeleton, before, index))
            both = dict(sample_weights(before, index))
            for name, weight in person_of(parts).weights.items():
                both[name] = both.get(name, 0.0) + weight
            expected = build(parts).evaluate(both, joint_transforms=rest @ person @ expression)
            local = sample_transforms(found.skeleton, after, index)
            assert worst(rig.evaluate(sample_weights(after, index), joint_transforms=local), expected) < 2e-6


def test_poses_of_photos_lose_the_person_they_hold() -> None:
    parts = with_person(tiny_face())
    bones = parts.animations[-1]
    assert bones.shape_weights is not None
    photo = replace(bones, name="portrait", shape_weights=np.array([[0.8, 0.2]]))  # the person, and 0.5 of jawOpen
    view = PhotoView(
        name="portrait", width=4, height=4, transform=np.eye(4), focal=1.0, center=(2.0, 2.0), clipping=(1.0, 2.0),
        light=np.zeros((9, 3)), animation="portrait",
    )  # fmt: skip
    found = set_face(replace(parts, animations=(bones, photo), photos=(view,)), "set-joints").parts
    (expression,) = found.animations
    assert expression.name == "portrait"
    assert sample_weights(expression)["jawOpen"] == pytest.approx(0.5)
    local = sample_transforms(found.skeleton, expression)
    np.testing.assert_allclose(local, found.skeleton.rest_transforms, atol=1e-9)


def test_limits_leave_what_the_person_has_not_used() -> None:
    parts = tiny_face()
    rest = rest_coefficients(3)
    limits = BoneLimits(lower=rest - 0.5, upper=rest + 0.5)
    coefficients = rest.copy()
    coefficients[1, 4], coefficients[1, 6:] = 0.2, 1.25
    animation = Animation(name="bones", joints=parts.skeleton.joints, coefficients=coefficients[None])
    found = set_face(replace(parts, animations=(animation,), person="bones", bone_limits=limits)).parts.bone_limits
    assert found is not None
    assert (found.lower[1, 4], found.upper[1, 4]) == pytest.approx((-0.7, 0.3))
    assert (found.lower[1, 6], found.upper[1, 6]) == pytest.approx((0.4, 1.2))
    assert (found.lower <= rest).all()
    assert (found.upper >= rest).all()


def test_sliders_start_at_the_person(sample: FaceParts, person_file: Path) -> None:
    """At their new defaults they add nothing; small changes move the face as they move the template's person."""
    found = set_face(sample, "set-joints").parts
    at_start, weights = slide(found.sliders, found.skeleton.joints)
    np.testing.assert_allclose(at_start, rest_coefficients(len(found.skeleton.joints)), atol=1e-12)
    assert not any(abs(weight) > 1e-12 for weight in weights.values())
    before, after = facepipe.open(person_file), build(found)
    values = {one.name: one.default for one in found.sliders}
    start = before.evaluate(sliders=values)
    for slider in found.sliders[:12]:
        step = 1e-4 * (slider.minimum - slider.default or slider.maximum - slider.default)
        moved = {slider.name: slider.default + step}
        coefficients, own = slide(found.sliders, found.skeleton.joints, moved)
        expected = before.evaluate(sliders=values | moved) - start
        change = after.evaluate(own, coefficients=coefficients) - after.evaluate()
        assert worst(change, expected) < 1e-2 * max(float(np.abs(expected).max()), 1e-9)


@pytest.mark.parametrize("how", ["set", "set-joints"])
def test_glb_at_rest_is_the_set_face(sample: FaceParts, person_file: Path, tmp_path: Path, how: str) -> None:
    face = facepipe.open(person_file)
    report = facepipe_gltf.export(face, tmp_path / "p.glb", facepipe_gltf.Options(pose=how, animations=True))
    file = gltf_reader.read(tmp_path / "p.glb")
    height = face.head_height * face.meters_per_unit
    to_metres = face.meters_per_unit
    stated = 0.0 if report.pose_error is None else report.pose_error["max_mm"] / 1000
    names = [joint.rpartition("/")[2] for joint in face.skeleton.joints]
    rest = rest_coefficients(len(names))
    for weights, expression in [({}, rest), ({"jawOpen": 1.0}, rest), *random_poses(face.rig(), sample)[:3]]:
        expected = face.evaluate(weights, coefficients=expression, pose="set") * to_metres
        coefficients = expression.copy()
        coefficients[:, :3] *= to_metres
        motion = dict(zip(names, coefficient_matrices(coefficients), strict=True))
        by_mesh = file.evaluate(weights, motion)
        points = np.concatenate([by_mesh[mesh.name] for mesh in face.meshes])
        allowed = TOLERANCE * height + (0.0 if (expression == rest).all() else 2 * stated)
        assert worst(points, expected) < allowed
    assert report.pose.startswith("set by sliders")


def test_onnx_at_rest_is_the_set_face(person_file: Path, tmp_path: Path) -> None:
    face = facepipe.open(person_file)
    report = facepipe_onnx.export(face, tmp_path / "p.onnx")
    deformer = Deformer(tmp_path / "p.onnx")
    for weights in ({}, {"jawOpen": 1.0}):
        points = deformer.evaluate(weights)["points"].reshape(-1, 3)
        assert worst(points, face.evaluate(weights, pose="set")) < TOLERANCE * face.head_height
    assert report.pose_error is not None


def test_what_verbs_set_is_exported_rendered_and_can_be_left_out(tmp_path: Path, capsys: Capsys) -> None:
    """sliders, then bones applied over them, then sliders again: the last one set is the person."""
    head, person = tmp_path / "head.usda", tmp_path / "person.usda"
    save_parts(make(3), head)
    assert exit_code("sliders", head, "--set", "noseWidth=0.9", "-o", person) == 0
    for name, *options in (("set",), ("rest", "--pose", "rest"), ("template",)):
        source = head if name == "template" else person
        assert exit_code("export", source, "-o", tmp_path / f"{name}.glb", *options) == 0
        assert exit_code("render", source, "-o", tmp_path / f"{name}.png", "--size", "96", *options) == 0
    own, rest, template = ((tmp_path / f"{name}.png").read_bytes() for name in ("set", "rest", "template"))
    assert rest == template != own
    files = [gltf_reader.read(tmp_path / f"{name}.glb").evaluate()["Head"] for name in ("set", "rest", "template")]
    assert np.array_equal(files[1], files[2])  # beside them the file holds the sliders with their values
    assert worst(files[0], files[2]) > 1e-3
    capsys.readouterr()
    face, posed = facepipe.open(person), tmp_path / "posed.usda"
    from facepipe.payload import PayloadContent
    from facepipe.verbs.apply_bones import apply_bones
    from facepipe.verbs.sliders import SetSliders

    coefficients = rest_coefficients(len(face.skeleton.joints))
    coefficients[3, 6:] = 1.3
    content = PayloadContent(
        joints=face.skeleton.joints, meters_per_unit=face.meters_per_unit, coefficients=coefficients
    )
    with face.deriving(posed) as derived:
        apply_bones(derived, content, "applied")
    applied = facepipe.open(posed)
    assert worst(applied.evaluate(pose="set"), applied.evaluate(coefficients=coefficients)) < 1e-5
    assert worst(applied.evaluate(pose="set"), played(posed)[0]) < 1e-4 * applied.head_height  # what a USD viewer shows
    with applied.deriving(tmp_path / "again.usda") as derived:
        SetSliders(values={"noseWidth": 0.5})(derived)
    again = facepipe.open(tmp_path / "again.usda")
    assert worst(again.evaluate(pose="set"), face.evaluate(sliders={"noseWidth": 0.5})) < EXACT


def test_a_pose_that_is_not_there_is_one_line(person_file: Path, tmp_path: Path, capsys: Capsys) -> None:
    for command in ("export", "render"):
        out = tmp_path / ("x.glb" if command == "export" else "x.png")
        line = failed(capsys, command, person_file, "-o", out, "--pose", "nobody", folder=tmp_path)
        assert "no pose 'nobody', expected one of set, set-joints, rest" in line


@pytest.mark.parametrize("how", ["set", "set-joints"])
def test_a_person_of_no_size_is_refused(how: str) -> None:
    parts = with_person(tiny_face())
    (animation,) = parts.animations
    assert animation.coefficients is not None
    flat = animation.coefficients.copy()
    flat[0, 1, 7] = 0.0
    with pytest.raises(InputError, match="root/jaw: scaled to nothing by the person"):
        set_face(replace(parts, animations=(replace(animation, coefficients=flat),)), how)


@pytest.mark.parametrize("how", ["clip", "person"])
def test_an_animation_of_a_joint_that_is_not_there_is_refused(how: str) -> None:
    parts = with_person(tiny_face())
    (person,) = parts.animations
    other = replace(person, joints=("root/nobody", *person.joints[1:]), name="other")
    assert other.joints != person.joints
    with pytest.raises(InputError, match="other: 'root/nobody' is not a joint of the skeleton"):
        set_face(replace(parts, animations=(person, other)), "set" if how == "clip" else "other")


def test_matrices_without_a_way_back_are_refused() -> None:
    parts = with_person(tiny_face())
    (person,) = parts.animations
    flat = np.diag([1.0, 0.0, 1.0, 1.0])
    assert parts.meshes[0].skin is not None
    skinned = replace(parts.meshes[0], skin=replace(parts.meshes[0].skin, geom_bind_transform=flat))
    with pytest.raises(TopologyError, match="geomBindTransform: singular matrix"):
        set_face(replace(parts, meshes=(skinned, *parts.meshes[1:])))
    rest = parts.skeleton.rest_transforms @ flat
    pose = replace(person, name="pose", coefficients=None, translations=np.zeros((1, len(person.joints), 3)))
    with pytest.raises(InputError, match="joints scaled to nothing at rest"):
        set_face(replace(parts, animations=(pose,), skeleton=replace(parts.skeleton, rest_transforms=rest)), "pose")


@pytest.mark.parametrize(
    ("scale", "size"), [(0.0, "to nothing"), (1e200, "beyond measure"), ([1e306, 1.0, 1e-3], "beyond measure")]
)
def test_joints_of_no_size_at_rest_are_refused(scale: float | list[float], size: str) -> None:
    parts = with_person(tiny_face())
    rest = parts.skeleton.rest_transforms.copy()
    rest[1, :3, :3] *= np.asarray(scale)
    with pytest.raises(InputError, match=f"root/jaw: scaled {size} at rest"):
        set_face(replace(parts, skeleton=replace(parts.skeleton, rest_transforms=rest)))


def test_the_report_holds_pose_and_error(person_file: Path, tmp_path: Path, capsys: Capsys) -> None:
    report = json.loads(done(capsys, "export", person_file, "-o", tmp_path / "p.glb", "--json", quiet=False))
    assert report["pose"].startswith("set by sliders")
    assert report["pose_error"]["poses"] == 50
    assert report["pose_error"]["shapes"] == 52
    assert 0 < report["pose_error"]["mean_mm"] < report["pose_error"]["max_mm"] < 1


def test_blendshapes_alone_are_a_person_too() -> None:
    """A face without joints, set by a slider of shapes."""
    offsets = np.array([[0.0, 0.0, 1.0]])
    shape = Blendshape(
        name="long",
        point_indices=np.array([3]),
        offsets=offsets,
        inbetweens=(Inbetween(name="half", weight=0.5, offsets=offsets * 0.9),),
    )
    tiny = tiny_face()
    mesh = replace(tiny.meshes[1], blendshapes=(shape,))
    parts = replace(
        tiny,
        meshes=(mesh,),
        skeleton=Skeleton(),
        sliders=(Slider(name="length", value=0.5, shapes=(("long", 1.0),)),),
    )
    found = set_face(parts)
    assert found.parts.meshes[0].points[3, 2] - mesh.points[3, 2] == pytest.approx(0.9)
    assert build(found.parts).evaluate({"long": 0.5})[3, 2] - mesh.points[3, 2] == pytest.approx(1.0)
