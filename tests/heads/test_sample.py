"""The built-in sample: a sound topology, a face that opens and closes, weights that respect the slits."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from facepipe.geometry.polygons import components, edges, point_triangles
from facepipe.heads import eyes, identity, layout, make, mouth, shapes, topology
from facepipe.heads.meshes import build as build_neutral
from facepipe.parts import Blendshape, FaceParts, FloatArray, Mesh
from facepipe.stage import save_parts

SEEDS = (0, 1, 2, 24)
MM = 0.1  # centimetres
ARKIT = [
    "eyeBlinkLeft",
    "eyeLookDownLeft",
    "eyeLookInLeft",
    "eyeLookOutLeft",
    "eyeLookUpLeft",
    "eyeSquintLeft",
    "eyeWideLeft",
    "eyeBlinkRight",
    "eyeLookDownRight",
    "eyeLookInRight",
    "eyeLookOutRight",
    "eyeLookUpRight",
    "eyeSquintRight",
    "eyeWideRight",
    "jawForward",
    "jawLeft",
    "jawRight",
    "jawOpen",
    "mouthClose",
    "mouthFunnel",
    "mouthPucker",
    "mouthLeft",
    "mouthRight",
    "mouthSmileLeft",
    "mouthSmileRight",
    "mouthFrownLeft",
    "mouthFrownRight",
    "mouthDimpleLeft",
    "mouthDimpleRight",
    "mouthStretchLeft",
    "mouthStretchRight",
    "mouthRollLower",
    "mouthRollUpper",
    "mouthShrugLower",
    "mouthShrugUpper",
    "mouthPressLeft",
    "mouthPressRight",
    "mouthLowerDownLeft",
    "mouthLowerDownRight",
    "mouthUpperUpLeft",
    "mouthUpperUpRight",
    "browDownLeft",
    "browDownRight",
    "browInnerUp",
    "browOuterUpLeft",
    "browOuterUpRight",
    "cheekPuff",
    "cheekSquintLeft",
    "cheekSquintRight",
    "noseSneerLeft",
    "noseSneerRight",
    "tongueOut",
]


@cache
def sample(seed: int = 0) -> FaceParts:
    return make(seed)


def mesh(face: FaceParts, name: str) -> Mesh:
    return next(mesh for mesh in face.meshes if mesh.name == name)


def shape_of(part: Mesh, name: str) -> Blendshape:
    return next(shape for shape in part.blendshapes if shape.name == name)


def posed(part: Mesh, name: str, weight: float = 1.0) -> FloatArray:
    """Points with one shape at `weight`, piecewise linear through its inbetweens."""
    shape = shape_of(part, name)
    keys = [
        (0.0, np.zeros_like(shape.offsets)),
        *((i.weight, i.offsets) for i in shape.inbetweens),
        (1.0, shape.offsets),
    ]
    points = part.points.copy()
    for (low, before), (high, after) in pairwise(keys):
        if low <= weight <= high:
            share = (weight - low) / (high - low)
            points[shape.point_indices] += before * (1 - share) + after * share
            break
    return points


def corner_positions(part: Mesh) -> tuple[FloatArray, FloatArray]:
    triangles = point_triangles(part.face_vertex_counts, part.face_vertex_indices)
    return part.points[triangles], triangles


def test_same_seed_gives_the_same_file(tmp_path: Path) -> None:
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        save_parts(make(3), folder / "head.usdc")
    assert (tmp_path / "a" / "head.usdc").read_bytes() == (tmp_path / "b" / "head.usdc").read_bytes()


def test_seeds_are_different_people_on_one_topology() -> None:
    first = sample(0)
    for seed in SEEDS[1:]:
        other = sample(seed)
        assert other.skeleton.joints == first.skeleton.joints
        for a, b in zip(first.meshes, other.meshes, strict=True):
            np.testing.assert_array_equal(a.face_vertex_counts, b.face_vertex_counts)
            np.testing.assert_array_equal(a.face_vertex_indices, b.face_vertex_indices)
            np.testing.assert_array_equal(a.uv_sets[0].indices, b.uv_sets[0].indices)
            assert [s.name for s in a.blendshapes] == [s.name for s in b.blendshapes]
        moved = np.linalg.norm(mesh(first, "Head").points - mesh(other, "Head").points, axis=1)
        assert moved.max() > 2 * MM
        assert (
            mesh(first, "Head").landmarks["multipie68"].indices.tolist()
            == mesh(other, "Head").landmarks["multipie68"].indices.tolist()
        )


@pytest.mark.parametrize("seed", SEEDS)
def test_size_and_finite_values(seed: int) -> None:
    face = sample(seed)
    assert 5000 <= sum(len(part.points) for part in face.meshes) <= 10000
    points = mesh(face, "Head").points
    chin = points[mesh(face, "Head").landmarks["multipie68"].indices[8], 1]
    assert 21.0 < points[:, 1].max() - chin < 24.5
    for part in face.meshes:
        arrays = [part.points, part.normals, part.colors, part.uv_sets[0].values, part.skin.joint_weights]
        arrays += [s.offsets for s in part.blendshapes]
        arrays += [s.normal_offsets for s in part.blendshapes if s.normal_offsets is not None]
        assert all(np.isfinite(array).all() for array in arrays)
        assert part.colors.min() >= 0
        assert part.colors.max() <= 1


def test_head_is_manifold_with_one_border_at_the_neck() -> None:
    head = mesh(sample(), "Head")
    pairs, faces = edges(head.face_vertex_counts, head.face_vertex_indices)
    assert set(faces) == {1, 2}
    border = pairs[faces == 1]
    assert len(np.unique(components(len(head.points), pairs))) == 1
    assert (np.bincount(border.ravel())[np.unique(border)] == 2).all()
    assert len(np.unique(components(len(head.points), border)[np.unique(border)])) == 1
    assert head.points[np.unique(border), 1].max() < -15
    assert (head.face_vertex_counts == 4).mean() > 0.99
    assert head.anchor in border
    assert head.points[head.anchor, 2] == head.points[np.unique(border), 2].min()


@pytest.mark.parametrize(
    "name", ["Head", "EyeLeft", "EyeRight", "TeethUpper", "TeethLower", "Tongue", "Brows", "Lashes", "Hair"]
)
def test_faces_are_consistently_wound_and_not_degenerate(name: str) -> None:
    for seed in SEEDS:
        part = mesh(sample(seed), name)
        indices, counts = part.face_vertex_indices, part.face_vertex_counts
        after = np.arange(1, len(indices) + 1)
        ends = np.cumsum(counts)
        after[ends - 1] = ends - counts
        directed = np.stack([indices, indices[after]], axis=1)
        assert len(np.unique(directed, axis=0)) == len(directed)  # neighbours run along a shared edge in opposite ways
        corners, _ = corner_positions(part)
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        assert areas.min() > 1e-6


def test_closed_meshes_face_outwards() -> None:
    for seed in SEEDS:
        for name in ("Head", "EyeLeft", "EyeRight", "Tongue"):
            corners, _ = corner_positions(mesh(sample(seed), name))
            corners = corners - corners.reshape(-1, 3).mean(axis=0)
            volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
            assert volume > 0


@pytest.mark.parametrize("seed", SEEDS)
def test_texture_coordinates_cover_every_face_once(seed: int) -> None:
    for part in sample(seed).meshes:
        uv = part.uv_sets[0]
        indices = part.face_vertex_indices if uv.indices is None else uv.indices
        assert uv.values.min() >= 0
        assert uv.values.max() <= 1
        corners = uv.values[point_triangles(part.face_vertex_counts, indices)]
        u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
        assert area.min() > 1e-9  # none degenerate, none mirrored
        assert area.sum() < 1 + 1e-9


@pytest.mark.parametrize("seed", SEEDS)
def test_left_and_right_mirror_exactly(seed: int) -> None:
    head = mesh(sample(seed), "Head")
    mirror = topology.build().mirror
    np.testing.assert_array_equal(mirror[mirror], np.arange(len(mirror)))
    np.testing.assert_array_equal(head.points[mirror] * (-1, 1, 1), head.points)
    maps = shapes.mirror_maps(build_neutral(identity.from_seed(seed)))
    for part in sample(seed).meshes:
        for shape in part.blendshapes:
            if not shape.name.endswith("Left"):
                continue
            other, index = maps[part.name]
            twin = mesh(sample(seed), other)
            left = posed(part, shape.name) - part.points
            right = posed(twin, shape.name[:-4] + "Right") - twin.points
            np.testing.assert_allclose(right[index] * (-1, 1, 1), left, atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_lids_meet_and_stay_outside_the_eyeball(seed: int) -> None:
    head = mesh(sample(seed), "Head")
    rim = topology.build().rings["eyeLeft"][eyes.RIM]
    eye = eyes.eye(identity.from_seed(seed))
    half = len(rim) // 2
    pairs = [(rim[s], rim[-s]) for s in range(1, half)]
    opened = [np.linalg.norm(head.points[a] - head.points[b]) for a, b in pairs]
    closed_points = posed(head, "eyeBlinkLeft")
    closed = [np.linalg.norm(closed_points[a] - closed_points[b]) for a, b in pairs]
    assert max(opened) > 8 * MM
    assert max(closed) < 0.3 * MM
    patch = topology.build().rings["eyeLeft"][1:]
    for weight in np.linspace(0, 1, 21):
        distance = np.linalg.norm(posed(head, "eyeBlinkLeft", weight)[patch] - eye.center, axis=-1)
        assert distance.min() > eye.radius - 0.3 * MM


@pytest.mark.parametrize("seed", SEEDS)
def test_closed_lids_hide_the_eyeball(seed: int) -> None:
    face = sample(seed)
    eye = eyes.eye(identity.from_seed(seed))
    closed = posed(mesh(face, "Head"), "eyeBlinkLeft")
    rim = topology.build().rings["eyeLeft"][eyes.RIM]
    half = len(rim) // 2
    upper, lower = closed[rim[1:half]], closed[rim[:half:-1]]
    assert (upper[:, 1] >= lower[:, 1]).all()  # the lids don't pass each other
    assert (np.abs(upper[:, 0] - eye.center[0]).max()) < eye.radius + 2 * MM


@pytest.mark.parametrize("seed", SEEDS)
def test_jaw_opens_the_lips_and_takes_the_lower_teeth_along(seed: int) -> None:
    face = sample(seed)
    head = mesh(face, "Head")
    ring = topology.build().rings["mouth"][mouth.CONTACT]
    quarter = len(ring) // 4
    gap = head.points[ring[quarter]] - head.points[ring[-quarter]]
    assert 0 < np.linalg.norm(gap) < 0.3 * MM
    opened = posed(head, "jawOpen")
    assert np.linalg.norm(opened[ring[quarter]] - opened[ring[-quarter]]) > 20 * MM
    closed = opened + posed(head, "mouthClose") - head.points
    assert np.linalg.norm(closed[ring[quarter]] - closed[ring[-quarter]]) < 3 * MM
    teeth = mesh(face, "TeethLower")
    drop = (posed(teeth, "jawOpen") - teeth.points)[:, 1]
    assert drop.max() < -5 * MM
    assert "jawOpen" not in {shape.name for shape in mesh(face, "TeethUpper").blendshapes}


def test_names_of_shapes() -> None:
    face = sample()
    names = {shape.name for part in face.meshes for shape in part.blendshapes}
    assert names == set(ARKIT)
    for part in face.meshes:
        for shape in part.blendshapes:
            assert (np.diff(shape.point_indices) > 0).all()
            assert shape.point_indices[-1] < len(part.points)
            assert shape.offsets.shape == (len(shape.point_indices), 3)
            assert all(i.offsets.shape == shape.offsets.shape for i in shape.inbetweens)


def test_most_shapes_are_sparse() -> None:
    head = mesh(sample(), "Head")
    share = [len(shape.point_indices) / len(head.points) for shape in head.blendshapes]
    assert np.median(share) < 0.5


@pytest.mark.parametrize("seed", SEEDS)
def test_weights_sum_to_one_without_repeats(seed: int) -> None:
    face = sample(seed)
    for part in face.meshes:
        indices, weights = part.skin.joint_indices, part.skin.joint_weights.astype(np.float32)
        np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-6)
        assert weights.min() >= 0
        assert indices.min() >= 0
        assert indices.max() < len(face.skeleton.joints)
        assert (indices[weights == 0] == 0).all()
        for row, weight in zip(indices, weights, strict=True):
            used = row[weight > 0]
            assert len(set(used)) == len(used)


def dense_weights(face: FaceParts, name: str) -> FloatArray:
    skin = mesh(face, name).skin
    dense = np.zeros((len(skin.joint_indices), len(face.skeleton.joints)))
    for k in range(skin.joint_indices.shape[1]):
        np.add.at(dense, (np.arange(len(dense)), skin.joint_indices[:, k]), skin.joint_weights[:, k])
    return dense


def columns(face: FaceParts, *starts: str) -> list[int]:
    return [i for i, path in enumerate(face.skeleton.joints) if path.rpartition("/")[2].startswith(starts)]


@pytest.mark.parametrize("seed", SEEDS)
def test_weights_do_not_cross_lips_or_lids(seed: int) -> None:
    face = sample(seed)
    labels = layout.build()
    weights = dense_weights(face, "Head")
    lower = weights[:, columns(face, "jaw", "lipLower", "chin", "jowl", "tongue")].sum(axis=1)
    upper = weights[:, columns(face, "lipUpper")].sum(axis=1)
    across, side = labels.across["mouth"], labels.upper["mouth"]
    lips = (labels.ring["mouth"] >= mouth.OUTLINE - 2) & (labels.ring["mouth"] <= mouth.CONTACT + 3)
    middle = lips & (across > layout.CORNER) & (across < 1 - layout.CORNER)
    assert lower[middle & (side > 0.5)].max() < 1e-3
    assert upper[middle & (side < 0.5)].max() < 1e-3
    corner = weights[:, columns(face, "lipCorner")].sum(axis=1)
    open_part = lips & (across > 0.3) & (across < 0.7)
    assert (lower + corner)[open_part & (side < 0.5)].min() > 0.85
    for eye in ("Left", "Right"):
        ring, across, side = (field["eye" + eye] for field in (labels.ring, labels.across, labels.upper))
        middle = (ring >= 1) & (across > layout.CORNER) & (across < 1 - layout.CORNER)
        up, low = (weights[:, columns(face, name)].sum(axis=1) for name in ("lidUpper" + eye, "lidLower" + eye))
        assert low[middle & (side > 0.5)].max() == 0
        assert up[middle & (side < 0.5)].max() == 0
        assert up[middle & (side > 0.5) & (ring == eyes.RIM)].min() > 0.5


@pytest.mark.parametrize("seed", SEEDS)
def test_weights_are_smooth_along_edges(seed: int) -> None:
    head = mesh(sample(seed), "Head")
    weights = dense_weights(sample(seed), "Head")
    pairs, _ = edges(head.face_vertex_counts, head.face_vertex_indices)
    steps = np.abs(weights[pairs[:, 0]] - weights[pairs[:, 1]]).max(axis=1)
    labels = layout.build()
    inside = (labels.ring["eyeLeft"] > eyes.RIM) | (labels.ring["eyeRight"] > eyes.RIM)
    length = np.linalg.norm(head.points[pairs[:, 0]] - head.points[pairs[:, 1]], axis=1)
    assert (steps - 1.6 * length)[~inside[pairs].any(axis=1)].max() < 0.2


def test_eyes_and_teeth_are_rigid() -> None:
    face = sample()
    for name, joint in (
        ("EyeLeft", "eyeLeft"),
        ("EyeRight", "eyeRight"),
        ("TeethUpper", "head"),
        ("TeethLower", "jaw"),
    ):
        weights = dense_weights(face, name)
        assert (weights[:, columns(face, joint)[0]] == 1).all()
    for side, sign in (("Left", 1), ("Right", -1)):
        joint = columns(face, "eye" + side)[0]
        center = mesh(face, "Eye" + side).points.mean(axis=0)
        assert np.sign(center[0]) == sign
        np.testing.assert_allclose(face.skeleton.bind_transforms[joint, :2, 3], center[:2], atol=1e-6)


@pytest.mark.parametrize("seed", SEEDS)
def test_rest_transforms_give_the_bind_transforms(seed: int) -> None:
    skeleton = sample(seed).skeleton
    assert len(skeleton.joints) >= 30
    world = np.zeros_like(skeleton.bind_transforms)
    for i, parent in enumerate(skeleton.parents):
        assert parent < i
        world[i] = skeleton.rest_transforms[i] if parent < 0 else world[parent] @ skeleton.rest_transforms[i]
    np.testing.assert_allclose(world, skeleton.bind_transforms, atol=1e-12)


def test_regions_sum_to_one_and_are_nine() -> None:
    for part in sample().meshes:
        assert len(part.regions) == 9
        total = np.sum(list(part.regions.values()), axis=0)
        np.testing.assert_allclose(total, 1.0, atol=1e-9)
    head = mesh(sample(), "Head")
    assert min(mask.max() for mask in head.regions.values()) > 0.75
    hard = np.concatenate(list(head.point_subsets.values()))
    assert sorted(hard) == list(range(len(head.points)))


@pytest.mark.parametrize("seed", SEEDS)
def test_landmarks_are_in_multipie_order(seed: int) -> None:
    head = mesh(sample(seed), "Head")
    indices = head.landmarks["multipie68"].indices
    assert len(set(indices.tolist())) == 68
    x, y, z = head.points[indices].T
    ascending = [
        range(17),
        range(17, 27),
        range(31, 36),
        range(48, 55),
        range(60, 65),
        (36, 37, 38, 39),
        (42, 43, 44, 45),
    ]
    for group in ascending:  # from the subject's right (-X) to the left
        assert (np.diff(x[list(group)]) > 0).all(), list(group)
    for group in (range(54, 60), (64, 65, 66, 67), (39, 40, 41), (45, 46, 47)):
        assert (np.diff(x[list(group)]) < 0).all(), list(group)
    assert (np.diff(y[27:31]) < 0).all()
    assert y[8] == y.min()
    assert z[30] == z.max()
    assert y[17:27].min() > y[36:48].max()
    assert y[37:39].min() > y[40:42].max()
    assert y[43:45].min() > y[46:48].max()
    assert y[49:54].min() > y[61:64].max() > y[65:68].min() > y[55:60].max()
    pairs = [(0, 16), (17, 26), (36, 45), (39, 42), (48, 54), (31, 35), (60, 64)]
    for right, left in pairs:
        np.testing.assert_allclose(head.points[indices[right]] * (-1, 1, 1), head.points[indices[left]], atol=1e-12)


def test_sliders_limits_and_animations_name_what_exists() -> None:
    face = sample()
    names = {shape.name for part in face.meshes for shape in part.blendshapes}
    assert len(face.sliders) >= 10
    for slider in face.sliders:
        assert slider.channels or slider.shapes
        assert {joint for joint, _, _ in slider.channels} <= set(face.skeleton.joints)
        assert {name for name, _ in slider.shapes} <= names
    limits = face.bone_limits
    assert limits.lower.shape == limits.upper.shape == (len(face.skeleton.joints), 9)
    rest = np.repeat([0.0, 0.0, 1.0], 3)
    assert (limits.lower <= rest).all()
    assert (limits.upper >= rest).all()
    for animation in face.animations:
        assert set(animation.joints) <= set(face.skeleton.joints)
        assert set(animation.shapes) <= names
        np.testing.assert_allclose(np.linalg.norm(animation.rotations, axis=-1), 1.0)
        samples = 1 if animation.times is None else len(animation.times)
        assert animation.shape_weights.shape == (samples, len(animation.shapes))
        assert animation.translations.shape == (samples, len(animation.joints), 3)


def test_materials_are_all_defined() -> None:
    face = sample()
    defined = {material.name for material in face.materials}
    used = {part.material for part in face.meshes}
    used |= {group.material for part in face.meshes for group in part.material_faces}
    assert used == defined
    for name in ("EyeLeft", "EyeRight", "TeethUpper", "TeethLower"):
        part = mesh(face, name)
        faces = np.concatenate([group.faces for group in part.material_faces])
        assert sorted(faces) == list(range(len(part.face_vertex_counts)))


@pytest.mark.parametrize("seed", SEEDS)
def test_skin_texture_shows_the_points_colors(seed: int) -> None:
    from io import BytesIO

    from PIL import Image

    face = sample(seed)
    head = mesh(face, "Head")
    skin = next(material for material in face.materials if material.name == head.material)
    pixels = np.asarray(Image.open(BytesIO(skin.diffuse_color.texture.data))) / 255.0
    uv = head.uv_sets[0]
    u, v = uv.values[uv.indices].T
    rows = np.clip(((1 - v) * len(pixels)).astype(int), 0, len(pixels) - 1)
    columns_ = np.clip((u * len(pixels)).astype(int), 0, len(pixels) - 1)
    linear = np.where(pixels <= 0.04045, pixels / 12.92, ((pixels + 0.055) / 1.055) ** 2.4)
    difference = np.abs(linear[rows, columns_] - head.colors[head.face_vertex_indices]).max(axis=1)
    assert np.percentile(difference, 95) < 0.03
    assert difference.mean() < 0.01


@pytest.mark.parametrize("seed", SEEDS)
def test_shapes_do_not_fold_the_skin(seed: int) -> None:
    head = mesh(sample(seed), "Head")
    labels = layout.build()
    hidden = labels.ring["mouth"] > mouth.OUTLINE
    for side in ("Left", "Right"):
        hidden |= (labels.ring["eye" + side] >= 0) | (labels.ring["nostril" + side] >= 1)
    triangles = point_triangles(head.face_vertex_counts, head.face_vertex_indices)
    triangles = triangles[~hidden[triangles].any(axis=1)]

    def normals(points: FloatArray) -> FloatArray:
        a, b, c = (points[triangles[:, i]] for i in range(3))
        normal = np.cross(b - a, c - a)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    neutral = normals(head.points)
    for shape in head.blendshapes:
        if shape.name != "mouthClose":  # belongs on an open jaw
            turned = np.einsum("ij,ij->i", neutral, normals(posed(head, shape.name)))
            assert turned.min() > 0, shape.name
