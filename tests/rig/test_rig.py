"""Bone coefficients, activation curves, skinning and sliders against UsdSkel and independent formulas."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import exit_code
from faces import replace_mesh, tiny_face
from hypothesis import given
from hypothesis import strategies as st
from oracle import bake, difference, random_coefficients
from pxr import Gf, Usd, UsdSkel, Vt
from scipy.spatial.transform import Rotation

from facepipe.core.errors import InputError, TopologyError
from facepipe.parts import Animation, Blendshape, FaceParts, Inbetween, Slider
from facepipe.rig import (
    build,
    coefficient_matrices,
    matrix_coefficients,
    rest_coefficients,
    sample_transforms,
    sample_weights,
    slide,
)
from facepipe.rig.rig import curves
from facepipe.rig.trs import compose, decompose, quaternions
from facepipe.stage import Face


def test_coefficients_are_translation_rotation_z_x_y_scale() -> None:
    rng = np.random.default_rng(1)
    values = random_coefficients(rng, 50, 2.0, 3.0)
    rx, ry, rz = values[:, 3:6].T
    turn = Rotation.from_rotvec(np.outer(rz, [0, 0, 1]))
    turn = turn * Rotation.from_rotvec(np.outer(rx, [1, 0, 0])) * Rotation.from_rotvec(np.outer(ry, [0, 1, 0]))
    expected = turn.as_matrix() @ np.stack([np.diag(scale) for scale in values[:, 6:]])
    result = coefficient_matrices(values)
    np.testing.assert_allclose(result[:, :3, :3], expected, atol=1e-14)
    np.testing.assert_array_equal(result[:, :3, 3], values[:, :3])
    np.testing.assert_array_equal(result[:, 3], np.tile([0, 0, 0, 1.0], (50, 1)))


@given(st.lists(st.floats(-3.2, 3.2), min_size=3, max_size=3), st.lists(st.floats(0.05, 4), min_size=3, max_size=3))
def test_coefficients_come_back_from_their_matrix(angles: list[float], scales: list[float]) -> None:
    matrix = coefficient_matrices(np.array([0.1, -2.0, 3.0, *angles, *scales]))
    again = coefficient_matrices(matrix_coefficients(matrix))
    np.testing.assert_allclose(again, matrix, atol=1e-7)


def test_gimbal_and_mirror_come_back() -> None:
    values = np.array([[0, 0, 0, np.pi / 2, 0.4, 0.3, 1, 2, 3], [1, 2, 3, 0.1, 0.2, 0.3, -1, 1, 1.5]])
    matrix = coefficient_matrices(values)
    np.testing.assert_allclose(coefficient_matrices(matrix_coefficients(matrix)), matrix, atol=1e-9)


def test_activations_are_a_partition_between_sculpts() -> None:
    by_weight = curves((0.3, 0.6))
    assert sorted(by_weight) == [0.3, 0.6, 1.0]
    for own, curve in by_weight.items():
        assert float(curve(own)) == pytest.approx(1)
        assert all(abs(float(curve(other))) < 1e-12 for other in (0.0, *by_weight) if other != own)


@pytest.mark.parametrize("weight", [-0.4, 0.0, 0.2, 0.5, 0.77, 1.0, 1.3])
def test_inbetweens_as_usdskel(weight: float) -> None:
    face = Face.from_parts(tiny_face())
    weights = {"jawOpen": weight, "mouthSmileLeft": 0.5}
    assert difference(face, face.evaluate(weights), bake(face, weights)) < 1e-6


def test_inbetweens_of_two_shapes_may_share_a_joined_name() -> None:
    """Shape `a` with inbetween `b_c` and shape `a_b` with inbetween `c`: both sculpts read `a_b_c`."""
    parts = tiny_face()
    head = parts.meshes[0]
    rng = np.random.default_rng(7)
    indices = np.arange(len(head.points), dtype=np.int32)

    def offsets() -> np.ndarray:
        return rng.normal(size=(len(indices), 3)).astype(np.float32)

    shapes = tuple(
        Blendshape(
            name=shape,
            point_indices=indices,
            offsets=offsets(),
            inbetweens=(Inbetween(name=inbetween, weight=0.5, offsets=offsets()),),
        )
        for shape, inbetween in (("a", "b_c"), ("a_b", "c"))
    )
    face = Face.from_parts(replace(parts, meshes=(replace_mesh(head, blendshapes=shapes),)))
    for weights in ({"a": 0.5}, {"a_b": 0.5}, {"a": 0.3, "a_b": 0.8}):
        assert difference(face, face.evaluate(weights), bake(face, weights)) < 1e-6


@pytest.mark.parametrize("seed", range(5))
def test_poses_as_usdskel(seed: int) -> None:
    face = Face.from_parts(tiny_face(seed))
    coefficients = random_coefficients(np.random.default_rng(seed), 3, 0.5)
    weights = {"jawOpen": 0.4, "mouthSmileLeft": -0.3}
    local = face.rig().local_transforms(coefficients)
    assert difference(face, face.evaluate(weights, coefficients=coefficients), bake(face, weights, local)) < 2e-6


def test_placed_meshes_and_skeleton_as_usdskel() -> None:
    rng = np.random.default_rng(3)
    placed = [coefficient_matrices(random_coefficients(rng, 1, 2.0)[0]) for _ in range(4)]
    parts = tiny_face()
    head, teeth = parts.meshes
    assert head.skin is not None
    skin = replace(head.skin, geom_bind_transform=placed[0])
    meshes = (replace_mesh(head, transform=placed[1], skin=skin), replace_mesh(teeth, transform=placed[2]))
    face = Face.from_parts(replace(parts, meshes=meshes, skeleton=replace(parts.skeleton, transform=placed[3])))
    coefficients = random_coefficients(rng, 3, 0.5)
    local = face.rig().local_transforms(coefficients)
    weights = {"jawOpen": 0.7}
    assert difference(face, face.evaluate(weights, coefficients=coefficients), bake(face, weights, local)) < 2e-6


def test_a_moved_body_joint_moves_the_whole_face() -> None:
    face = Face.from_parts(tiny_face())
    body = coefficient_matrices(random_coefficients(np.random.default_rng(0), 1, 3.0)[0])
    at_rest, moved = face.evaluate({"jawOpen": 1}), face.evaluate({"jawOpen": 1}, parent_world=body)
    np.testing.assert_allclose(moved, at_rest @ body[:3, :3].T + body[:3, 3], atol=1e-6)


def test_sliders_add_up_and_clamp() -> None:
    sliders = (
        Slider(name="width", channels=(("a", "sx", 0.5), ("b", "tx", 2.0)), default=0.5),
        Slider(name="open", shapes=(("jawOpen", 2.0),), minimum=-1, value=0.25),
    )
    coefficients, weights = slide(sliders, ("a", "b"), {"width": 7.0})
    expected = rest_coefficients(2)
    expected[0, 6], expected[1, 0] = 1.25, 1.0
    np.testing.assert_allclose(coefficients, expected)
    assert weights == {"jawOpen": 0.5}
    with pytest.raises(InputError, match="no slider 'wdith'"):
        slide(sliders, ("a", "b"), {"wdith": 1.0})


def test_bad_values_are_refused() -> None:
    face = Face.from_parts(tiny_face())
    for bad in ({"nope": 1.0}, {"jawOpen": float("nan")}):
        with pytest.raises(InputError):
            face.evaluate(bad)
    with pytest.raises(InputError, match=r"expected \(3, 9\)"):
        face.evaluate(coefficients=np.zeros((2, 9)))
    with pytest.raises(InputError, match="NaN"):
        face.evaluate(joint_transforms=np.full((3, 4, 4), np.nan))
    for person in ({"sliders": {}}, {"pose": "set"}):
        with pytest.raises(InputError, match="only one"):
            face.evaluate(joint_transforms=face.skeleton.rest_transforms, **person)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="only one"):
        face.evaluate(sliders={}, pose="set")


def test_a_singular_bind_is_refused() -> None:
    parts = tiny_face()
    bind = parts.skeleton.bind_transforms.copy()
    bind[1, 0] = 0
    with pytest.raises(TopologyError, match="root/jaw: singular"):
        build(replace(parts, skeleton=replace(parts.skeleton, bind_transforms=bind)))


def test_transforms_split_and_join_again() -> None:
    rng = np.random.default_rng(5)
    matrices = coefficient_matrices(random_coefficients(rng, 40, 3.0, 3.0))
    matrices[::2, :3, 0] *= -1
    np.testing.assert_allclose(compose(*decompose(matrices)[:3]), matrices, atol=1e-12)


@pytest.mark.parametrize("scales", [(1, 1e-3, 1), (1e-8, 1e-3, 1), (5, 1, 0.4)])
def test_no_joint_turns_with_the_length_of_its_axes(scales: tuple[float, float, float]) -> None:
    """Nor where they are not quite at right angles, as rounding to float32 leaves them."""
    matrices = np.tile(np.eye(4), (20, 1, 1))
    matrices[:, :3, :3] = Rotation.random(20, random_state=4).as_matrix()
    matrices[:, :3, 1] += 3e-7 * matrices[:, :3, 0]
    scaled = matrices * [*scales, 1]
    before, after = decompose(matrices), decompose(scaled)
    np.testing.assert_allclose(after.rotation, before.rotation, atol=1e-12)
    np.testing.assert_allclose(after.scale, before.scale * scales, rtol=1e-12)
    assert not after.sheared.any()


def test_a_rotation_has_one_quaternion() -> None:
    """The one with w of at least 0, so that equal rotations are equal bytes in files."""
    rotations = Rotation.random(200, random_state=3)
    turned = quaternions(rotations.as_matrix())
    assert (turned[:, 3] >= 0).all()
    np.testing.assert_allclose(turned, rotations.as_quat(canonical=True), atol=1e-12)


def test_coefficients_of_a_sample_win_and_other_joints_rest() -> None:
    parts = tiny_face()
    values = random_coefficients(np.random.default_rng(0), 1, 1.0)
    animation = Animation(
        name="pose",
        joints=("root/jaw",),
        translations=np.zeros((1, 1, 3)),
        rotations=np.array([[[0, 0, 0, 1.0]]]),
        coefficients=values[None],
        shapes=("jawOpen",),
        shape_weights=np.array([[0.25]]),
    )
    local = sample_transforms(parts.skeleton, animation)
    expected = parts.skeleton.rest_transforms.copy()
    expected[1] = expected[1] @ coefficient_matrices(values[0])
    np.testing.assert_allclose(local, expected)
    assert sample_weights(animation) == {"jawOpen": 0.25}
    with pytest.raises(InputError, match="is not a joint of the skeleton"):
        sample_transforms(parts.skeleton, replace(animation, joints=("nose",)))


def partial(parts: FaceParts, *given: str, seed: int = 11) -> Animation:
    """Two joints at three times, of whose transforms only some parts are given."""
    rng = np.random.default_rng(seed)
    rotations = rng.normal(size=(3, 2, 4))
    every = {
        "translations": rng.normal(size=(3, 2, 3)),
        "rotations": rotations / np.linalg.norm(rotations, axis=-1, keepdims=True),
        "scales": rng.uniform(0.5, 2, (3, 2, 3)).astype(np.float16).astype(np.float64),
    }
    joints = parts.skeleton.joints[1:][::-1]
    chosen = {name: every[name] for name in given}
    return Animation(name="part", times=np.array([0.0, 0.5, 1.0]), joints=joints, **chosen)


def usdskel_points(face: Face, animation: str, sample: int) -> np.ndarray:
    """(n, 3) world points that UsdSkel gives for the animation as the stage has it."""
    stage = Usd.Stage.Open(face.stage.Flatten())
    skeleton = next(one for one in stage.Traverse() if one.IsA(UsdSkel.Skeleton))
    source = next(one for one in stage.Traverse() if one.IsA(UsdSkel.Animation) and one.GetName() == animation)
    UsdSkel.BindingAPI.Apply(skeleton).CreateAnimationSourceRel().SetTargets([source.GetPath()])
    query = UsdSkel.Cache().GetSkelQuery(UsdSkel.Skeleton(skeleton))
    times = UsdSkel.Animation(source).GetRotationsAttr().GetTimeSamples() or [0.0]
    local = np.array(query.ComputeJointLocalTransforms(times[sample])).transpose(0, 2, 1)
    return bake(face, {}, local)


@pytest.mark.parametrize(
    "given", [("rotations",), ("translations",), ("scales",), ("translations", "scales"), ("rotations", "scales")]
)
def test_parts_of_transforms_as_usdskel(given: tuple[str, ...]) -> None:
    """The rest of the transform comes from the rest pose, in the rig and on the stage."""
    parts = tiny_face()
    animation = partial(parts, *given)
    face = Face.from_parts(replace(parts, animations=(animation,)))
    for sample in range(3):
        local = sample_transforms(parts.skeleton, animation, sample)
        assert np.abs(local[1:] - parts.skeleton.rest_transforms[1:]).max() > 0.1
        points = build(parts).evaluate(joint_transforms=local)
        assert difference(face, points, usdskel_points(face, "part", sample)) < 1e-5


def test_a_stage_of_bone_coefficients_alone_moves_in_usdskel_too() -> None:
    parts = tiny_face()
    values = random_coefficients(np.random.default_rng(4), 3, 0.5)
    pose = Animation(name="pose", joints=parts.skeleton.joints, coefficients=values[None])
    face = Face.from_parts(replace(parts, animations=(pose,)))
    assert difference(face, face.evaluate(coefficients=values), usdskel_points(face, "pose", 0)) < 1e-5


@pytest.mark.parametrize("given", [("rotations",), ("translations", "rotations", "scales")])
def test_a_quaternion_of_no_length_is_refused(given: tuple[str, ...]) -> None:
    parts = tiny_face()
    animation = partial(parts, *given)
    assert animation.rotations is not None
    animation.rotations[1, 0] = 0
    with pytest.raises(InputError, match=r"part -> root/jaw/lip: .*quaternion of length 0"):
        sample_transforms(parts.skeleton, animation, 1)
    assert np.isfinite(sample_transforms(parts.skeleton, animation, 0)).all()


def test_a_pose_of_no_length_on_a_stage_ends_the_render_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    parts = tiny_face()
    path = tmp_path / "face.usda"
    face = Face.from_parts(replace(parts, animations=(partial(parts, "rotations"),)))
    source = next(one for one in face.stage.Traverse() if one.IsA(UsdSkel.Animation))
    rotations = UsdSkel.Animation(source).GetRotationsAttr()
    rotations.Set(Vt.QuatfArray([Gf.Quatf(0, 0, 0, 0)] * 2), rotations.GetTimeSamples()[0])
    face.save(path)
    assert exit_code("render", path, "--pose", "part", "-o", tmp_path / "face.png") == 2
    (line,) = capfd.readouterr().err.strip().splitlines()
    assert "part -> root/jaw/lip" in line
    assert "quaternion" in line
