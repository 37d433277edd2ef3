"""The glTF importer against models whose geometry, deformation and materials are known."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import done
from facepipe_gltf import read as gltf
from gltf_builder import PNG, Array, Builder, Model, animated, build, glb, make_model, matrix, quaternion
from gltf_reader import read as read_gltf
from places import SHARED
from pxr import Usd, UsdSkel

from facepipe.core.errors import InputError
from facepipe.core.reading import digest
from facepipe.parts import Animation, FaceParts, Mesh, TextureInput, exact
from facepipe.stage import Face, save_parts
from facepipe.stage.recipes import Imported

SCAN = SHARED / "scans" / "LeePerrySmith.glb"
TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)


def read(tmp_path: Path, data: bytes | Builder, name: str = "face.glb", **options: Any) -> Imported:
    source = tmp_path / name
    source.write_bytes(data.glb() if isinstance(data, Builder) else data)
    return gltf.read(source, gltf.Options(**options))


def corners(mesh: Mesh, values: Array) -> Array:
    """Per-point values at the corners of every triangle."""
    return values[mesh.face_vertex_indices].reshape(-1, 3, *values.shape[1:])


def evaluate(parts: FaceParts, mesh: Mesh, weights: dict[str, float], local: Array) -> Array:
    """(n, 3) points by DESIGN section 7: blendshapes, then skin; `local` (j, 4, 4) joint transforms."""
    points = np.array(mesh.points, np.float64)
    for shape in mesh.blendshapes:
        points[shape.point_indices] += weights.get(shape.name, 0.0) * shape.offsets
    if mesh.skin is None:
        return points @ mesh.transform[:3, :3].T + mesh.transform[:3, 3]
    worlds: list[Array] = []
    for parent, one in zip(parts.skeleton.parents, local, strict=True):
        worlds.append(one if parent < 0 else worlds[parent] @ one)
    matrices = np.array(worlds) @ np.linalg.inv(parts.skeleton.bind_transforms) @ mesh.skin.geom_bind_transform
    blended = np.einsum("nk,nkij->nij", mesh.skin.joint_weights, matrices[mesh.skin.joint_indices])
    return np.einsum("nij,nj->ni", blended[:, :3, :3], points) + blended[:, :3, 3]


def pose(parts: FaceParts, animation: Animation, at: int) -> Array:
    """(j, 4, 4) local transforms of one sample, rest where the animation is silent."""
    local = np.array(parts.skeleton.rest_transforms)
    for i, joint in enumerate(animation.joints):
        trs = (animation.translations[at, i], animation.rotations[at, i], animation.scales[at, i])  # type: ignore[index]
        local[parts.skeleton.joints.index(joint)] = matrix(*trs)
    return local


def height(model: Model) -> float:
    return float(np.ptp(model.positions, axis=0).max())


def triangle(**extra: Any) -> Builder:
    """One triangle in one node."""
    builder = Builder()
    primitive = {"attributes": {"POSITION": builder.array(TRIANGLE)}}
    builder.add("meshes", {"primitives": [primitive]})
    builder.add("nodes", {"mesh": 0})
    builder.root.update(extra)
    return builder


# real data


@pytest.mark.skipif(not SCAN.is_file(), reason=f"no real scan at {SCAN}")
def test_scan_is_welded_into_one_closed_surface() -> None:
    imported = gltf.read(SCAN, gltf.Options())
    raw = gltf.read(SCAN, gltf.Options(weld=False)).parts.meshes[0]
    (mesh,) = imported.parts.meshes
    assert imported.warnings == ()
    assert (mesh.name, len(mesh.points), len(mesh.face_vertex_counts)) == ("LeePerrySmith", 8844, 17684)
    assert len(raw.points) == 9279
    edges = np.sort(
        np.stack([mesh.face_vertex_indices, np.roll(mesh.face_vertex_indices.reshape(-1, 3), -1, 1).ravel()], 1)
    )
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()  # closed
    assert len(mesh.points) - len(edges) // 2 + len(mesh.face_vertex_counts) == 2  # genus 0
    assert np.array_equal(corners(mesh, mesh.points), corners(raw, raw.points))
    welded, plain = mesh.uv_sets[0], raw.uv_sets[0]
    assert welded.indices is not None
    assert plain.indices is None
    assert np.array_equal(welded.values[welded.indices], plain.values[raw.face_vertex_indices])


# deformation


@pytest.mark.parametrize("encoding", ["plain", "odd"])
def test_rest_and_shapes_deform_as_gltf_says(tmp_path: Path, encoding: str) -> None:
    model = make_model()
    imported = read(tmp_path, build(model, encoding=encoding))
    parts, (mesh,) = imported.parts, imported.parts.meshes
    assert imported.warnings == ()
    assert (parts.meters_per_unit, parts.up_axis) == (1.0, "Y")
    assert len(mesh.points) == 48
    assert mesh.skin is not None
    assert mesh.skin.joint_indices.shape == (48, 8)
    assert parts.skeleton.joints[:3] == ("root", "root/jaw", "root/skull")
    assert parts.skeleton.joints[3:5] == ("root/skull/eye", "root/skull/eye_2")
    for weights in [*np.eye(3), np.array([0.3, 1.2, -0.5])]:
        expected = model.evaluate(weights, model.trs)[model.triangles]
        got = evaluate(parts, mesh, dict(zip(model.names, weights, strict=True)), parts.skeleton.rest_transforms)
        assert np.abs(corners(mesh, got) - expected).max() < 1e-6 * height(model)


def test_encodings_of_the_same_values_read_the_same(tmp_path: Path) -> None:
    model = make_model()
    plain, odd = (read(tmp_path, build(model, encoding=encoding)).parts.meshes[0] for encoding in ("plain", "odd"))
    assert np.array_equal(plain.points, odd.points)
    for one, other in zip(plain.blendshapes, odd.blendshapes, strict=True):
        assert np.array_equal(one.point_indices, other.point_indices)
        assert np.array_equal(one.offsets, other.offsets)


def test_a_buffer_may_hold_one_byte(tmp_path: Path) -> None:
    """The index of the one point that a sparse accessor moves."""
    builder = triangle()
    moved = np.array([[0, 2, 0]], np.float32)
    entry = builder.add("bufferViews", {"buffer": 1, "byteLength": 1})
    builder.root["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": entry, "componentType": 5121},
        "values": {"bufferView": builder.view(moved.tobytes())},
    }
    uri = "data:application/octet-stream;base64," + base64.b64encode(b"\2").decode()
    builder.root["buffers"] = [{"byteLength": len(builder.binary)}, {"byteLength": 1, "uri": uri}]
    (mesh,) = read(tmp_path, glb(builder.root, bytes(builder.binary))).parts.meshes
    np.testing.assert_array_equal(mesh.points, np.concatenate([TRIANGLE[:2], moved]))


def test_shapes_hold_moved_points_only(tmp_path: Path) -> None:
    model = make_model()
    (mesh,) = read(tmp_path, build(model)).parts.meshes
    for shape, target in zip(mesh.blendshapes, model.targets, strict=True):
        assert len(shape.point_indices) == np.count_nonzero(np.any(target[:48] != 0, axis=1))
        assert np.all(np.diff(shape.point_indices) > 0)
        assert np.all(np.any(shape.offsets != 0, axis=1))


Tracks = dict[tuple[int, str], Callable[[float], Array]]


def test_animation_moves_points_as_gltf_says(tmp_path: Path) -> None:
    model = make_model()
    builder, times, tracks = animated(model)
    parts = read(tmp_path, builder).parts
    (animation,), (mesh,) = parts.animations, parts.meshes
    assert animation.name == "talk"
    assert animation.times is not None
    keys = [int(np.abs(animation.times - at).argmin()) for at in times]
    assert np.abs(animation.times[keys] - times).max() < 1e-6
    assert animation.shape_weights is not None
    for i, at in zip(keys, times, strict=True):
        named = dict(zip(animation.shapes, animation.shape_weights[i], strict=True))
        got = evaluate(parts, mesh, named, pose(parts, animation, i))
        assert np.abs(corners(mesh, got) - moved(model, tracks, at)).max() < 1e-5 * height(model)


def moved(model: Model, tracks: dict[tuple[int, str], Callable[[float], Array]], at: float) -> Array:
    """Corners of the model at a time, as the channels say."""
    trs = [
        tuple(
            tracks[node, path](at) if (node, path) in tracks else rest
            for path, rest in zip(("translation", "rotation", "scale"), model.trs[node], strict=True)
        )
        for node in range(len(model.trs))
    ]
    return model.evaluate(tracks[11, "weights"](at), trs)[model.triangles]  # type: ignore[arg-type]


def at_any_time(imported: Imported, folder: Path, model: Model, tracks: Tracks, times: Array) -> Array:
    """How far points are from what the channels say when USD interpolates the saved face, in head heights."""
    parts, stage_file = imported.parts, folder / "again.usda"
    save_parts(parts, stage_file)
    stage = Usd.Stage.Open(str(stage_file))
    root = UsdSkel.Root(stage.GetDefaultPrim())
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    skeleton = next(UsdSkel.Skeleton(one) for one in stage.Traverse() if one.IsA(UsdSkel.Skeleton))
    query = cache.GetSkelQuery(skeleton)
    playing = query.GetAnimQuery()
    assert playing.GetPrim().GetName() == "talk"
    names = list(playing.GetBlendShapeOrder())
    off = []
    for at in times:
        code = at * stage.GetTimeCodesPerSecond()
        local = np.swapaxes(np.array(query.ComputeJointLocalTransforms(code)), 1, 2)
        weights = dict(zip(names, playing.ComputeBlendShapeWeights(code), strict=True))
        got = corners(parts.meshes[0], evaluate(parts, parts.meshes[0], weights, local))
        off.append(np.abs(got - moved(model, tracks, at)).max() / height(model))
    return np.array(off)


def test_a_joint_that_a_matrix_places_moves_as_one_of_parts(tmp_path: Path) -> None:
    model = make_model()

    def moved(placed: Any) -> Array:
        builder = build(model)
        builder.root["nodes"][1] = {"name": "root", "children": [2], **placed}
        keys = builder.array(np.array([[0.1, 0.2, 0.3]]))
        sampler = {"input": builder.array(np.array([0.0])), "output": keys}
        channels = [{"sampler": 0, "target": {"node": 1, "path": "translation"}}]
        builder.add("animations", {"channels": channels, "samplers": [sampler], "name": "slide"})
        parts = read(tmp_path, builder).parts
        return pose(parts, parts.animations[0], 0)

    names = ("translation", "rotation", "scale")
    parts = {name: value.tolist() for name, value in zip(names, model.trs[1], strict=True)}
    by_matrix = moved({"matrix": matrix(*model.trs[1]).T.ravel().tolist()})
    np.testing.assert_allclose(by_matrix, moved(parts), rtol=0, atol=1e-6)


def test_an_animation_of_lines_alone_is_read_without_a_warning(tmp_path: Path) -> None:
    builder, *_ = animated(make_model())
    (animation,) = builder.root["animations"]
    straight = [number for number, one in enumerate(animation["samplers"]) if one["interpolation"] == "LINEAR"]
    animation["channels"] = [one for one in animation["channels"] if one["sampler"] in straight]
    assert read(tmp_path, builder).warnings == ()


def test_steps_and_curves_mean_the_same_at_any_time_in_usd(tmp_path: Path) -> None:
    model = make_model()
    builder, _, tracks = animated(model)
    imported = read(tmp_path, builder)
    assert any("held until 0.98 ms before" in line for line in imported.warnings)
    assert any("CUBICSPLINE keys became lines: off by at most" in line for line in imported.warnings)
    times = np.random.default_rng(8).random(200)
    times = np.concatenate([times[(times < 0.398) | (times > 0.4)], [0.3989, 0.4001]])  # STEP changes at 0.4
    assert at_any_time(imported, tmp_path, model, tracks, times).max() < 1.5e-3
    assert at_any_time(imported, tmp_path, model, tracks, np.array([0.3995])).max() > 1e-2  # where it changes


def test_animations_are_sampled_at_a_frame_rate(tmp_path: Path) -> None:
    model = make_model()
    builder, _, tracks = animated(model)
    imported = read(tmp_path, builder, fps=40.0)
    (animation,) = imported.parts.animations
    assert imported.parts.frames_per_second == 40.0
    assert animation.times is not None
    assert animation.times.tolist() == [frame / 40 for frame in range(41)]
    assert animation.shape_weights is not None
    for i, at in enumerate(animation.times):
        named = dict(zip(animation.shapes, animation.shape_weights[i], strict=True))
        got = evaluate(imported.parts, imported.parts.meshes[0], named, pose(imported.parts, animation, i))
        assert np.abs(corners(imported.parts.meshes[0], got) - moved(model, tracks, at)).max() < 1e-5 * height(model)
    assert any("sampled at 40 frames per second: off by at most" in line for line in imported.warnings)


@pytest.mark.parametrize(("times", "rate"), [([0.0, 1 / 30, 2.0], 30), ([7 / 25], 25), ([0.0, 0.5], 24), ([0.013], 24)])
def test_the_frame_rate_is_that_which_all_keys_fall_on(times: list[float], rate: float, tmp_path: Path) -> None:
    builder = build(make_model())
    sampler = {"input": builder.array(np.array(times)), "output": builder.array(np.zeros((len(times), 3)))}
    channels = [{"sampler": 0, "target": {"node": 1, "path": "translation"}}]
    builder.add("animations", {"channels": channels, "samplers": [sampler], "name": "slide"})
    parts = read(tmp_path, builder).parts
    assert parts.frames_per_second == rate
    assert parts.played == ("slide" if len(times) > 1 else None)  # one key is a pose
    if len(times) > 1 and parts.animations[0].times is not None:
        assert (parts.animations[0].times * rate % 1 == 0).all()


def test_a_mesh_that_two_nodes_play_differently_has_shapes_of_its_own_for_each(tmp_path: Path) -> None:
    builder = triangle()
    builder.root["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": builder.array(TRIANGLE)}] * 2
    builder.root["meshes"][0]["extras"] = {"targetNames": ["smile", "frown"]}
    builder.add("nodes", {"mesh": 0})
    times = builder.array(np.array([0.0, 1.0]))
    keys = ([0.0, 0.0, 1.0, 0.25], [0.0, 0.0, 0.5, 0.25])
    samplers = [{"input": times, "output": builder.array(np.array(weights))} for weights in keys]
    channels = [{"sampler": i, "target": {"node": i, "path": "weights"}} for i in range(2)]
    builder.add("animations", {"channels": channels, "samplers": samplers, "name": "talk"})
    imported = read(tmp_path, builder)
    first, second = imported.parts.meshes
    assert [shape.name for shape in first.blendshapes] == ["smile", "frown"]
    assert [shape.name for shape in second.blendshapes] == ["smile_2", "frown"]
    (animation,) = imported.parts.animations
    assert animation.shape_weights is not None
    assert animation.shapes == ("smile", "frown", "smile_2")
    np.testing.assert_array_equal(animation.shape_weights[-1], [1.0, 0.25, 0.5])
    assert imported.warnings == (
        "face.glb -> nodes[1]: shows 1 shapes otherwise than an earlier node: smile is smile_2",
    )


def test_a_mesh_shown_again_without_motion_stands_still(tmp_path: Path) -> None:
    builder = triangle()
    builder.root["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": builder.array(TRIANGLE)}]
    builder.root["meshes"][0]["extras"] = {"targetNames": ["smile"]}
    builder.add("nodes", {"mesh": 0})
    sampler = {"input": builder.array(np.array([0.0, 1.0])), "output": builder.array(np.array([0.0, 1.0]))}
    channels = [{"sampler": 0, "target": {"node": 0, "path": "weights"}}]
    builder.add("animations", {"channels": channels, "samplers": [sampler], "name": "talk"})
    parts = read(tmp_path, builder).parts
    assert [mesh.blendshapes[0].name for mesh in parts.meshes] == ["smile", "smile_2"]
    assert parts.animations[0].shapes == ("smile",)


def test_animation_of_other_nodes_is_named_in_a_warning(tmp_path: Path) -> None:
    builder = build(make_model())
    lamp = builder.add("nodes", {"name": "lamp"})
    sampler = {"input": builder.array(np.array([0.0, 1.0])), "output": builder.array(np.zeros((2, 3)))}
    channels = [{"sampler": 0, "target": {"node": lamp, "path": "translation"}}]
    builder.add("animations", {"channels": channels, "samplers": [sampler]})
    imported = read(tmp_path, builder)
    assert imported.parts.animations == ()
    assert any("animations[0]: 1 channels" in line for line in imported.warnings)


@pytest.mark.parametrize("node", [0, 2])
def test_nodes_that_move_above_and_between_joints_are_joints(node: int, tmp_path: Path) -> None:
    """The armature (0) and a node between two joints (2), turned and moved: every point as glTF says."""
    model = make_model()
    builder = build(model)
    generator = np.random.default_rng(4)
    turns = np.array([quaternion(generator) for _ in range(2)])
    times = builder.array(np.array([0.0, 1.0]))
    samplers = [{"input": times, "output": builder.array(turns)}]
    channels = [{"sampler": 0, "target": {"node": node, "path": "rotation"}}]
    builder.add("animations", {"channels": channels, "samplers": samplers, "name": "nod"})
    imported = read(tmp_path, builder)
    assert imported.warnings == ()
    assert len(imported.parts.skeleton.joints) == 10
    face, (mesh,) = Face.from_parts(imported.parts), imported.parts.meshes
    for index, turn in enumerate(turns):
        trs = [(t, turn if i == node else r, s) for i, (t, r, s) in enumerate(model.trs)]
        local, _ = face.sample("nod", index)
        got = face.evaluate(joint_transforms=local)
        expected = model.evaluate(np.zeros(3), trs)[model.triangles]
        assert np.abs(corners(mesh, got) - expected).max() < 1e-5 * height(model)


def test_a_rigid_node_that_moves_is_a_joint_of_its_mesh(tmp_path: Path) -> None:
    """A head without skin below a neck without mesh: both are joints, and a hat on the head goes with it."""
    builder = triangle()
    builder.root["nodes"] = [
        {"name": "neck", "translation": [0, 1, 0], "children": [1]},
        {"name": "Head", "mesh": 0, "translation": [0, 0.5, 0], "scale": [2, 2, 2], "children": [2]},
        {"name": "Hat", "mesh": 0, "translation": [0, 0.25, 0]},
    ]
    builder.root["scenes"] = [{"nodes": [0]}]
    turn = np.array([[0, 0, 0, 1.0], [0, 0, np.sin(0.4), np.cos(0.4)]])
    times = builder.array(np.array([0.0, 1.0]))
    samplers = [{"input": times, "output": builder.array(turn)}]
    channels = [{"sampler": 0, "target": {"node": i, "path": "rotation"}} for i in range(2)]
    builder.add("animations", {"channels": channels, "samplers": samplers, "name": "nod"})
    imported = read(tmp_path, builder)
    assert (imported.warnings, imported.parts.skeleton.joints) == ((), ("neck", "neck/Head"))
    face = Face.from_parts(imported.parts)
    for index, at in enumerate(turn):
        neck, head = matrix(np.array([0, 1, 0]), at, np.ones(3)), matrix(np.array([0, 0.5, 0]), at, np.full(3, 2.0))
        hat = neck @ head @ matrix(np.array([0, 0.25, 0]), turn[0], np.ones(3))
        local, _ = face.sample("nod", index)
        shown = face.split(face.evaluate(joint_transforms=local))
        for name, world in (("Head", neck @ head), ("Hat", hat)):
            expected = TRIANGLE @ world[:3, :3].T + world[:3, 3]
            np.testing.assert_allclose(np.sort(shown[name], axis=0), np.sort(expected, axis=0), atol=1e-6)


def test_a_rigid_node_that_grows_from_nothing(tmp_path: Path) -> None:
    """At rest it is flat, and has no inverse; what hangs on it grows with it."""
    builder = triangle()
    builder.root["nodes"] = [
        {"name": "Head", "mesh": 0, "scale": [0, 0, 0], "children": [1]},
        {"name": "Hat", "mesh": 0, "translation": [0, 0.25, 0]},
    ]
    builder.root["scenes"] = [{"nodes": [0]}]
    keys = builder.array(np.array([[0.0, 0.0, 0.0], [2.0, 2.0, 2.0]]))
    channels = [{"sampler": 0, "target": {"node": 0, "path": "scale"}}]
    samplers = [{"input": builder.array(np.array([0.0, 1.0])), "output": keys}]
    builder.add("animations", {"channels": channels, "samplers": samplers, "name": "grow"})
    face = Face.from_parts(read(tmp_path, builder).parts)
    for index, size in enumerate((0.0, 2.0)):
        local, _ = face.sample("grow", index)
        shown = face.split(face.evaluate(joint_transforms=local))
        for name, offset in (("Head", 0.0), ("Hat", 0.25)):
            expected = size * (TRIANGLE + np.array([0, offset, 0]))
            np.testing.assert_allclose(np.sort(shown[name], axis=0), np.sort(expected, axis=0), atol=1e-6)


@pytest.mark.parametrize(
    ("pointers", "width"),
    [(["/nodes/0/weights"], 2), (["/nodes/0/weights/1", "/nodes/0/weights/0"], 1), (["/meshes/0/weights"], 2)],
)
def test_pointers_to_weights(pointers: list[str], width: int, tmp_path: Path) -> None:
    builder = triangle()
    builder.root["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": builder.array(TRIANGLE)}] * 2
    builder.root["meshes"][0]["extras"] = {"targetNames": ["smile", "frown"]}
    times = builder.array(np.array([0.0, 1.0]))
    keys = np.array([[0.0, 0.25], [1.0, 0.5]])
    outputs = [keys] if width == 2 else [keys[:, 1:], keys[:, :1]]
    samplers = [{"input": times, "output": builder.array(one.reshape(-1))} for one in outputs]
    channels = [
        {"sampler": i, "target": {"path": "pointer", "extensions": {"KHR_animation_pointer": {"pointer": pointer}}}}
        for i, pointer in enumerate(pointers)
    ]
    builder.add("animations", {"channels": channels, "samplers": samplers, "name": "talk"})
    builder.root["extensionsUsed"] = builder.root["extensionsRequired"] = ["KHR_animation_pointer"]
    imported = read(tmp_path, builder)
    (animation,) = imported.parts.animations
    assert imported.warnings == ()
    columns = dict(zip(animation.shapes, np.asarray(animation.shape_weights).T, strict=True))
    np.testing.assert_array_equal(columns["smile"], keys[:, 0])
    np.testing.assert_array_equal(columns["frown"], keys[:, 1])


def test_a_pointer_to_nothing_we_have_is_left_out(tmp_path: Path) -> None:
    builder = triangle()
    sampler = {"input": builder.array(np.array([0.0, 1.0])), "output": builder.array(np.array([0.0, 1.0]))}
    target = {"path": "pointer", "extensions": {"KHR_animation_pointer": {"pointer": "/materials/0/alphaCutoff"}}}
    builder.add("animations", {"channels": [{"sampler": 0, "target": target}], "samplers": [sampler]})
    assert any("1 channels move neither a joint nor a shape" in line for line in read(tmp_path, builder).warnings)


def test_quantised_skinned_mesh_comes_out_in_metres(tmp_path: Path) -> None:
    model = make_model()
    low, size = model.positions.min(axis=0), float(np.ptp(model.positions, axis=0).max())
    steps = np.round((model.positions - low) / size * 65535)
    stored = replace(model, positions=steps / 65535 * size + low)
    unpack = matrix(low, np.array([0, 0, 0, 1.0]), np.full(3, size))
    builder = build(model)
    attributes = builder.root["meshes"][0]["primitives"][0]["attributes"]
    attributes["POSITION"] = builder.array(steps, "u2", normalized=True, stride=8)
    targets = [{"POSITION": builder.array(target / size)} for target in model.targets]
    builder.root["meshes"][0]["primitives"][0]["targets"] = targets
    binds = (model.inverse_binds @ unpack).transpose(0, 2, 1).reshape(-1, 16)
    builder.root["skins"][0]["inverseBindMatrices"] = builder.array(binds)
    builder.root["extensionsRequired"] = builder.root["extensionsUsed"] = ["KHR_mesh_quantization"]
    parts = read(tmp_path, builder).parts
    (mesh,) = parts.meshes
    assert np.abs(corners(mesh, mesh.points) - stored.positions[model.triangles]).max() < 1e-6 * size
    weights = np.array([0.5, 0.2, 0.9])
    got = evaluate(parts, mesh, dict(zip(model.names, weights, strict=True)), parts.skeleton.rest_transforms)
    assert np.abs(corners(mesh, got) - stored.evaluate(weights, model.trs)[model.triangles]).max() < 1e-5 * size


def second_skin(model: Model, factor: Array) -> Builder:
    """The model twice, the second time on some of the joints, with binds of its own."""
    builder = build(model)
    binds = (model.inverse_binds @ factor).transpose(0, 2, 1).reshape(-1, 16)
    skin = {"joints": list(model.joint_nodes), "inverseBindMatrices": builder.array(binds)}
    builder.add("nodes", {"mesh": 0, "skin": builder.add("skins", skin), "name": "head"})
    builder.root["scenes"][0]["nodes"].append(12)
    return builder


def test_second_skin_with_a_common_factor_moves_as_gltf_says(tmp_path: Path) -> None:
    model = make_model()
    factor = matrix(np.array([0.1, 0.0, 0.2]), quaternion(np.random.default_rng(3)), np.full(3, 0.5))
    imported = read(tmp_path, second_skin(model, factor))
    parts, (first, second) = imported.parts, imported.parts.meshes
    assert imported.warnings == ()
    assert (first.name, second.name) == ("head", "head_2")
    moved = [(t + 0.01, r, s) for t, r, s in model.trs]
    local = local_of(model, moved)
    other = replace(model, inverse_binds=model.inverse_binds @ factor)
    weights = np.array([1.0, 0.5, 0.25])
    for mesh, truth in ((first, model), (second, other)):
        got = evaluate(parts, mesh, dict(zip(model.names, weights, strict=True)), local)
        assert np.abs(corners(mesh, got) - truth.evaluate(weights, moved)[model.triangles]).max() < 1e-5 * height(model)


def test_posed_file_keeps_its_bind(tmp_path: Path) -> None:
    """Nodes away from the bind pose: rest and bind differ, and the points still follow the formula."""
    model = make_model()
    generator = np.random.default_rng(9)
    model.trs = [(t, quaternion(generator), s) for t, _, s in model.trs]
    parts = read(tmp_path, build(model)).parts
    (mesh,) = parts.meshes
    assert np.array_equal(np.unique(mesh.points, axis=0), np.unique(model.positions, axis=0))
    got = evaluate(parts, mesh, {}, parts.skeleton.rest_transforms)
    assert np.abs(corners(mesh, got) - model.evaluate(np.zeros(3), model.trs)[model.triangles]).max() < 1e-5


def test_second_skin_that_binds_otherwise_moves_as_gltf_says(tmp_path: Path) -> None:
    """By joints of its own for what it binds otherwise: each mesh where the formula has it, at rest and moved."""
    model = make_model()
    builder = second_skin(model, np.eye(4))
    binds = model.inverse_binds.copy()
    binds[2, 0, 3] += 0.5
    binds[5] = binds[5] @ matrix(np.array([0.0, 0.1, 0.2]), np.array([0.0, 0.0, 0.6, 0.8]), np.ones(3))
    builder.root["skins"][1]["inverseBindMatrices"] = builder.array(binds.transpose(0, 2, 1).reshape(-1, 16))
    imported = read(tmp_path, builder)
    assert imported.warnings == (
        "face.glb -> skins[1]: binds 2 joints otherwise than an earlier skin: joints are added for it",
    )
    parts = imported.parts
    assert len(parts.skeleton.joints) == 11
    for trs in (model.trs, [(t + 0.01, r, s) for t, r, s in model.trs]):
        local = np.concatenate([local_of(model, trs), np.tile(np.eye(4), (2, 1, 1))])
        for mesh, truth in zip(parts.meshes, (model, replace(model, inverse_binds=binds)), strict=True):
            got = evaluate(parts, mesh, {}, local)
            expected = truth.evaluate(np.zeros(3), trs)[model.triangles]
            assert np.abs(corners(mesh, got) - expected).max() < 1e-5 * height(model)


def local_of(model: Model, trs: list[tuple[Array, Array, Array]]) -> Array:
    """(j, 4, 4) joint transforms relative to the parent joint, nodes between folded in."""
    worlds = model.worlds(trs)
    result = []
    for node in model.joint_nodes:
        parent = model.parents[node]
        while parent >= 0 and parent not in model.joint_nodes:
            parent = model.parents[parent]
        result.append(worlds[node] if parent < 0 else np.linalg.inv(worlds[parent]) @ worlds[node])
    return np.array(result)


def test_mesh_below_a_joint_follows_it(tmp_path: Path) -> None:
    model = make_model()
    builder = build(model)
    place = matrix(np.array([0.0, 0.1, 0.0]), np.array([0, 0, 0, 1.0]), np.full(3, 0.2))
    builder.add("meshes", {"primitives": [{"attributes": {"POSITION": builder.array(TRIANGLE)}}]})
    builder.root["nodes"][8]["children"].append(
        builder.add("nodes", {"name": "eye ball", "mesh": 1, "matrix": place.T.ravel().tolist()})
    )
    parts = read(tmp_path, builder).parts
    ball = next(mesh for mesh in parts.meshes if mesh.name == "eye ball")
    generator = np.random.default_rng(2)
    moved = [(t, quaternion(generator), s) for t, _, s in model.trs]
    world = model.worlds(moved)[8] @ place
    got = evaluate(parts, ball, {}, local_of(model, moved))
    assert np.abs(got - (TRIANGLE @ world[:3, :3].T + world[:3, 3])).max() < 1e-5


def test_unskinned_mesh_is_placed_by_its_nodes(tmp_path: Path) -> None:
    builder = triangle()
    quarter = [0.0, np.sin(np.pi / 4), 0.0, np.cos(np.pi / 4)]
    builder.root["nodes"] = [
        {"mesh": 0, "translation": [1, 2, 3]},
        {"children": [0], "rotation": quarter, "scale": [2, 2, 2]},
    ]
    parts = read(tmp_path, builder).parts
    (mesh,) = parts.meshes
    world = mesh.points @ mesh.transform[:3, :3].T + mesh.transform[:3, 3]
    x, y, z = (2 * (TRIANGLE + np.array([1, 2, 3]))).T
    assert np.allclose(world, np.stack([z, y, -x], axis=1))  # a quarter turn about y
    assert mesh.skin is None
    assert parts.skeleton.joints == ()


# welding


def test_welding_keeps_vertices_apart_that_move_apart(tmp_path: Path) -> None:
    model = make_model()
    model.targets[1][50] += 0.01  # a twin on the seam
    (mesh,) = read(tmp_path, build(model)).parts.meshes
    assert len(mesh.points) == 49
    shape = mesh.blendshapes[1]
    dense = np.zeros((49, 3), np.float32)
    dense[shape.point_indices] = shape.offsets
    assert np.array_equal(corners(mesh, dense), model.targets[1][model.triangles])


def test_welding_keeps_vertices_apart_with_other_weights(tmp_path: Path) -> None:
    model = make_model()
    model.weights[49] = np.eye(8)[0]
    assert len(read(tmp_path, build(model)).parts.meshes[0].points) == 49


def test_point_numbers_restore_points(tmp_path: Path) -> None:
    model = make_model()
    order = np.random.default_rng(4).permutation(48)
    twins = np.concatenate([np.arange(48), np.flatnonzero(np.arange(48) % 8 == 4)])
    builder = build(model)
    attributes = builder.root["meshes"][0]["primitives"][0]["attributes"]
    attributes["_FACEPIPE_POINT"] = builder.array(order[twins].astype(np.float32))
    (mesh,) = read(tmp_path, builder).parts.meshes
    expected = np.empty((48, 3), np.float32)
    expected[order] = model.positions[:48]
    assert np.array_equal(mesh.points, expected)
    dense = np.zeros((48, 3), np.float32)
    dense[mesh.blendshapes[0].point_indices] = mesh.blendshapes[0].offsets
    assert np.array_equal(dense[order], model.targets[0][:48])
    attributes["_FACEPIPE_POINT"] = builder.array(np.zeros(len(twins)))
    fallback = read(tmp_path, builder)
    assert len(fallback.parts.meshes[0].points) == 48
    assert any("_FACEPIPE_POINT" in line for line in fallback.warnings)


def test_unwelded_vertices_stay_as_they_are(tmp_path: Path) -> None:
    model = make_model()
    (mesh,) = read(tmp_path, build(model), weld=False).parts.meshes
    assert np.array_equal(mesh.points, model.positions)
    assert np.array_equal(mesh.face_vertex_indices.reshape(-1, 3), model.triangles)
    assert mesh.normals is not None
    assert np.array_equal(mesh.normals, model.normals)
    assert np.allclose(mesh.uv_sets[0].values, model.uvs * [1, -1] + [0, 1])


def test_hard_edges_become_face_varying_normals(tmp_path: Path) -> None:
    model = make_model()
    model.normals[48:] *= -1
    (mesh,) = read(tmp_path, build(model)).parts.meshes
    assert mesh.normals is not None
    assert np.array_equal(mesh.normals.reshape(-1, 3, 3), model.normals[model.triangles])


@pytest.mark.parametrize(("mode", "order"), [(5, [0, 1, 2, 3, 4]), (6, [0, 1, 3, 4, 2])])
def test_strips_and_fans_are_the_triangles_they_stand_for(tmp_path: Path, mode: int, order: list[int]) -> None:
    builder = Builder()
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 2, 0]], np.float32)
    primitive = {"attributes": {"POSITION": builder.array(points)}, "indices": builder.array(np.array(order), "u1")}
    builder.add("meshes", {"primitives": [primitive | {"mode": mode}]})
    builder.add("nodes", {"mesh": 0})
    (mesh,) = read(tmp_path, builder).parts.meshes
    a, b, c = np.moveaxis(corners(mesh, mesh.points), 1, 0)
    areas = np.cross(b - a, c - a)[:, 2] / 2
    assert len(areas) == 3
    assert np.allclose(areas.sum(), 1.5)
    assert (areas > 0).all()  # none turned over


def test_primitives_become_one_mesh_with_material_faces(tmp_path: Path) -> None:
    builder = Builder()
    shared = builder.array(np.concatenate([TRIANGLE, TRIANGLE + np.array([1, 0, 0])]))
    for number in range(2):
        builder.add("materials", {"name": "mat"})
        builder.add("meshes", {"primitives": []}) if number == 0 else None
        indices = builder.array(np.arange(3) + 3 * number, "u2")
        builder.root["meshes"][0]["primitives"].append(
            {"attributes": {"POSITION": shared}, "indices": indices, "material": number}
        )
    builder.root["meshes"][0]["primitives"].append({"attributes": {"POSITION": shared}, "mode": 1})
    builder.add("nodes", {"mesh": 0})
    imported = read(tmp_path, builder)
    (mesh,) = imported.parts.meshes
    assert len(mesh.points) == 5  # one corner in common
    assert mesh.material is None
    assert [(material_face.material, material_face.faces.tolist()) for material_face in mesh.material_faces] == [
        ("mat", [0]),
        ("mat_2", [1]),
    ]
    assert [material.name for material in imported.parts.materials] == ["mat", "mat_2"]
    assert any("lines are left out" in line for line in imported.warnings)


# names, morph targets


def test_names_are_kept_and_differ_between_meshes(tmp_path: Path) -> None:
    builder = triangle()
    names = ["Kopf é", "头", "头", "1st", "", "Skeleton", "Kopf e"]
    builder.root["nodes"] = [{"mesh": 0, "name": name} for name in names]
    meshes = read(tmp_path, builder).parts.meshes
    assert [mesh.name for mesh in meshes] == ["Kopf é", "头", "头_2", "1st", "mesh", "Skeleton", "Kopf e"]
    assert [exact(mesh) for mesh in meshes] == names


def test_target_names_of_the_wrong_length_are_numbered(tmp_path: Path) -> None:
    builder = build(make_model())
    builder.root["meshes"][0]["extras"]["targetNames"] = ["jawOpen"]
    imported = read(tmp_path, builder)
    assert [shape.name for shape in imported.parts.meshes[0].blendshapes] == ["target_0", "target_1", "target_2"]
    assert any("targetNames" in line for line in imported.warnings)


def test_inbetweens_are_folded_back(tmp_path: Path) -> None:
    model = make_model()
    builder = build(model)
    mesh_json = builder.root["meshes"][0]
    mesh_json["extras"] = {
        "targetNames": ["jawOpen", "jawOpen_half", "browUp"],
        "facepipe": {"inbetweens": {"jawOpen_half": {"shape": "jawOpen", "weight": 0.5}}},
    }
    knots = np.array([[0, 0, 0], [0, 1, 0.2], [1, 0, 0.4]], np.float32)  # activations at shape weights 0, 0.5, 1
    sampler = {"input": builder.array(np.arange(3.0)), "output": builder.array(knots.ravel())}
    channel = {"sampler": 0, "target": {"node": 11, "path": "weights"}}
    builder.add("animations", {"samplers": [sampler], "channels": [channel]})
    imported = read(tmp_path, builder)
    jaw, brow = imported.parts.meshes[0].blendshapes
    assert (jaw.name, brow.name) == ("jawOpen", "browUp")
    (half,) = jaw.inbetweens
    assert (half.name, half.weight) == ("half", 0.5)
    for values, target in ((jaw.offsets, model.targets[0]), (half.offsets, model.targets[1])):
        dense = np.zeros((48, 3), np.float32)
        dense[jaw.point_indices] = values
        assert np.array_equal(corners(imported.parts.meshes[0], dense), target[model.triangles])
    (animation,) = imported.parts.animations
    assert animation.shapes == ("jawOpen", "browUp")
    assert animation.shape_weights is not None
    assert np.allclose(animation.shape_weights, [[0, 0], [0.5, 0.2], [1, 0.4]])


def test_normal_offsets_come_along(tmp_path: Path) -> None:
    model = make_model()
    builder = build(model)
    turned = np.random.default_rng(6).normal(size=(48, 3)).astype(np.float32)
    turned = turned[np.concatenate([np.arange(48), np.flatnonzero(np.arange(48) % 8 == 4)])]
    builder.root["meshes"][0]["primitives"][0]["targets"][0]["NORMAL"] = builder.array(turned)
    imported = read(tmp_path, builder)
    (mesh,) = imported.parts.meshes
    shape = mesh.blendshapes[0]
    assert imported.warnings == ()
    assert shape.normal_offsets is not None
    assert np.array_equal(shape.point_indices, np.arange(48))
    assert np.array_equal(corners(mesh, shape.normal_offsets), turned[model.triangles])


@pytest.mark.parametrize("owner", ["meshes", "nodes"])
def test_default_morph_weights_are_a_pose(owner: str, tmp_path: Path) -> None:
    """What every viewer shows; a node's weights win over those of its mesh."""
    model = make_model()
    builder = build(model)
    builder.root["meshes"][0]["weights"] = [0.5, 0, 0.25]
    expected = {"jawOpen": 0.5, "eyeBlink_L": 0.25}
    if owner == "nodes":
        builder.root["nodes"][11]["weights"] = [0, 1.0, 0]
        expected = {"browUp": 1.0}
    imported = read(tmp_path, builder)
    (pose,) = imported.parts.animations
    assert (imported.warnings, pose.name, pose.times, imported.parts.played) == ((), "default", None, None)
    weights = dict(zip(pose.shapes, np.asarray(pose.shape_weights)[0].tolist(), strict=True))
    assert weights == expected


def test_primitives_without_the_targets_of_others_stand_still(tmp_path: Path) -> None:
    model = make_model()
    builder = build(model)
    primitive = builder.root["meshes"][0]["primitives"][0]
    still = {key: value for key, value in primitive.items() if key != "targets"} | {
        "attributes": primitive["attributes"] | {"POSITION": builder.array(model.positions + np.array([0, 0, 1.0]))}
    }
    builder.root["meshes"][0]["primitives"].append(still)
    parts = read(tmp_path, builder).parts
    (mesh,) = parts.meshes
    assert tuple(shape.name for shape in mesh.blendshapes) == model.names
    moved = {int(point) for shape in mesh.blendshapes for point in shape.point_indices}
    assert moved
    assert (np.asarray(mesh.points)[sorted(moved), 2] < 0.5).all()


@pytest.mark.parametrize("place", ["accessor", "extras", "extra", "target"])
def test_names_of_targets_where_others_put_them(place: str, tmp_path: Path) -> None:
    builder = build(make_model())
    mesh = builder.root["meshes"][0]
    del mesh["extras"]
    for target, name in zip(mesh["primitives"][0]["targets"], ("a", "b", "c"), strict=True):
        if place == "accessor":
            builder.root["accessors"][target["POSITION"]]["name"] = name
        elif place == "target":
            target["name"] = name
        else:
            target[place] = {"name": name}
    imported = read(tmp_path, builder)
    assert imported.parts.shapes == ("a", "b", "c")
    assert imported.warnings == ()


def test_joints_of_one_name_keep_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    builder = build(make_model())
    for node in builder.root["nodes"]:
        node["name"] = "head"
    parts = read(tmp_path, builder).parts
    assert {*parts.skeleton.names} == {"head"}
    assert len({*parts.skeleton.joints}) == 9
    save_parts(parts, tmp_path / "face.usda")
    done(capsys, "export", tmp_path / "face.usda", "-o", tmp_path / "out.glb", quiet=False)
    written = read_gltf(tmp_path / "out.glb").json
    assert [written["nodes"][joint]["name"] for joint in written["skins"][0]["joints"]] == ["head"] * 9


def test_weights_are_renormalised_with_a_warning(tmp_path: Path) -> None:
    model = make_model()
    model.weights[3] *= 0.5
    imported = read(tmp_path, build(model))
    skin = imported.parts.meshes[0].skin
    assert skin is not None
    assert np.allclose(skin.joint_weights.sum(axis=1), 1.0, atol=1e-6)
    assert any("renormalised" in line for line in imported.warnings)


def test_normalised_weights_and_colours(tmp_path: Path) -> None:
    model = make_model()
    builder = build(model)
    attributes = builder.root["meshes"][0]["primitives"][0]["attributes"]
    halves = np.tile([255, 0, 0, 0], (54, 1))
    attributes["WEIGHTS_0"] = builder.array(halves, "u1", normalized=True)
    attributes["WEIGHTS_1"] = builder.array(halves * 0, "u1", normalized=True)
    colors = np.tile([51, 102, 255, 255], (54, 1))
    attributes["COLOR_0"] = builder.array(colors, "u1", normalized=True)
    imported = read(tmp_path, builder)
    (mesh,) = imported.parts.meshes
    assert imported.warnings == ()
    assert mesh.skin is not None
    assert mesh.skin.joint_weights.tolist() == [[1.0]] * 48
    assert mesh.colors is not None
    assert np.allclose(mesh.colors, [0.2, 0.4, 1.0])


# materials


def textured(builder: Builder) -> None:
    """A material that uses every input, on the first primitive."""
    builder.add("images", {"bufferView": builder.view(PNG), "mimeType": "image/png", "name": "skin tone"})
    builder.add("images", {"uri": "data:image/png;base64," + base64.b64encode(PNG).decode()})
    builder.add("samplers", {"wrapS": 33071, "wrapT": 33648})
    builder.add("textures", {"source": 0, "sampler": 0})
    builder.add("textures", {"source": 1})
    material = {
        "pbrMetallicRoughness": {
            "baseColorFactor": [0.5, 0.6, 0.7, 0.8],
            "baseColorTexture": {"index": 0},
            "metallicRoughnessTexture": {"index": 1, "texCoord": 1},
            "roughnessFactor": 0.4,
        },
        "normalTexture": {"index": 1, "scale": 0.5},
        "occlusionTexture": {"index": 1, "strength": 0.25},
        "emissiveFactor": [0.1, 0.2, 0.3],
        "alphaMode": "MASK",
        "alphaCutoff": 0.3,
        "extensions": {
            "KHR_materials_ior": {"ior": 1.4},
            "KHR_materials_emissive_strength": {"emissiveStrength": 2.0},
            "KHR_materials_clearcoat": {
                "clearcoatFactor": 0.6,
                "clearcoatTexture": {"index": 1},
                "clearcoatRoughnessFactor": 0.2,
            },
        },
    }
    builder.root["materials"] = [material | {"name": "skin"}]
    builder.root["meshes"][0]["primitives"][0]["material"] = 0


def test_material_inputs(tmp_path: Path) -> None:
    builder = triangle(asset={"version": "2.0", "copyright": "(c) somebody,\n CC-BY"})
    textured(builder)
    parts = read(tmp_path, builder).parts
    (skin,) = parts.materials
    base, rough, metal = skin.diffuse_color, skin.roughness, skin.metallic
    assert parts.attribution == "(c) somebody, CC-BY"
    assert isinstance(base, TextureInput)
    assert (base.texture.name, base.texture.data) == ("skin_tone.png", PNG)
    assert (base.channels, base.scale, base.wrap_s, base.wrap_t) == ("rgb", (0.5, 0.6, 0.7, 0.8), "clamp", "mirror")
    assert isinstance(rough, TextureInput)
    assert isinstance(metal, TextureInput)
    assert (rough.channels, rough.scale[1], rough.uv_set, rough.wrap_s) == ("g", 0.4, "st1", "repeat")
    assert (metal.channels, metal.scale[2], metal.texture is rough.texture) == ("b", 1.0, True)
    assert skin.normal is not None
    assert (skin.normal.scale[:3], skin.normal.bias[:3]) == ((1.0, 1.0, 2.0), (-0.5, -0.5, -1.0))
    assert isinstance(skin.occlusion, TextureInput)
    assert (skin.occlusion.channels, skin.occlusion.scale[0], skin.occlusion.bias[0]) == ("r", 0.25, 0.75)
    assert skin.emissive_color == (0.2, 0.4, 0.6)
    assert isinstance(skin.opacity, TextureInput)
    assert (skin.opacity.channels, skin.opacity.scale[3], skin.opacity_threshold) == ("a", 0.8, 0.3)
    assert skin.ior == 1.4
    assert isinstance(skin.clearcoat, TextureInput)
    assert (skin.clearcoat.channels, skin.clearcoat.scale[0], skin.clearcoat_roughness) == ("r", 0.6, 0.2)


@pytest.mark.parametrize(("mode", "opacity"), [("OPAQUE", 1.0), ("BLEND", 0.25)])
def test_alpha_counts_only_where_the_mode_says(tmp_path: Path, mode: str, opacity: float) -> None:
    builder = triangle(materials=[{"alphaMode": mode, "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.25]}}])
    builder.root["meshes"][0]["primitives"][0]["material"] = 0
    (material,) = read(tmp_path, builder).parts.materials
    assert (material.opacity, material.opacity_threshold) == (opacity, 0.0)
    assert (material.metallic, material.roughness) == (1.0, 1.0)


# containers


def test_gltf_with_files_reads_as_the_glb_does(tmp_path: Path) -> None:
    builder = build(make_model())
    textured(builder)
    whole = read(tmp_path, builder).parts
    document = json.loads(json.dumps(builder.root))
    (tmp_path / "my data").mkdir()
    (tmp_path / "my data" / "a.bin").write_bytes(bytes(builder.binary))
    (tmp_path / "skin_tone.png").write_bytes(PNG)
    document["buffers"][0]["uri"] = "my%20data/a.bin"
    document["images"][0] = {"uri": "skin_tone.png"}
    parts = read(tmp_path, json.dumps(document).encode(), "face.gltf").parts
    files = [tmp_path / name for name in ("face.gltf", "my data/a.bin", "skin_tone.png")]
    assert parts.recipe is not None
    assert parts.recipe.digests == (digest(files),)
    assert parts.materials == whole.materials
    assert np.array_equal(parts.meshes[0].points, whole.meshes[0].points)
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(builder.binary).decode()
    inline = read(tmp_path, json.dumps(document).encode(), "inline.gltf").parts
    assert np.array_equal(inline.meshes[0].points, whole.meshes[0].points)


def test_images_of_one_file_are_one_texture(tmp_path: Path) -> None:
    """Written once, however often a document names it."""
    builder = build(make_model())
    textured(builder)
    builder.root["images"] = [{"uri": "skin.png"}, {"uri": "./skin.png", "name": "other"}]
    (tmp_path / "skin.png").write_bytes(PNG)
    parts = read(tmp_path, builder).parts
    textures = [used.texture for material in parts.materials for used in material.textured.values()]
    assert len(textures) > 2
    assert {(one.name, id(one.data)) for one in textures} == {("skin.png", id(textures[0].data))}


def test_reading_twice_gives_the_same(tmp_path: Path) -> None:
    builder, *_ = animated(make_model())
    textured(builder)
    assert repr(read(tmp_path, builder)) == repr(read(tmp_path, builder))


def test_scene_option_chooses_what_is_read(tmp_path: Path) -> None:
    builder = triangle(scenes=[{"nodes": [0]}, {"nodes": [1]}], scene=0)
    builder.root["nodes"] = [{"mesh": 0, "name": "one"}, {"mesh": 0, "name": "two"}]
    first, second = read(tmp_path, builder), read(tmp_path, builder, scene=1)
    assert [mesh.name for mesh in first.parts.meshes] == ["one"]
    assert [mesh.name for mesh in second.parts.meshes] == ["two"]
    assert any("1 nodes with a mesh" in line for line in first.warnings)
    with pytest.raises(InputError, match="scene 2"):
        read(tmp_path, builder, scene=2)


def test_deep_chain_of_nodes_is_read(tmp_path: Path) -> None:
    builder = triangle()
    count = 5000
    chain = [{"children": [i + 1], "translation": [0.0, 1.0, 0.0]} for i in range(count)]
    builder.root["nodes"] = [*chain, {"mesh": 0}]
    assert read(tmp_path, builder).parts.meshes[0].transform[1, 3] == count


def test_the_least_of_a_normalised_integer_is_minus_one(tmp_path: Path) -> None:
    """Two bytes stand for it: -127 and -128."""
    builder = Builder()
    corners = np.array([[-128, 0, 0], [-127, 127, 0], [127, 0, 0]])
    position = builder.array(corners, "i1", normalized=True, stride=4)
    builder.add("meshes", {"primitives": [{"attributes": {"POSITION": position}}]})
    builder.add("nodes", {"mesh": 0})
    points = read(tmp_path, builder).parts.meshes[0].points
    np.testing.assert_allclose(points[:, 0] / points[2, 0], [-1.0, -1.0, 1.0])


def two_nodes(builder: Builder, *weights: list[float] | None) -> Builder:
    """A triangle with two shapes, shown by a node for each of `weights`, the node's default weights."""
    builder.root["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": builder.array(TRIANGLE)}] * 2
    builder.root["meshes"][0]["extras"] = {"targetNames": ["smile", "frown"]}
    for number, own in enumerate(weights):
        if number:
            builder.add("nodes", {"mesh": 0})
        if own is not None:
            builder.root["nodes"][number]["weights"] = own
    builder.root["scenes"] = [{"nodes": list(range(len(weights)))}]
    return builder


def playing(builder: Builder, target: dict[str, Any], keys: list[float]) -> Builder:
    times = builder.array(np.array([0.0, 1.0]))
    samplers = [{"input": times, "output": builder.array(np.array(keys))}]
    builder.add("animations", {"channels": [{"sampler": 0, "target": target}], "samplers": samplers, "name": "talk"})
    return builder


def test_a_clip_leaves_default_weights_where_it_moves_nothing(tmp_path: Path) -> None:
    """As viewers do: channels replace the weights that they move alone."""
    pointer = {"path": "pointer", "extensions": {"KHR_animation_pointer": {"pointer": "/nodes/0/weights/1"}}}
    builder = playing(two_nodes(triangle(), [0.75, 0.5]), pointer, [0.0, 1.0])
    talk, default = read(tmp_path, builder).parts.animations
    assert talk.shape_weights is not None
    assert default.shape_weights is not None
    columns = dict(zip(talk.shapes, talk.shape_weights.T.tolist(), strict=True))
    assert columns == {"frown": [0.0, 1.0], "smile": [0.75, 0.75]}
    assert dict(zip(default.shapes, default.shape_weights[0].tolist(), strict=True)) == {"smile": 0.75, "frown": 0.5}


def test_nodes_that_show_a_mesh_in_other_default_weights_have_shapes_of_their_own(tmp_path: Path) -> None:
    parts = read(tmp_path, two_nodes(triangle(), [0.75, 0.5], [0.25, 0.5], None)).parts
    assert [[shape.name for shape in mesh.blendshapes] for mesh in parts.meshes] == [
        ["smile", "frown"], ["smile_2", "frown"], ["smile_3", "frown_2"],
    ]  # fmt: skip
    (pose,) = parts.animations
    assert pose.shape_weights is not None
    weights = dict(zip(pose.shapes, pose.shape_weights[0].tolist(), strict=True))
    assert weights == {"smile": 0.75, "frown": 0.5, "smile_2": 0.25}


def test_a_pointer_to_the_weights_of_a_mesh_plays_the_nodes_without_their_own(tmp_path: Path) -> None:
    pointer = {"path": "pointer", "extensions": {"KHR_animation_pointer": {"pointer": "/meshes/0/weights"}}}
    builder = playing(two_nodes(triangle(), None, None, [0.0, 0.5]), pointer, [0.0, 0.0, 1.0, 0.25])
    imported = read(tmp_path, builder)
    first, second, third = imported.parts.meshes
    assert [shape.name for shape in first.blendshapes] == [shape.name for shape in second.blendshapes]
    assert [shape.name for shape in third.blendshapes] == ["smile_2", "frown_2"]
    talk = imported.parts.animations[0]
    assert talk.shape_weights is not None
    columns = dict(zip(talk.shapes, talk.shape_weights.T.tolist(), strict=True))
    assert columns == {"smile": [0.0, 1.0], "frown": [0.0, 0.25], "frown_2": [0.5, 0.5]}


def test_a_mesh_that_follows_the_shapes_of_another_is_named(tmp_path: Path) -> None:
    builder = playing(two_nodes(triangle(), None), {"node": 0, "path": "weights"}, [0.0, 0.0, 1.0, 0.0])
    teeth = dict(builder.root["meshes"][0]) | {"name": "teeth"}
    builder.add("meshes", teeth)
    builder.root["scenes"][0]["nodes"].append(builder.add("nodes", {"mesh": 1}))
    assert read(tmp_path, builder).warnings == (
        "face.glb -> nodes[1]: no channel plays its shapes (smile): they follow those of their names",
    )
