"""The FBX importer: what files of a known scene hold is on the face, whatever their axes, unit and version."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fbx_files import Scene, full_scene, layer, layers, node, property70
from fbx_posed import posed
from gltf_builder import PNG
from import_data import shared
from PIL import Image

import facepipe
from facepipe.cli import main
from facepipe.core.errors import InputError
from facepipe.importers import load
from facepipe.importers.fbx import Options
from facepipe.rig.rig import build
from facepipe.rig.trs import rest_worlds

pytest.importorskip("wasmtime")

POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0.5]])
FACES = [[0, 1, 2, 3], [1, 4, 2]]


def read(data: bytes | Scene, folder: Path, **options: Any) -> Any:
    source = folder / "face.fbx"
    source.write_bytes(data.binary() if isinstance(data, Scene) else data)
    return load("fbx", source, Options(**options))


def placed(translation: Any = (0, 0, 0), degrees: float = 0.0, scale: float = 1.0) -> np.ndarray:
    """(4, 4) scale, turn about z, move."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    matrix = np.diag([scale, scale, scale, 1.0]) @ np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    matrix[:3, 3] = translation
    return matrix


def plain(scene: Scene, name: str = "Head", **given: Any) -> tuple[int, int]:
    """A node with the mesh: both numbers."""
    model = scene.model(name, of="Mesh", **given)
    return model, scene.mesh(model, POINTS, FACES)


# ---- meshes


@pytest.mark.parametrize("form", ["deflated", "plain", "ascii"])
def test_quads_and_attributes_of_corners_stay(form: str, tmp_path: Path) -> None:
    scene = Scene()
    head = scene.model("Kopf ä", of="Mesh")
    uvs, lower = np.array([0, 0, 1, 0, 1, 1, 0, 1.0]), np.array([0.5, 0.5] * 7)
    normals = np.tile([0.0, 0.0, 1.0], 7)
    normals[18:] = (0.0, 1.0, 0.0)
    second = layer("UV", "ByPolygonVertex", "Direct", node("UV", lower), name="detail")
    second.values = (1,)
    scene.mesh(
        head,
        POINTS,
        FACES,
        layer("Normal", "ByPolygonVertex", "Direct", node("Normals", normals)),
        layer(
            "UV",
            "ByPolygonVertex",
            "IndexToDirect",
            node("UV", uvs),
            node("UVIndex", np.array([0, 1, 2, 3, 0, 1, 2], "i4")),
            name="map1",
        ),
        second,
        layer(
            "Color",
            "ByVertice",
            "Direct",
            node("Colors", np.array([[1, 0.5, 0.25, 1]] * 5).ravel()),
        ),
        layer("Material", "ByPolygon", "IndexToDirect", node("Materials", np.array([1, 0], "i4"))),
        layers("Normal", "UV", "Color", "Material"),
        node(
            "Layer",
            1,
            children=[node("LayerElement", children=[node("Type", "LayerElementUV"), node("TypedIndex", 1)])],
        ),
    )
    for name in ("skin", "lips"):
        scene.material(head, name)
    data = {"deflated": scene.binary, "plain": lambda: scene.binary(deflate=False), "ascii": scene.ascii}[form]()
    imported = read(data, tmp_path)
    (mesh,) = imported.parts.meshes
    assert imported.warnings == ()
    assert (mesh.name, mesh.data_label) == ("Kopf ä", "geometry")
    assert np.array_equal(mesh.points, POINTS.astype(np.float32))
    assert (mesh.face_vertex_counts.tolist(), mesh.face_vertex_indices.tolist()) == ([4, 3], [0, 1, 2, 3, 1, 4, 2])
    assert np.array_equal(mesh.normals, normals.reshape(-1, 3))
    first, detail = mesh.uv_sets
    assert (first.name, first.values[first.indices].tolist()) == (
        "st",
        uvs.reshape(4, 2)[[0, 1, 2, 3, 0, 1, 2]].tolist(),
    )
    assert (detail.name, detail.indices, detail.values.tolist()) == ("detail", None, [[0.5, 0.5]] * 5)
    assert mesh.colors.tolist() == [[1.0, 0.5, 0.25]] * 5
    assert [(one.material, one.faces.tolist()) for one in mesh.material_faces] == [("skin", [1]), ("lips", [0])]
    assert imported.parts.recipe.verb == "import fbx"


@pytest.mark.parametrize(
    ("axes", "up", "turn"),
    [
        ({}, "Y", np.eye(3)),
        ({"up": 2, "front": (1, -1)}, "Z", np.eye(3)),
        ({"up": 2, "front": (1, 1), "right": -1}, "Y", [[-1, 0, 0], [0, 0, 1], [0, 1, 0]]),
        ({"up": 0, "front": (2, 1), "right": -1}, "Y", [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        ({"front": (2, -1)}, "Y", np.diag([1, 1, -1])),
    ],
)
def test_units_and_axes_are_those_of_the_file(axes: dict[str, Any], up: str, turn: Any, tmp_path: Path) -> None:
    scene = Scene(unit=2.54, **axes)
    plain(scene, translation=(3, 4, 5))
    imported = read(scene, tmp_path)
    (mesh,) = imported.parts.meshes
    assert imported.parts.meters_per_unit == pytest.approx(0.0254)
    assert imported.parts.up_axis == up
    assert np.array_equal(mesh.points, POINTS.astype(np.float32))
    world = POINTS @ mesh.transform[:3, :3].T + mesh.transform[:3, 3]
    assert np.allclose(world, (np.add(POINTS, (3, 4, 5))) @ np.transpose(turn), atol=1e-12)
    assert bool(imported.warnings) == (np.linalg.det(np.asarray(turn, float)) < 0)
    other = read(scene, tmp_path, meters_per_unit=0.5, up_axis="Z").parts
    assert (other.meters_per_unit, other.up_axis) == (0.5, "Z")


def test_geometric_transforms_move_points_and_nothing_below(tmp_path: Path) -> None:
    scene = Scene()
    head, geometry = plain(
        scene,
        scaling=(2, 2, 2),
        GeometricTranslation=(0, 0, 1),
        GeometricRotation=(0, 0, 90),
        GeometricScaling=(3, 3, 3),
    )
    scene.channel(scene.channels(geometry), "up", [("up", 100, [1], [[1, 0, 0]])])
    hat = scene.model("Hat", head, of="Mesh", translation=(0, 5, 0))
    scene.mesh(hat, POINTS, FACES)
    mesh, below = read(scene, tmp_path).parts.meshes
    geometric = placed((0, 0, 1), 90, 3)
    assert np.allclose(mesh.points, POINTS @ geometric[:3, :3].T + geometric[:3, 3], atol=1e-6)
    assert np.allclose(mesh.transform, np.diag([2, 2, 2, 1]))
    assert np.allclose(mesh.blendshapes[0].offsets, [[0, 3, 0]], atol=1e-6)
    assert np.array_equal(below.points, POINTS.astype(np.float32))
    assert below.transform[:3, 3] == pytest.approx((0, 10, 0))


def test_a_mesh_shown_twice_is_two_and_mirrors_keep_their_faces(tmp_path: Path) -> None:
    scene = Scene()
    _, geometry = plain(scene, "Left")
    right = scene.model("Right", of="Mesh", scaling=(-1, 1, 1))
    scene.link(geometry, right)
    third = scene.model("Right", of="Mesh")
    scene.link(geometry, third)
    left, mirrored, twin = read(scene, tmp_path).parts.meshes
    assert [(mesh.name, mesh.label) for mesh in (left, mirrored, twin)] == [
        ("Left", None),
        ("Right", None),
        ("Right_2", "Right"),
    ]
    assert np.array_equal(left.points, mirrored.points)
    assert np.allclose(mirrored.transform, np.diag([-1, 1, 1, 1]))
    assert np.array_equal(mirrored.face_vertex_indices, left.face_vertex_indices)


FORMER = """; FBX 6.1.0 project file
FBXHeaderExtension:  {
    FBXHeaderVersion: 1003
    FBXVersion: 6100
}
Objects:  {
    Model: "Model::Head", "Mesh" {
        Version: 232
        Properties60:  {
            Property: "Lcl Translation", "Lcl Translation", "A+",0,3,0
        }
        Vertices: 0,0,0,1,0,0,1,1,0,0,1,0,2,0,0.5
        PolygonVertexIndex: 0,1,2,-4,1,4,-3
        GeometryVersion: 124
        Shape: "smile" {
            Indexes: 1,2
            Vertices: 0,0,1,0,2,0
            Normals: 0,0,0,0,0,0
        }
    }
}
Relations:  {
    Model: "Model::Head", "Mesh" {
    }
}
Connections:  {
    Connect: "OO", "Model::Head", "Model::Scene"
}
"""


def test_files_of_version_6_are_read(tmp_path: Path) -> None:
    (mesh,) = read(FORMER.encode(), tmp_path).parts.meshes
    assert np.array_equal(mesh.points, POINTS.astype(np.float32))
    assert mesh.face_vertex_counts.tolist() == [4, 3]
    assert mesh.transform[:3, 3].tolist() == [0, 3, 0]
    assert [(one.name, one.point_indices.tolist(), one.offsets.tolist()) for one in mesh.blendshapes] == [
        ("smile", [1, 2], [[0, 0, 1], [0, 2, 0]])
    ]


# ---- shapes


def test_full_weights_make_inbetweens(tmp_path: Path) -> None:
    scene = Scene()
    _, geometry = plain(scene)
    deformer = scene.channels(geometry)
    scene.channel(deformer, "jawOpen", [("half", 50, [1], [[0, 0, 1]]), ("full", 100, [1, 2], [[0, 0, 4], [0, 1, 0]])])
    scene.channel(deformer, "alone", [("alone", 50, [0], [[1, 0, 0]])])
    scene.channel(deformer, "beyond", [("near", 40, [0], [[1, 0, 0]]), ("far", 140, [0], [[2, 0, 0]])])
    scene.channel(deformer, "still", [("still", 100, [0, 1], [[0, 0, 0], [0, 0, 0]])])
    shapes = {shape.name: shape for shape in read(scene, tmp_path).parts.meshes[0].blendshapes}
    jaw = shapes["jawOpen"]
    assert (jaw.point_indices.tolist(), jaw.offsets.tolist()) == ([1, 2], [[0, 0, 4], [0, 1, 0]])
    assert [(one.name, one.weight, one.offsets.tolist()) for one in jaw.inbetweens] == [
        ("half", 0.5, [[0, 0, 1], [0, 0, 0]])
    ]
    assert (shapes["alone"].offsets.tolist(), shapes["alone"].inbetweens) == ([[2, 0, 0]], ())
    assert np.allclose(shapes["beyond"].offsets, [[1.6, 0, 0]])  # on the line from 1 at 0.4 to 2 at 1.4
    assert [(one.name, one.weight) for one in shapes["beyond"].inbetweens] == [("near", 0.4), ("far", 1.4)]
    assert len(shapes["still"].point_indices) == 0


def test_one_shape_of_two_meshes_is_two_where_they_play_otherwise(tmp_path: Path) -> None:
    scene = Scene()
    channels = {}
    for name in ("Head", "Teeth", "Brows"):
        _, geometry = plain(scene, name)
        channels[name] = scene.channel(scene.channels(geometry), "jawOpen", [("jawOpen", 100, [1], [[0, 0, 1]])])
    take = scene.stack("Take", 0, 1)
    for name, end in (("Head", 100), ("Teeth", 100), ("Brows", 50)):
        scene.curves(take, channels[name], "DeformPercent", {"d|DeformPercent": [(0, 0), (1, end)]})
    imported = read(scene, tmp_path)
    head, teeth, brows = imported.parts.meshes
    assert [mesh.blendshapes[0].name for mesh in (head, teeth, brows)] == ["jawOpen", "jawOpen", "jawOpen_2"]
    assert brows.blendshapes[0].label == "jawOpen"
    (clip,) = imported.parts.animations
    assert (clip.shapes, clip.shape_weights[-1].tolist()) == (("jawOpen", "jawOpen_2"), [1.0, 0.5])
    assert imported.warnings == (
        "face.fbx: 1 shapes are played otherwise than those of their name on an earlier mesh: jawOpen is jawOpen_2",
    )


# ---- skins


def skinned(scale: float = 1.0, **axes: Any) -> Scene:
    """Two bones below an armature of a scale; the mesh bound where they stood, which is not where they stand."""
    scene = Scene(**axes)
    armature = scene.model("Armature", scaling=(scale,) * 3)
    neck = scene.model("neck", armature, "LimbNode", translation=(0, 1, 0))
    jaw = scene.model("jaw", neck, "LimbNode", translation=(0, 2, 0), rotation=(0, 0, 30))
    model = scene.model("Head", of="Mesh", translation=(9, 9, 9))
    geometry = scene.mesh(model, POINTS, FACES)
    bind = placed((0, 0, 7))
    links = [placed((0, scale, 0), 0, scale), placed((0, 3 * scale, 0), 0, scale)]
    scene.skin(
        geometry,
        [
            (jaw, [1, 2, 4], [0.25, 1.0, 0.5], np.linalg.inv(links[1]) @ bind, links[1]),
            (neck, [0, 1, 3, 4], [1.0, 0.75, 1.0, 0.5], np.linalg.inv(links[0]) @ bind, links[0]),
        ],
    )
    take = scene.stack("Take", 0, 1)
    scene.curves(take, jaw, "Lcl Rotation", {"d|Z": [(0, 0), (1, 90)]})
    return scene


@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_skins_bind_where_the_file_says(scale: float, tmp_path: Path) -> None:
    imported = read(skinned(scale), tmp_path)
    (mesh,), skeleton = imported.parts.meshes, imported.parts.skeleton
    assert imported.warnings == ()
    assert skeleton.joints == ("neck", "neck/jaw")
    assert np.allclose(mesh.points, np.add(POINTS, (0, 0, 7)))  # where it was bound, not where the node stands
    assert np.allclose(skeleton.bind_transforms, [placed((0, scale, 0)), placed((0, 3 * scale, 0))], atol=1e-5 * scale)
    assert np.allclose(rest_worlds(skeleton)[1], placed((0, 3 * scale, 0), 30), atol=1e-5 * scale)
    weights = np.zeros((5, 2))
    np.add.at(weights, (np.arange(5)[:, None], mesh.skin.joint_indices), mesh.skin.joint_weights)
    assert np.allclose(weights, [[1, 0], [0.75, 0.25], [0, 1], [1, 0], [0.5, 0.5]])
    # the truth: world_j inverse_j of the file, linear between
    at = placed((0, 3 * scale, 0), 45, scale) @ np.linalg.inv(placed((0, 3 * scale, 0), 0, scale)) @ placed((0, 0, 7))
    still = placed((0, 0, 7))
    moved = sum(
        weight[:, None] * (POINTS @ matrix[:3, :3].T + matrix[:3, 3])
        for weight, matrix in zip(weights.T, (still, at), strict=True)
    )
    assert np.allclose(posed(imported.parts, "Take", 0.5), moved, atol=2e-6 * scale)


def test_two_skins_that_bind_otherwise_get_joints_of_their_own(tmp_path: Path) -> None:
    scene = Scene()
    bone = scene.model("head", of="LimbNode")
    for name, link in (("Face", placed()), ("Hat", placed((0, 0, 5), 30))):
        _, geometry = plain(scene, name)
        scene.skin(geometry, [(bone, range(5), [1.0] * 5, np.linalg.inv(link), link)])
    imported = read(scene, tmp_path)
    points = build(imported.parts).evaluate().reshape(2, 5, 3)
    hat = np.linalg.inv(placed((0, 0, 5), 30))
    assert np.allclose(points[0], POINTS, atol=1e-6)
    assert np.allclose(points[1], POINTS @ hat[:3, :3].T + hat[:3, 3], atol=1e-6)


@pytest.mark.parametrize("odd", [0, 1, 2])
def test_one_joint_that_a_skin_binds_otherwise_is_one_more_wherever_it_comes(odd: int, tmp_path: Path) -> None:
    scene = Scene()
    bones = [scene.model(name, of="LimbNode") for name in ("a", "b", "c")]
    weights, turn = np.eye(5)[:3] + np.array([0.0, 0, 0, 0.5, 0.5]), placed((0, 0, 5), 30)
    for name, other in (("Face", np.eye(4)), ("Hat", turn)):
        _, geometry = plain(scene, name)
        links = [other if number == odd else np.eye(4) for number in range(3)]
        rows = zip(bones, weights, links, strict=True)
        scene.skin(geometry, [(bone, range(5), own, np.linalg.inv(link), link) for bone, own, link in rows])
    imported = read(scene, tmp_path)
    assert len(imported.parts.skeleton.joints) == 4
    assert [line for line in imported.warnings if "otherwise" in line] == [
        "face.fbx -> Hat: binds 1 joints otherwise than an earlier mesh: joints added"
    ]
    points, share = build(imported.parts).evaluate().reshape(2, 5, 3), (weights[odd] / weights.sum(axis=0))[:, None]
    back = np.linalg.inv(turn)
    assert np.allclose(points[0], POINTS, atol=1e-6)
    hat = POINTS @ back[:3, :3].T + back[:3, 3]
    assert np.allclose(points[1], share * hat + (1 - share) * POINTS, atol=1e-5)


def test_weights_are_normalised_and_points_without_follow_the_first(tmp_path: Path) -> None:
    scene = Scene()
    bones = [scene.model(name, of="LimbNode") for name in ("a", "b")]
    _, geometry = plain(scene)
    scene.skin(
        geometry,
        [(bones[0], [0, 1], [0.5, 0.5], placed(), placed()), (bones[1], [1, 2], [1.0, 1.0], placed(), placed())],
    )
    imported = read(scene, tmp_path)
    skin = imported.parts.meshes[0].skin
    assert np.allclose(skin.joint_weights.sum(axis=1), 1)
    assert skin.joint_indices[1].tolist() == [1, 0]
    assert np.allclose(skin.joint_weights[1], [2 / 3, 1 / 3])
    assert imported.warnings == (
        "face.fbx -> Head: 2 points without weight now follow the joint a",
        "face.fbx -> Head: weights of 2 points normalised, their sums were 0.5 to 1.5",
    )


def test_dual_quaternions_are_kept(tmp_path: Path) -> None:
    scene = Scene()
    bone = scene.model("a", of="LimbNode")
    _, geometry = plain(scene)
    scene.skin(geometry, [(bone, range(5), [1.0] * 5, placed(), placed())], "DualQuaternion")
    assert read(scene, tmp_path).parts.meshes[0].skin.dual_quaternion


def test_what_hangs_on_a_bone_or_moves_alone_follows_a_joint(tmp_path: Path) -> None:
    scene = Scene()
    head = scene.model("head", of="LimbNode", translation=(0, 1, 0))
    eye = scene.model("Eye", head, of="Mesh", translation=(0, 0, 2))
    scene.mesh(eye, POINTS, FACES)
    hat = scene.model("Hat", of="Mesh")
    scene.mesh(hat, POINTS, FACES)
    stand = scene.model("Stand", of="Mesh")
    scene.mesh(stand, POINTS, FACES)
    take = scene.stack("Take", 0, 1)
    scene.curves(take, head, "Lcl Rotation", {"d|Z": [(0, 0), (1, 90)]})
    scene.curves(take, hat, "Lcl Translation", {"d|Y": [(0, 0), (1, 8)]})
    scene.curves(take, stand, "Lcl Translation", {"d|Y": [(0, 0), (1, 0)]})  # keys that change nothing
    parts = read(scene, tmp_path).parts
    assert parts.skeleton.joints == ("head", "Hat")
    assert parts.meshes[2].skin is None
    points = posed(parts, "Take", 0.5).reshape(3, 5, 3)
    turned = placed((0, 1, 0), 45) @ placed((0, 0, 2))
    assert np.allclose(points[0], POINTS @ turned[:3, :3].T + turned[:3, 3], atol=1e-6)
    assert np.allclose(points[1], np.add(POINTS, (0, 4, 0)), atol=1e-6)
    assert np.allclose(points[2], POINTS)


# ---- motion


def test_clips_have_frames_and_keys_between_and_held_values(tmp_path: Path) -> None:
    scene = Scene()
    _, geometry = plain(scene)
    deformer = scene.channels(geometry)
    flowing = scene.channel(deformer, "flowing", [("a", 100, [1], [[0, 0, 1]])])
    held = scene.channel(deformer, "held", [("b", 100, [1], [[0, 1, 0]])])
    take = scene.stack("Take", 0.5, 1.0)
    scene.curves(take, flowing, "DeformPercent", {"d|DeformPercent": [(0.5, 0), (0.61, 80), (1, 0)]})
    scene.curves(take, held, "DeformPercent", {"d|DeformPercent": [(0.5, 0), (0.75, 100), (1, 100)]}, flag=2)
    parts = read(scene, tmp_path).parts
    (clip,) = parts.animations
    assert (parts.played, parts.frames_per_second) == ("Take", 24.0)
    assert clip.times[[0, -1]].tolist() == [0.5, 1.0]
    assert {*np.arange(12, 25) / 24} <= {*clip.times}
    weights = dict(zip(clip.shapes, clip.shape_weights.T, strict=True))
    assert np.interp(0.61, clip.times, weights["flowing"]) == pytest.approx(0.8, abs=1e-6)
    assert np.interp(0.748, clip.times, weights["held"]) == 0.0
    assert np.interp(0.75, clip.times, weights["held"]) == 1.0
    frames = read(scene, tmp_path, fps=10).parts.animations[0].times
    assert np.allclose(frames, [0.5, 0.6, 0.7, 0.8, 0.9, 1.0])


def test_weights_at_rest_are_a_pose_and_idle_stacks_are_named(tmp_path: Path) -> None:
    scene = Scene()
    _, geometry = plain(scene)
    scene.channel(scene.channels(geometry), "smile", [("smile", 100, [1], [[0, 0, 1]])], percent=25)
    bone = scene.model("lone", of="LimbNode")
    take = scene.stack("Idle", 0, 1)
    scene.curves(take, bone, "Lcl Rotation", {"d|Z": [(0, 0), (1, 0)]})
    imported = read(scene, tmp_path)
    poses = {one.name: one for one in imported.parts.animations}
    assert poses["default"].shape_weights.tolist() == [[0.25]]
    assert poses["default"].times is None


def test_what_moves_and_has_no_place_on_a_face_is_named(tmp_path: Path) -> None:
    scene = Scene()
    head, _ = plain(scene, Visibility=(1.0,))
    take = scene.stack("Take", 0, 1)
    scene.curves(take, head, "Visibility", {"d|Visibility": [(0, 1), (1, 0)]})
    scene.curves(take, head, "Lcl Translation", {"d|X": [(0, 0), (1, 2)]})
    what = "1 animated properties are neither places nor weights of shapes, like Visibility of Head: left out"
    assert read(scene, tmp_path).warnings == (f"face.fbx -> Take: {what}",)


def test_hidden_meshes_are_shown_and_named(tmp_path: Path) -> None:
    scene = Scene()
    plain(scene)
    scene.objects[0].children[1].children.append(property70("Visibility", "Visibility", 0.0))
    assert read(scene, tmp_path).warnings == ("face.fbx -> Head: is hidden in the file: shown here",)


def test_segment_scale_is_compensated_as_maya_does(tmp_path: Path) -> None:
    """InheritType 2 (Rrs): a joint's scale does not reach those below it; their places follow it."""
    scene = Scene()
    root = scene.model("root", of="LimbNode", scaling=(2, 2, 2))
    tip = scene.model("tip", root, "LimbNode", translation=(0, 1, 0))
    scene.objects[-1].children[1].children.append(property70("InheritType", "enum", 2))
    hat = scene.model("Hat", tip, of="Mesh")
    scene.mesh(hat, POINTS, FACES)
    points = build(read(scene, tmp_path).parts).evaluate()
    assert np.allclose(points, np.add(POINTS, (0, 2, 0)), atol=1e-6)


# ---- materials


def test_materials_have_colours_and_embedded_pictures(tmp_path: Path) -> None:
    scene = Scene()
    head, _ = plain(scene)
    skin = scene.material(
        head,
        "skin",
        property70("DiffuseColor", "Color", 0.5, 0.25, 0.125),
        property70("DiffuseFactor", "Number", 0.5),
        property70("EmissiveColor", "Color", 0.0, 0.5, 0.0),
        property70("TransparentColor", "Color", 1.0, 1.0, 1.0),
        property70("TransparencyFactor", "Number", 0.25),
        property70("ShininessExponent", "Number", 25.0),
    )
    scene.texture(skin, "NormalMap", "maps\\n.png", "C:\\art\\maps\\n.png", PNG)
    (material,) = read(scene, tmp_path).parts.materials
    assert material.name == "skin"
    assert material.diffuse_color == (0.25, 0.125, 0.0625)
    assert material.emissive_color == (0.0, 0.5, 0.0)
    assert material.opacity == pytest.approx(0.75)
    assert material.normal is not None
    assert (material.normal.texture.name, material.normal.texture.data) == ("n.png", PNG)


@pytest.mark.parametrize(
    ("mode", "channel", "scale"), [("RGBA", "a", 1.0), ("LA", "a", 1.0), ("RGB", "r", -1.0), ("L", "r", -1.0)]
)
def test_a_picture_of_transparency_is_its_alpha_or_its_inverse(
    mode: str, channel: str, scale: float, tmp_path: Path
) -> None:
    scene = Scene()
    head, _ = plain(scene)
    data = io.BytesIO()
    Image.new(mode, (2, 2)).save(data, "PNG")
    scene.texture(scene.material(head, "lash"), "TransparentColor", "maps\\lash", content=data.getvalue())
    (material,) = read(scene, tmp_path).parts.materials
    assert (material.opacity.channels, material.opacity.scale[0]) == (channel, scale)
    assert material.opacity.bias[0] == (0.0 if scale > 0 else 1.0)
    assert material.opacity.texture.name == "lash.png"


def test_pictures_of_other_kinds_become_png(tmp_path: Path) -> None:
    scene = Scene()
    head, _ = plain(scene)
    skin = scene.material(head, "skin")
    for slot, kind in (("DiffuseColor", "TGA"), ("EmissiveColor", "BMP")):
        data = io.BytesIO()
        Image.new("RGB", (2, 2), (255, 0, 0)).save(data, kind)
        scene.texture(skin, slot, f"a.{kind.lower()}", content=data.getvalue())
    (material,) = read(scene, tmp_path).parts.materials
    pictures = [material.diffuse_color.texture, material.emissive_color.texture]
    assert [Image.open(io.BytesIO(one.data)).getpixel((0, 0)) for one in pictures] == [(255, 0, 0)] * 2
    assert {one.name for one in pictures} == {"a.png", "a_2.png"}


def test_pictures_beside_the_file_are_read_and_others_named(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "skin.png").write_bytes(PNG)
    (tmp_path / "secret.png").write_bytes(PNG)
    scene = Scene()
    head, _ = plain(scene)
    skin = scene.material(head, "skin")
    scene.texture(skin, "DiffuseColor", "..\\elsewhere\\skin.png", "D:\\art\\skin.png")
    scene.texture(skin, "EmissiveColor", "..\\secret.png")
    imported = read(scene, tmp_path / "in")
    (material,) = imported.parts.materials
    assert material.diffuse_color.texture.data == PNG
    assert material.emissive_color == (0.0, 0.0, 0.0)
    assert len(imported.warnings) == 1
    assert "outside the roots" in imported.warnings[0]
    with pytest.raises(InputError, match="outside the roots"):
        read(scene, tmp_path / "in", strict=True)


# ---- doors


def test_commands_that_take_a_face_take_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "face.fbx"
    source.write_bytes(full_scene().binary())
    assert main(["import", "fbx", str(source), str(tmp_path / "face.usda")]) == 0
    assert main(["export", str(source), "-o", str(tmp_path / "face.glb")]) == 0
    face = facepipe.read(source)
    assert face.skeleton.joints == ("head", "head/jaw")
    assert np.allclose(face.evaluate(), facepipe.open(tmp_path / "face.usda").evaluate(), atol=1e-4)
    words = ["animate", str(tmp_path / "face.usda"), str(source), "-o", str(tmp_path / "moved.usda"), "--name", "again"]
    assert main(words) == 0
    again = next(one for one in facepipe.open(tmp_path / "moved.usda").animations if one.name == "again")
    weights = dict(zip(again.shapes, again.shape_weights[-1], strict=True))
    assert weights == pytest.approx({"jawOpen": 1.0, "smile": 0.3})  # which stands at 30 %
    capsys.readouterr()


@pytest.mark.parametrize(
    ("name", "points", "joints"),
    [
        ("kenney_character_medium", 804, 58),
        ("mediapipe_canonical_face", 468, 0),
        ("quaternius_smooth_male_suit", 4400, 42),
    ],
)
def test_files_of_others_are_what_their_page_says(name: str, points: int, joints: int) -> None:
    parts = load("fbx", shared(f"heads/{name}.fbx")).parts
    assert [len(mesh.points) for mesh in parts.meshes] == [points]
    assert len(parts.skeleton.joints) == joints
    assert parts.meters_per_unit == pytest.approx(0.01)
