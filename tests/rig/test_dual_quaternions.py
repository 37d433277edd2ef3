"""Meshes skinned by dual quaternions: as UsdSkel has them, and named where something knows linear skinning alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import facepipe_gltf
import facepipe_onnx
import numpy as np
import pytest
from facepipe_gltf import read as gltf
from faces import replace_mesh
from foreign_stages import HEAD, foreign_stage, read, rich_face, written
from gltf_export import Parts
from oracle import bake, difference, random_coefficients
from pxr import UsdSkel

import facepipe
from facepipe.core.errors import InputError
from facepipe.parts import Animation, FaceParts
from facepipe.rig import build, coefficient_matrices
from facepipe.rig.neural_rig import bones_in
from facepipe.stage import Face, save_parts
from facepipe.verbs.fit_bones.limits import check_rig


def dual_face() -> FaceParts:
    parts = rich_face()
    head = parts.meshes[0]
    assert head.skin is not None
    shown = replace_mesh(head, skin=replace(head.skin, dual_quaternion=True))
    return replace(parts, meshes=(shown, *parts.meshes[1:]))


def turns(seed: int, size: float) -> np.ndarray:
    return random_coefficients(np.random.default_rng(seed), 3, size)


@pytest.mark.parametrize("size", [0.3, 0.8])
def test_a_face_moves_as_usdskel_moves_it(size: float) -> None:
    face, linear = Face.from_parts(dual_face()), Face.from_parts(rich_face())
    for seed in range(5):
        local = face.skeleton.rest_transforms @ coefficient_matrices(turns(seed, size))
        expected = bake(face, {"jawOpen": 0.6}, local)
        moved = face.evaluate({"jawOpen": 0.6}, joint_transforms=local)
        assert difference(face, moved, expected) < 1e-5
        assert difference(face, linear.evaluate({"jawOpen": 0.6}, joint_transforms=local), expected) > 1e-3


def test_turns_take_the_shorter_way() -> None:
    face = Face.from_parts(dual_face())
    coefficients = turns(3, 0.1)
    coefficients[1, 3:6] = (0.2, 3.0, 0.1)  # beyond a right angle quaternions lie on either side
    local = face.skeleton.rest_transforms @ coefficient_matrices(coefficients)
    assert difference(face, face.evaluate(joint_transforms=local), bake(face, {}, local)) < 1e-5


def test_points_are_unskinned_where_they_came_from() -> None:
    rig = build(dual_face())
    matrices = rig.skinning_matrices(rig.rest @ coefficient_matrices(turns(1, 0.4)))
    points = rig.morph(rig.weight_vector({"jawOpen": 1.0}))
    assert np.abs(rig.unskin(rig.skin(points, matrices), matrices) - points).max() < 1e-9


def test_points_that_bones_flatten_are_unskinned_to_the_nearest_of_their_place_at_bind_time() -> None:
    rig = build(rich_face())
    coefficients = turns(1, 0.4)
    coefficients[:, 6] = 0.0  # scaled to nothing along X
    matrices = rig.skinning_matrices(rig.rest @ coefficient_matrices(coefficients))
    linear = rig.blended(matrices)[:, :, :3]
    flat = np.linalg.matrix_rank(linear, tol=1e-6) == 2
    assert flat.any()
    shown = rig.skin(rig.morph(rig.weight_vector({"jawOpen": 1.0})), matrices)
    found = rig.unskin(shown, matrices)
    assert np.abs(rig.skin(found, matrices) - shown)[flat].max() < 1e-9
    lost = np.linalg.svd(linear[flat])[2][:, 2]  # the way that makes no difference
    assert np.abs(np.einsum("ni,ni->n", lost, (found - rig.points)[flat])).max() < 1e-9


def test_an_import_keeps_the_method(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    UsdSkel.BindingAPI(stage.GetPrimAtPath(HEAD)).CreateSkinningMethodAttr(UsdSkel.Tokens.dualQuaternion)
    save_parts(read(written(stage, tmp_path / "source.usda")).parts, tmp_path / "face.usda")
    face, truth = facepipe.open(tmp_path / "face.usda"), Face.from_parts(dual_face())
    local = truth.skeleton.rest_transforms @ coefficient_matrices(turns(2, 0.5))
    expected = bake(truth, {}, local)
    assert difference(truth, face.evaluate(joint_transforms=local), expected) < 1e-5
    assert difference(truth, bake(face, {}, local), expected) < 1e-5
    facepipe_gltf.export(face, tmp_path / "face.glb")
    again = gltf.read(tmp_path / "face.glb", gltf.Options()).parts
    assert [mesh.skin is not None and mesh.skin.dual_quaternion for mesh in again.meshes] == [True, False]


def test_writers_say_how_far_off_linear_skinning_is(tmp_path: Path) -> None:
    parts = dual_face()
    coefficients = turns(4, 0.5)
    pose = Animation(
        name="turned",
        joints=parts.skeleton.joints,
        coefficients=coefficients[None],
        shapes=("jawOpen",),
        shape_weights=np.array([[4.0]]),
    )
    posed = replace(parts, animations=(pose,))
    face, linear = Face.from_parts(posed), Face.from_parts(rich_face())
    local = face.skeleton.rest_transforms @ coefficient_matrices(coefficients)
    shown, linear_shown = (bake(one, {"jawOpen": 4.0}, local) for one in (face, linear))
    apart = np.linalg.norm(shown - linear_shown, axis=1).max() * posed.meters_per_unit * 1000
    for report in (
        facepipe_gltf.export(Parts(posed), tmp_path / "face.glb"),
        facepipe_onnx.export(Parts(posed), tmp_path / "face.onnx"),
    ):
        (line,) = [line for line in report.warnings if "dual quaternions" in line]
        assert line.startswith(
            "Head: skinned by dual quaternions, which the format lacks: skinned linearly in the file"
        )
        assert f"up to {apart:.3g} mm off over 1 poses" in line
    (line,) = facepipe_onnx.export(Parts(parts), tmp_path / "rest.onnx").warnings
    assert "no animation to measure" in line
    assert facepipe_onnx.export(Parts(rich_face()), tmp_path / "linear.onnx").warnings == ()


def test_what_knows_linear_skinning_alone_refuses() -> None:
    parts = dual_face()
    rig = build(parts)
    message = (
        r"Head: skinned by dual quaternions, which .* does not support; expected skel:skinningMethod classicLinear"
    )
    with pytest.raises(InputError, match=message):
        check_rig("face.usda", parts, rig)
    with pytest.raises(InputError, match=message):
        bones_in(rig, np.eye(4))


@pytest.mark.slow
def test_the_differentiable_rig_refuses() -> None:
    learn = pytest.importorskip("facepipe.rig.torch.rig", reason="needs torch")
    with pytest.raises(InputError, match="which the differentiable rig does not support"):
        learn.DifferentiableRig(build(dual_face()))
