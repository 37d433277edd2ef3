"""The ONNX deformer: what a graph computes, what it is made of, and what its metadata says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnx
import pytest
from facepipe_onnx import Deformer, Options, export, export_parts, outputs, validate
from facepipe_onnx.graph import build as build_graph
from faces import grid_mesh, replace_mesh, tiny_face, with_meshes
from import_data import shared
from oracle import random_coefficients

from facepipe.core.errors import ExportError, InputError
from facepipe.importers import load
from facepipe.parts import Blendshape, BoneLimits, FaceParts, Skeleton, Skin, Slider
from facepipe.rig import Rig, build
from facepipe.stage import Face

TOLERANCE = 1e-5
ALLOWED = set(
    "Clip Gemm MatMul Add Sub Mul Relu Tanh Sigmoid Sin Cos Concat Slice Reshape Transpose Gather".split()  # noqa: SIM905
)


class Made(NamedTuple):
    rig: Rig
    deformer: Deformer
    height: float
    mm: float  # stage units


def made(parts: FaceParts, folder: Path, **options: object) -> Made:
    export_parts(parts, folder / "face.onnx", Options(**options))  # type: ignore[arg-type]
    rig = build(parts)
    height = float(np.ptp(rig.evaluate()[:, 1]))
    return Made(rig, Deformer(folder / "face.onnx"), height, 0.001 / parts.meters_per_unit)


def random_pose(one: Made, rng: np.random.Generator) -> tuple[dict[str, float], np.ndarray | None]:
    weights = {name: float(rng.uniform(-0.2, 1.3)) for name in one.rig.shapes}
    joints = len(one.rig.joints)
    return weights, random_coefficients(rng, joints, 10 * one.mm) if joints else None


def error(one: Made, weights: dict[str, float] | None, coefficients: np.ndarray | None = None) -> float:
    """Largest difference to the rig in head heights."""
    points = one.deformer.evaluate(weights, coefficients=coefficients)["points"]
    return float(np.abs(points - one.rig.evaluate(weights, coefficients=coefficients)).max() / one.height)


def check_agreement(one: Made, shapes: int | None = None, poses: int = 50) -> None:
    rng = np.random.default_rng(5)
    assert error(one, None) < TOLERANCE
    for name in one.rig.shapes[:: 1 if shapes is None else -(-len(one.rig.shapes) // shapes)]:
        assert error(one, {name: 1.0}) < TOLERANCE, name
    assert max(error(one, *random_pose(one, rng)) for _ in range(poses)) < TOLERANCE


def test_agrees_on_a_skinned_face_with_inbetweens(tmp_path: Path) -> None:
    one = made(tiny_face(), tmp_path)
    check_agreement(one)
    for weight in np.linspace(-0.2, 1.3, 31):
        assert error(one, {"jawOpen": float(weight)}) < TOLERANCE


def test_inbetween_below_zero(tmp_path: Path) -> None:
    parts = tiny_face()
    head = parts.meshes[0]
    jaw = head.blendshapes[0]
    below = replace(jaw.inbetweens[0], name="below", weight=-0.4)
    shapes = (replace(jaw, inbetweens=(below, *jaw.inbetweens)), *head.blendshapes[1:])
    one = made(replace(parts, meshes=(replace_mesh(head, blendshapes=shapes),)), tmp_path)
    for weight in np.linspace(-1.0, 1.5, 26):
        assert error(one, {"jawOpen": float(weight)}) < TOLERANCE


@pytest.mark.parametrize("poses", [50, pytest.param(400, marks=pytest.mark.slow)])
def test_agrees_on_makehuman(tmp_path: Path, poses: int) -> None:
    parts = load("makehuman", shared("makehuman/makehuman_head.npz")).parts
    one = made(parts, tmp_path)
    assert np.diff(one.rig.influences.indptr).max() == 9
    check_agreement(one, poses=poses)


@pytest.mark.parametrize("shapes", [8, pytest.param(None, marks=pytest.mark.slow)])
def test_agrees_on_ict(tmp_path: Path, shapes: int | None) -> None:
    one = made(load("ict", shared("ict_facekit/ict_facekit.npz")).parts, tmp_path)
    assert (len(one.rig.points), len(one.rig.shapes)) == (26719, 53)
    check_agreement(one, shapes, poses=10 if shapes else 50)


def test_far_from_the_origin_stays_precise(tmp_path: Path) -> None:
    """A head on a body: ten times its own height above the floor."""
    parts = tiny_face()
    up = np.eye(4)
    up[1, 3] = 10 * np.ptp(parts.meshes[0].points[:, 1])
    skeleton = parts.skeleton
    rest = skeleton.rest_transforms.copy()
    rest[0] = up @ rest[0]
    binds = up @ skeleton.bind_transforms
    meshes = []
    for mesh in parts.meshes:
        skin = replace(mesh.skin, geom_bind_transform=up) if mesh.skin else None
        meshes.append(replace_mesh(mesh, skin=skin, transform=up))
    moved = replace(
        parts,
        skeleton=Skeleton(joints=skeleton.joints, bind_transforms=binds, rest_transforms=rest),
        meshes=tuple(meshes),
    )
    check_agreement(made(moved, tmp_path))


def test_skeleton_elsewhere_without_joints(tmp_path: Path) -> None:
    """Blendshapes alone on a face that its skeleton turns, stretches and moves."""
    turned = np.eye(4)
    turned[:3, :3] = [[0.0, -2.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.5]]
    turned[:3, 3] = (1.0, -2.0, 3.0)
    parts = with_meshes(tiny_face(), skin=None, transform=turned)
    one = made(replace(parts, skeleton=Skeleton(transform=turned)), tmp_path)
    assert [graph_input["name"] for graph_input in one.deformer.metadata["inputs"]] == ["weights"]
    check_agreement(one)


def test_joints_alone(tmp_path: Path) -> None:
    parts = tiny_face()
    bare = with_meshes(parts, blendshapes=())
    one = made(bare, tmp_path)
    assert [graph_input["name"] for graph_input in one.deformer.metadata["inputs"]] == ["coefficients"]
    check_agreement(one)


def test_parent_input(tmp_path: Path) -> None:
    one = made(tiny_face(), tmp_path, parent=True, joint_matrices=True)
    rng = np.random.default_rng(3)
    for _ in range(20):
        weights, coefficients = random_pose(one, rng)
        parent = np.eye(4)
        parent[:3] = rng.normal(size=(3, 4))
        found = one.deformer.evaluate(weights, coefficients=coefficients, parent=parent)
        points = one.rig.evaluate(weights, coefficients=coefficients, parent_world=parent)
        worlds = one.rig.joint_worlds(one.rig.local_transforms(coefficients), parent)
        assert np.abs(found["points"] - points).max() < TOLERANCE * one.height
        assert np.abs(found["joint_matrices"] - worlds).max() < TOLERANCE * one.height
    assert error(one, weights, coefficients) < TOLERANCE  # default: the skeleton's own place


def test_parent_moves_a_face_without_joints(tmp_path: Path) -> None:
    parts = replace(tiny_face(), skeleton=Skeleton())
    one = made(with_meshes(parts, skin=None), tmp_path, parent=True)
    parent = np.eye(4)
    parent[:3] = np.random.default_rng(4).normal(size=(3, 4))
    found = one.deformer.evaluate({"jawOpen": 0.7}, parent=parent)["points"]
    assert np.abs(found - one.rig.evaluate({"jawOpen": 0.7}, parent_world=parent)).max() < TOLERANCE * one.height


def test_matrix_inputs_take_shear(tmp_path: Path) -> None:
    one = made(tiny_face(), tmp_path, inputs="matrices")
    rng = np.random.default_rng(6)
    local = one.rig.rest.copy()
    local[:, :3] += 0.3 * rng.normal(size=(3, 3, 4))
    found = one.deformer.evaluate({"mouthSmileLeft": 0.4}, joint_transforms=local)["points"]
    expected = one.rig.evaluate({"mouthSmileLeft": 0.4}, joint_transforms=local)
    assert np.abs(found - expected).max() < TOLERANCE * one.height
    assert error(one, {"jawOpen": 0.3}) < TOLERANCE  # default: rest


def test_normals_are_those_of_the_points(tmp_path: Path) -> None:
    from facepipe.geometry.polygons import point_normals, point_triangles

    parts = tiny_face()
    loose = grid_mesh("Loose", 2, 3.0)
    lost = replace_mesh(
        loose, face_vertex_counts=np.zeros(0, np.int32), face_vertex_indices=np.zeros(0, np.int32), uv_sets=()
    )
    one = made(replace(parts, meshes=(*parts.meshes, lost)), tmp_path, normals=True)
    found = one.deformer.evaluate(*random_pose(one, np.random.default_rng(2))[:1])
    for mesh, name in zip(parts.meshes, one.rig.mesh_names, strict=False):
        triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
        points = one.rig.split(found["points"])[name].astype(np.float64)
        expected = point_normals(points, triangles)
        assert np.abs(one.rig.split(found["normals"])[name] - expected).max() < 1e-4
    assert np.array_equal(one.rig.split(found["normals"])["Loose"], np.tile([0.0, 1.0, 0.0], (4, 1)))
    further = one.deformer.metadata["further_operators"]
    assert set(further) == set(one.deformer.metadata["operators"]) - ALLOWED == {"Div", "Sqrt"}
    assert validate(tmp_path / "face.onnx") == ()


def test_batch_is_the_poses_one_by_one(tmp_path: Path) -> None:
    one = made(tiny_face(), tmp_path, batch=3, parent=True, normals=True, joint_matrices=True)
    rng = np.random.default_rng(8)
    weights = rng.uniform(-0.2, 1.3, (3, len(one.rig.shapes)))
    coefficients = np.stack([random_coefficients(rng, 3, 0.5) for _ in range(3)])
    parents = np.tile(np.eye(4), (3, 1, 1))
    parents[:, :3] += rng.normal(size=(3, 3, 4))
    found = one.deformer.run({"weights": weights, "coefficients": coefficients, "parent": parents})
    (tmp_path / "single").mkdir()
    single = made(tiny_face(), tmp_path / "single", parent=True, normals=True, joint_matrices=True)
    for i in range(3):
        expected = one.rig.evaluate(weights[i], coefficients=coefficients[i], parent_world=parents[i])
        assert np.abs(found["points"][i] - expected).max() < TOLERANCE * one.height * np.abs(parents).max()
        alone = single.deformer.run({"weights": weights[i], "coefficients": coefficients[i], "parent": parents[i]})
        for name, values in alone.items():
            assert np.allclose(found[name][i], values[0], atol=1e-4), name


def test_graph_keeps_to_the_convention(tmp_path: Path) -> None:
    options = {"parent": True, "joint_matrices": True}
    for kind in ("coefficients", "matrices"):
        export_parts(tiny_face(), tmp_path / "face.onnx", Options(inputs=kind, **options))  # type: ignore[arg-type]
        model = onnx.load(tmp_path / "face.onnx")
        onnx.checker.check_model(model, full_check=True)
        assert model.ir_version == 8
        assert [(one.domain, one.version) for one in model.opset_import] == [("", 15)]
        assert {node.op_type for node in model.graph.node} <= ALLOWED
        assert {value.type.tensor_type.elem_type for value in (*model.graph.input, *model.graph.output)} == {1}
        assert validate(tmp_path / "face.onnx") == ()


def test_same_face_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        export_parts(tiny_face(), tmp_path / name / "face.onnx")
    for file in ("face.onnx", "face.onnx.json"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    assert str(tmp_path).encode() not in (tmp_path / "a" / "face.onnx").read_bytes()


def test_sidecar_is_the_metadata(tmp_path: Path) -> None:
    parts = tiny_face()
    limits = BoneLimits(lower=np.full((3, 9), -0.5), upper=np.full((3, 9), 2.0))
    slider = Slider(name="jaw", channels=(("root/jaw", "rx", 0.5),), shapes=(("jawOpen", 1.0),))
    report = export_parts(replace(parts, bone_limits=limits, sliders=(slider,)), tmp_path / "face.onnx")
    beside = json.loads((tmp_path / "face.onnx.json").read_text())
    stored = {prop.key: json.loads(prop.value) for prop in onnx.load(tmp_path / "face.onnx").metadata_props}
    assert stored == {f"facepipe.{key}": value for key, value in beside.items()}
    weights, coefficients = beside["inputs"]
    assert weights["names"] == list(build(parts).shapes)
    assert (weights["range"], weights["default"]) == ([0.0, 1.0], 0.0)
    assert coefficients["joints"] == list(parts.skeleton.joints)
    assert coefficients["limits"] == {"lower": limits.lower.tolist(), "upper": limits.upper.tolist()}
    assert beside["meshes"] == [
        {"name": "Head", "first": 0, "count": 36},
        {"name": "Teeth", "first": 36, "count": 9},
    ]
    assert beside["face"]["head_height"] == pytest.approx(np.ptp(build(parts).evaluate()[:, 1]))
    assert beside["sliders"][0]["name"] == "jaw"
    assert report.files == (tmp_path / "face.onnx", tmp_path / "face.onnx.json")
    assert report.bytes == (tmp_path / "face.onnx").stat().st_size


def test_outputs_are_the_files_that_export_writes(tmp_path: Path) -> None:
    report = export_parts(tiny_face(), tmp_path / "k.onnx")
    assert outputs(tmp_path / "k.onnx") == report.files == tuple(sorted(tmp_path.iterdir()))
    with pytest.raises(InputError, match=r"expected .onnx"):
        outputs(tmp_path / "k.glb")


def test_report_names_what_is_left_out(tmp_path: Path) -> None:
    dropped = export(Face.from_parts(tiny_face()), tmp_path / "face.onnx").dropped
    assert dropped == ("UV sets: 2", "blendshapes with normal offsets: 1", "regions: 3", "landmark schemes: 1")


def test_shape_globs(tmp_path: Path) -> None:
    one = made(tiny_face(), tmp_path, shapes="mouth*, jaw*")
    assert one.deformer.shapes == one.rig.shapes
    one = made(tiny_face(), tmp_path, shapes="mouth*")
    assert one.deformer.shapes == ("mouthSmileLeft",)
    assert error(one, {"mouthSmileLeft": 0.8}) < TOLERANCE
    one = made(tiny_face(), tmp_path, shapes="")
    assert one.deformer.shapes == ()
    assert error(one, {}, random_coefficients(np.random.default_rng(0), 3, one.mm)) < TOLERANCE
    with pytest.raises(InputError, match=r"shapes: 'brow\*' matches none of 2"):
        export_parts(tiny_face(), tmp_path / "face.onnx", Options(shapes="brow*"))


def local_shapes(count: int, reach: int, size: int = 60, still: int = 0) -> FaceParts:
    """A grid with `count` shapes that move `reach` points each, and `still` ones that move none."""
    rng = np.random.default_rng(9)
    mesh = grid_mesh(size=size)
    shapes = []
    for i in range(count):
        start = int(rng.integers(0, size * size - reach))
        points = np.arange(start, start + reach, dtype=np.int32)
        shapes.append(Blendshape(name=f"shape{i}", point_indices=points, offsets=rng.normal(size=(reach, 3))))
    for i in range(still):
        everywhere = np.arange(size * size, dtype=np.int32)
        shapes.append(Blendshape(name=f"still{i}", point_indices=everywhere, offsets=np.zeros((size * size, 3))))
    return FaceParts(meshes=(replace_mesh(mesh, blendshapes=tuple(shapes)),))


def test_size_follows_the_deltas_that_are_not_zero() -> None:
    def size(parts: FaceParts) -> int:
        return int(build_graph(build(parts)).ByteSize())

    plain = size(local_shapes(40, 90))
    assert size(local_shapes(40, 90, still=40)) < 1.05 * plain
    dense = 40 * 3600 * 12
    assert plain < 0.5 * dense
    assert size(local_shapes(40, 3599)) > 0.9 * dense
    assert plain < size(local_shapes(40, 360))


def test_rotations_are_made_of_the_products_that_are_not_zero() -> None:
    """Of 81 products of Rz[i, k], Rx[k, l] and Ry[l, j], 13 are not zero; three more columns are the translation."""
    graph = build_graph(build(tiny_face())).graph
    shapes = {tensor.name: tuple(tensor.dims) for tensor in graph.initializer}
    assert (shapes["scales"], shapes["entries"]) == ((9, 13 + 3), (13 + 3, 16))


def test_scattered_points_agree(tmp_path: Path) -> None:
    """Point order without any locality: groups of single points, in an order of their own."""
    parts = local_shapes(30, 400)
    order = np.random.default_rng(0).permutation(3600).astype(np.int32)
    mesh = parts.meshes[0]
    shapes = []
    for shape in mesh.blendshapes:
        indices = order[shape.point_indices]
        ascending = np.argsort(indices)
        shapes.append(replace(shape, point_indices=indices[ascending], offsets=shape.offsets[ascending]))
    check_agreement(made(replace(parts, meshes=(replace_mesh(mesh, blendshapes=tuple(shapes)),)), tmp_path))


def test_many_joints_in_a_deep_tree(tmp_path: Path) -> None:
    rng = np.random.default_rng(12)
    names, rest, binds = ["j0"], [np.eye(4)], [np.eye(4)]
    for i in range(1, 60):
        parent = max(0, i - int(rng.integers(1, 4)))
        local = np.eye(4)
        local[:3, 3] = rng.normal(size=3) * 0.3
        names.append(f"{names[parent]}/j{i}")
        rest.append(local)
        binds.append(binds[parent] @ local)
    mesh = grid_mesh(size=30)
    weights = rng.random((900, 5)) ** 4
    first = np.arange(900) // 20
    indices = (first[:, None] + np.arange(5)).astype(np.int32)
    skin = Skin(joint_indices=indices, joint_weights=weights / weights.sum(axis=1, keepdims=True))
    skeleton = Skeleton(joints=tuple(names), bind_transforms=np.array(binds), rest_transforms=np.array(rest))
    parts = FaceParts(meshes=(replace_mesh(mesh, skin=skin),), skeleton=skeleton)
    one = made(parts, tmp_path, joint_matrices=True)
    rng = np.random.default_rng(1)
    for _ in range(10):
        coefficients = random_coefficients(rng, 60, 0.01, 0.1)
        coefficients[:, 6:] = rng.uniform(0.97, 1.03, (60, 3))
        assert error(one, None, coefficients) < TOLERANCE
        worlds = one.rig.joint_worlds(one.rig.local_transforms(coefficients))
        found = one.deformer.evaluate(coefficients=coefficients)["joint_matrices"]
        assert np.abs(found - worlds).max() < TOLERANCE * one.height


def test_numbers_that_are_not_finite_are_named_by_their_place(tmp_path: Path) -> None:
    face = tiny_face()
    head = face.meshes[0]
    assert head.skin is not None
    weights = head.skin.joint_weights.copy()
    weights[3, 1] = np.nan
    skin = replace(head.skin, joint_weights=weights)
    shape = replace(head.blendshapes[0], offsets=np.full((4, 3), np.inf))
    limits = BoneLimits(lower=np.full((3, 9), -np.inf), upper=np.zeros((3, 9)))
    broken = {
        "Tiny -> Head -> skin -> joint_weights": replace(face, meshes=(replace_mesh(head, skin=skin),)),
        "Tiny -> Head -> jawOpen -> offsets": replace(face, meshes=(replace_mesh(head, blendshapes=(shape,)),)),
        "Tiny -> bone_limits -> lower": replace(face, bone_limits=limits),
        "Tiny -> open -> shapes": replace(face, sliders=(Slider(name="open", shapes=(("jawOpen", np.nan),)),)),
        "Tiny -> meters_per_unit": replace(face, meters_per_unit=np.nan),
    }
    for where, parts in broken.items():
        with pytest.raises(ExportError) as caught:
            export_parts(parts, tmp_path / "face.onnx")
        assert caught.value.where == where
    assert list(tmp_path.iterdir()) == []


def test_what_can_not_be_exported(tmp_path: Path) -> None:
    still = FaceParts(meshes=(grid_mesh(),))
    with pytest.raises(ExportError, match="no blendshapes"):
        export_parts(still, tmp_path / "face.onnx")
    with pytest.raises(ExportError, match="no points"):
        export_parts(FaceParts(), tmp_path / "face.onnx")
    with pytest.raises(ExportError, match="no joints"):
        export_parts(local_shapes(1, 5), tmp_path / "face.onnx", Options(joint_matrices=True))
    with pytest.raises(InputError, match=r"\.onnx"):
        export_parts(tiny_face(), tmp_path / "face.glb")
    with pytest.raises(InputError, match="batch"):
        export_parts(tiny_face(), tmp_path / "face.onnx", Options(batch=0))
    huge = replace(
        still,
        meshes=(
            replace_mesh(
                grid_mesh(),
                blendshapes=(Blendshape(name="far", point_indices=np.array([0]), offsets=np.full((1, 3), 1e39)),),
            ),
        ),
    )
    with pytest.raises(ExportError, match="float32"):
        export_parts(huge, tmp_path / "face.onnx")
    assert list(tmp_path.iterdir()) == []
