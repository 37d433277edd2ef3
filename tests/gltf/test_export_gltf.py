"""The glTF exporter: what a file says equals what the rig says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import oracle
import pytest
from faces import replace_mesh, tiny_face
from gltf_export import (
    TOLERANCE,
    Writing,
    difference,
    head_height,
    motion,
    random_coefficients,
    random_weights,
    reference,
    to_gltf,
    writing,
    written,
)
from gltf_reader import Gltf, local_matrix
from import_data import shared
from node import node_packages, three_load
from placed_faces import FACES, placed_face, similarity

from facepipe.importers import load
from facepipe.parts import FaceParts, Mesh, Skeleton, Skin
from facepipe.rig import coefficient_matrices
from facepipe.stage import Face

__all__ = ["writing", "written"]


def check_agreement(parts: FaceParts, file: Gltf, poses: int, influences: int = 4, shapes: int | None = None) -> None:
    """Every shape alone, then random poses of shapes and bones."""
    limit = TOLERANCE * head_height(parts)
    names = list(dict.fromkeys(shape.name for mesh in parts.meshes for shape in mesh.blendshapes))
    for name in names[:shapes]:
        expected = reference(parts, {name: 1.0}, influences=influences)
        assert difference(file.evaluate({name: 1.0}), expected, parts) < limit, name
    rng = np.random.default_rng(7)
    reach = 0.02 * head_height(parts) / parts.meters_per_unit
    for _ in range(poses):
        weights, coefficients = random_weights(parts, rng), random_coefficients(parts, rng, reach)
        expected = reference(parts, weights, coefficients, influences)
        assert difference(file.evaluate(weights, motion(parts, file, coefficients)), expected, parts) < limit


@pytest.mark.parametrize("name", FACES)
def test_file_agrees_with_the_rig(name: str, writing: Writing) -> None:
    parts = FACES[name]()
    file, _ = writing(parts)
    check_agreement(parts, file, poses=10)


@pytest.mark.parametrize("name", FACES)
def test_morph_mode_is_the_face_at_rest_without_joints(name: str, writing: Writing) -> None:
    parts = FACES[name]()
    file, report = writing(parts, mode="morph")
    assert not file.list("skins")
    assert report.counts["joints"] == 0
    rng = np.random.default_rng(3)
    for _ in range(5):
        weights = random_weights(parts, rng)
        assert difference(file.evaluate(weights), reference(parts, weights), parts) < TOLERANCE * head_height(parts)


@pytest.mark.parametrize("name", FACES)
def test_skin_mode_has_no_targets_and_skins_alike(name: str, writing: Writing) -> None:
    parts = FACES[name]()
    file, report = writing(parts, mode="skin")
    assert not any("targets" in primitive for mesh in file.list("meshes") for primitive in mesh["primitives"])
    assert report.counts["targets"] == 0
    coefficients = random_coefficients(parts, np.random.default_rng(4), 0.1)
    found = file.evaluate(motion=motion(parts, file, coefficients))
    assert difference(found, reference(parts, {}, coefficients), parts) < TOLERANCE * head_height(parts)


@pytest.mark.parametrize("name", FACES)
def test_triangles_face_the_way_of_their_normals(name: str, writing: Writing) -> None:
    parts = FACES[name]()
    file, _ = writing(parts)
    neutral = file.evaluate(worlds=np.array(file.worlds()))
    for mesh in file.list("meshes"):
        attributes, indices = mesh["primitives"][0]["attributes"], mesh["primitives"][0]["indices"]
        positions, normals = file.decoded(attributes["POSITION"]), file.decoded(attributes["NORMAL"])
        triangles = file.stored(indices).reshape(-1, 3)
        a, b, c = (positions[triangles[:, i]] for i in range(3))
        assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), normals[triangles[:, 0]]) > 0).all()
        assert np.allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    assert len(neutral) == 2


def test_authored_normals_and_their_offsets_follow_the_surface(writing: Writing) -> None:
    """A normal offset moves the exported normal where it moves the authored one."""
    parts = placed_face()
    head = parts.meshes[0]
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(len(head.points), 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    parts = replace(parts, meshes=(replace_mesh(head, normals=normals), parts.meshes[1]))
    file, _ = writing(parts, mode="both")
    primitive = file.mesh("Head")["primitives"][0]
    points = file.decoded(primitive["attributes"]["_FACEPIPE_POINT"]).astype(int)
    shape = head.blendshapes[0]
    assert head.skin is not None
    assert shape.normal_offsets is not None
    bake = to_gltf(parts) @ parts.skeleton.transform[:3, :3] @ head.skin.geom_bind_transform[:3, :3]
    moved = normals.copy()
    moved[shape.point_indices] += shape.normal_offsets
    expected = moved @ np.linalg.inv(bake)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    target = primitive["targets"][file.targets("Head").index("jawOpen")]
    found = file.decoded(primitive["attributes"]["NORMAL"]) + file.decoded(target["NORMAL"])
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    assert np.abs(found - expected[points]).max() < 1e-5
    assert all(set(one) == {"POSITION", "NORMAL"} for one in primitive["targets"])


def many_joints(joints: int = 300, influences: int = 9) -> FaceParts:
    """A grid whose points follow 9 of 300 joints each, some of them named twice."""
    face = tiny_face()
    rng = np.random.default_rng(5)
    count = len(face.meshes[0].points)
    indices = rng.integers(0, joints, (count, influences)).astype(np.int32)
    indices[:, 3] = indices[:, 0]
    weights = rng.random((count, influences)) ** 2
    weights[:, 5] = 0.0
    weights /= weights.sum(axis=1, keepdims=True)
    binds = np.stack([similarity(i) for i in range(joints)])
    skeleton = Skeleton(joints=tuple(f"j{i}" for i in range(joints)), bind_transforms=binds, rest_transforms=binds)
    head = replace_mesh(face.meshes[0], skin=Skin(joint_indices=indices, joint_weights=weights.astype(np.float32)))
    return replace(face, skeleton=skeleton, meshes=(head, face.meshes[1]))


@pytest.mark.parametrize("influences", [4, 8])
@pytest.mark.parametrize("quantize", [False, True])
def test_influences_are_the_largest_each_once_and_sum_to_one(influences: int, quantize: bool, writing: Writing) -> None:
    parts = many_joints()
    file, report = writing(parts, influences=influences, quantize=quantize)
    attributes = file.mesh("Head")["primitives"][0]["attributes"]
    sets = range(influences // 4)
    assert ("JOINTS_1" in attributes) == (influences == 8)
    joints = np.concatenate([file.stored(attributes[f"JOINTS_{i}"]) for i in sets], axis=1)
    weights = np.concatenate([file.stored(attributes[f"WEIGHTS_{i}"]) for i in sets], axis=1)
    assert (joints[weights == 0] == 0).all()
    for row, used in zip(joints, weights > 0, strict=True):
        assert len(set(row[used])) == used.sum()
    total = weights.sum(axis=1, dtype=np.float64)
    rounding = 0 if quantize else 0.5 * np.spacing(weights[:, 0]) + 1e-14  # of the largest alone
    assert (np.abs(total - (65535 if quantize else 1)) <= rounding).all()
    assert any("influences" in line for line in report.warnings) == (influences == 4)
    if not quantize:
        check_agreement(parts, file, poses=5, influences=influences)


def test_inbetween_curves_reproduce_the_shape(writing: Writing) -> None:
    """By weight alone: the neutral at 0, the inbetween at its weight, halves between."""
    parts = tiny_face()
    file, _ = writing(parts)
    assert file.targets("Head") == ["jawOpen", "jawOpen_half", "mouthSmileLeft"]
    own = file.mesh("Head")["extras"]["facepipe"]
    assert own["inbetweens"] == {"jawOpen_half": {"shape": "jawOpen", "weight": 0.5}}
    assert file.targets("Teeth") == ["jawOpen"]
    shape = parts.meshes[0].blendshapes[0]
    neutral = file.evaluate()["Head"][shape.point_indices]
    for weight, offsets in [
        (0.25, shape.inbetweens[0].offsets / 2),
        (0.5, shape.inbetweens[0].offsets),
        (0.75, (shape.inbetweens[0].offsets + shape.offsets) / 2),
        (1.0, shape.offsets),
    ]:
        moved = file.evaluate({"jawOpen": weight})["Head"][shape.point_indices] - neutral
        assert np.abs(moved - offsets * parts.meters_per_unit).max() < 1e-7


def test_shear_and_mirrored_joints_are_reported(writing: Writing) -> None:
    _, sheared = writing(FACES["sheared rest"]())
    assert sum("extra node above" in line for line in sheared.warnings) == 3
    _, scaled = writing(FACES["scaled rest"](), "b.glb")
    assert any("shear inherited" in line for line in scaled.warnings)
    _, mirrored = writing(FACES["mirrored rest"](), "c.glb")
    assert any("negative scale" in line for line in mirrored.warnings)
    _, plain = writing(tiny_face(), "d.glb")
    assert not plain.warnings


@pytest.mark.parametrize("name", ["plain", "placed, Z up", "posed rest"])
def test_three_loads_the_file(name: str, writing: Writing) -> None:
    node_packages()
    parts = FACES[name]()
    file, report = writing(parts)
    rng = np.random.default_rng(9)
    coefficients = random_coefficients(parts, rng, 0.1)
    moves = motion(parts, file, coefficients)
    weights = dict.fromkeys(("jawOpen", "mouthSmileLeft"), 0.7)
    nodes = {one["name"]: one for one in file.list("nodes")}
    joints = {name: (local_matrix(nodes[name]) @ move).T.ravel().tolist() for name, move in moves.items()}
    answer = three_load(report.path, weights, joints)
    assert answer["joints"] == len(parts.skeleton.joints)
    activations = {one["name"]: np.array([weights.get(t, 0) for t in one["targets"]]) for one in answer["meshes"]}
    expected = file.evaluate(motion=moves, target_weights=activations)
    assert {one["name"] for one in answer["meshes"]} == {"Head", "Teeth"}
    for one in answer["meshes"]:
        assert one["targets"] == file.targets(one["name"])
        found = np.array(one["positions"])
        own = expected[one["name"]][np.array(one["points"], int)]
        assert np.abs(found - own).max() < TOLERANCE * head_height(parts)


def test_file_agrees_with_usdskel(writing: Writing) -> None:
    """The oracle itself: `UsdSkel.BakeSkinning` on the stage that the file was exported from."""
    face = Face.from_parts(tiny_face())
    parts = face.parts()
    file, _ = writing(parts)
    rng = np.random.default_rng(6)
    for _ in range(10):
        weights = random_weights(parts, rng)
        coefficients = oracle.random_coefficients(rng, len(parts.skeleton.joints), 0.1)
        baked = oracle.bake(face, weights, face.skeleton.rest_transforms @ coefficient_matrices(coefficients))
        expected = face.split(baked @ to_gltf(parts).T)
        found = file.evaluate(weights, motion(parts, file, coefficients))
        assert difference(found, expected, parts) < TOLERANCE * head_height(parts)


def test_real_head_with_expressions(writing: Writing) -> None:
    parts = load("ict", shared("ict_facekit/ict_facekit.npz")).parts
    file, report = writing(parts)
    assert report.counts["shapes"] == 53
    assert report.counts["sparse accessors"] > 0
    check_agreement(parts, file, poses=2, shapes=4)
    vertices = sum(len(mesh.points) for mesh in parts.meshes)
    assert report.bytes < 53 * vertices * 12 / 2


@pytest.mark.slow
def test_real_head_every_expression_and_50_poses(writing: Writing) -> None:
    parts = load("ict", shared("ict_facekit/ict_facekit.npz")).parts
    file, _ = writing(parts)
    check_agreement(parts, file, poses=50)


@pytest.mark.parametrize("influences", [4, 8])
@pytest.mark.parametrize(
    ("poses", "options"), [(5, {}), pytest.param(50, {"animations": True}, marks=pytest.mark.slow)], ids=["5", "50"]
)
def test_real_head_with_bones(poses: int, options: dict[str, bool], influences: int, writing: Writing) -> None:
    parts = load("makehuman", shared("makehuman/makehuman_head.npz")).parts
    file, report = writing(parts, influences=influences, **options)
    assert report.counts["joints"] == 77
    check_agreement(parts, file, poses=poses, influences=influences)


def test_a_triangle_has_its_three_points(writing: Writing) -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])
    mesh = Mesh(name="Sheet", points=points, face_vertex_counts=[3], face_vertex_indices=[0, 1, 2])
    file, _ = writing(FaceParts(name="Face", meshes=(mesh,), meters_per_unit=1.0))
    (primitive,) = file.list("meshes")[0]["primitives"]
    np.testing.assert_array_equal(file.decoded(primitive["attributes"]["POSITION"]), points.astype(np.float32))
    assert file.decoded(primitive["indices"]).ravel().tolist() == [0, 1, 2]
