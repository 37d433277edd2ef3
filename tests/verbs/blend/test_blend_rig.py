"""Skins, skeletons, clips and normals of several faces blended."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from faces import grid_mesh, skeleton, tiny_face
from hypothesis import given, settings
from hypothesis import strategies as st

from facepipe import parts as p
from facepipe.core.errors import InputError, TopologyError
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.rig import matrix_coefficients
from facepipe.rig.animation import local_transforms
from facepipe.rig.trs import compose, rotation_matrices
from facepipe.verbs.blend.result import blend_normals, normal_offsets
from facepipe.verbs.blend.rigs import blend_linear, blend_skeletons, blend_skins, rebase_animations

SEEDS = st.integers(0, 10**6)


def random_skin(rng: np.random.Generator, points: int, joints: int, width: int) -> p.Skin:
    """Influences with joints named twice, and weights of 0."""
    weights = rng.random((points, width)) * (rng.random((points, width)) > 0.2)
    weights[:, 0] += 0.1
    weights /= weights.sum(axis=1, keepdims=True)
    indices = rng.integers(0, joints, (points, width)).astype(np.int32)
    return p.Skin(joint_indices=indices, joint_weights=weights.astype(np.float32))


def dense(skin: p.Skin, joints: int) -> np.ndarray:
    """(n, joints) weights."""
    full = np.zeros((len(skin.joint_indices), joints))
    np.add.at(full, (np.arange(len(full))[:, None], skin.joint_indices), skin.joint_weights)
    return full


def shares(rng: np.random.Generator, rows: int, sources: int) -> np.ndarray:
    """(rows, sources) shares; some rows belong to one source."""
    table = rng.dirichlet(np.ones(sources), rows)
    table[::4] = np.eye(sources)[rng.integers(0, sources, len(table[::4]))]
    return table


@settings(max_examples=30, deadline=None)
@given(SEEDS)
def test_skin_is_the_weighted_sum_of_dense_weights(seed: int) -> None:
    """Widths differ; nothing is left out where the widest source has room."""
    rng = np.random.default_rng(seed)
    skins = [random_skin(rng, 20, 3, 2), random_skin(rng, 20, 3, 3)]
    own = [dense(skin, 3) for skin in skins]
    table = shares(rng, 20, 2)
    blended = blend_skins(skins, table)
    assert blended is not None
    np.testing.assert_allclose(dense(blended, 3), np.einsum("nk,knj->nj", table, np.stack(own)), atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(SEEDS)
def test_skin_keeps_the_largest_influences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    skins, table = [random_skin(rng, 30, 12, 3) for _ in range(3)], shares(rng, 30, 3)
    blended = blend_skins(skins, table)
    assert blended is not None
    assert blended.joint_weights.shape == (30, 3)
    np.testing.assert_allclose(blended.joint_weights.sum(axis=1), 1, atol=1e-12)
    assert (np.diff(blended.joint_weights, axis=1) <= 0).all()
    assert (blended.joint_indices[blended.joint_weights == 0] == 0).all()
    full = np.einsum("nk,knj->nj", table, np.stack([dense(skin, 12) for skin in skins]))
    largest = -np.sort(-full, axis=1)[:, :3]
    np.testing.assert_allclose(blended.joint_weights, largest / largest.sum(axis=1, keepdims=True), atol=1e-12)
    for row, (joints, weights) in enumerate(zip(blended.joint_indices, blended.joint_weights, strict=True)):
        used = joints[weights > 0]
        assert len(set(used.tolist())) == len(used)
        assert full[row, used].min() >= np.delete(full[row], used).max() - 1e-12


def test_skins_that_agree_are_the_base() -> None:
    """Also where influences stand in another order, and the shares don't matter."""
    rng = np.random.default_rng(0)
    base = random_skin(rng, 20, 4, 3)
    other = p.Skin(
        joint_indices=base.joint_indices[:, ::-1],
        joint_weights=base.joint_weights[:, ::-1] * np.float64(1 + 1e-10),
        geom_bind_transform=np.diag([2.0, 2, 2, 1]),
    )
    assert blend_skins([base, other, None], shares(rng, 20, 3)) is base


def test_points_where_skins_agree_keep_their_weights() -> None:
    rng = np.random.default_rng(1)
    base = random_skin(rng, 20, 4, 3)
    weights = base.joint_weights.copy()
    weights[7] = weights[7, ::-1]
    blended = blend_skins([base, replace(base, joint_weights=weights)], np.full((20, 2), 0.5))
    assert blended is not None
    rest = np.arange(20) != 7
    np.testing.assert_array_equal(dense(blended, 4)[rest], dense(base, 4)[rest])
    np.testing.assert_array_equal(blended.geom_bind_transform, base.geom_bind_transform)


def test_skins_that_are_missing() -> None:
    rng = np.random.default_rng(2)
    skin = random_skin(rng, 5, 4, 3)
    assert blend_skins([None, skin], np.full((5, 2), 0.5)) is None


def turned(angle: float, axis: int = 2) -> np.ndarray:
    """(3, 3) rotation about a coordinate axis."""
    vector = np.zeros(4)
    vector[axis], vector[3] = np.sin(angle / 2), np.cos(angle / 2)
    return rotation_matrices(vector)


def random_skeleton(rng: np.random.Generator, *, at_rest: bool = False, shear: bool = False) -> p.Skeleton:
    """Five joints, two of them roots; the rest pose another than the bind pose unless `at_rest`."""
    joints = ("root", "root/jaw", "root/jaw/lip", "root/eye", "other")
    rest = compose(rng.normal(size=(5, 3)), rng.normal(size=(5, 4)), rng.uniform(0.5, 2, (5, 3)))
    local = rest if at_rest else rest @ compose(rng.normal(size=(5, 3)), rng.normal(size=(5, 4)), np.ones((5, 3)))
    if shear:
        local[1, 0, 1] += 0.3
        local[3, :3, 0] *= -1
    return p.Skeleton(joints=joints, rest_transforms=rest, bind_transforms=worlds(local, joints))


def worlds(local: np.ndarray, joints: tuple[str, ...]) -> np.ndarray:
    result = local.copy()
    for i, parent in enumerate(p.Skeleton(joints=joints).parents):
        if parent >= 0:
            result[i] = result[parent] @ local[i]
    return result


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.integers(1, 3), st.booleans())
def test_skeletons_that_agree_are_given_back(seed: int, sources: int, shear: bool) -> None:
    """Mirrored and sheared transforms too, whatever the shares."""
    rng = np.random.default_rng(seed)
    base = random_skeleton(rng, shear=shear)
    binds = np.stack([base.bind_transforms] * sources)
    result = blend_skeletons([base] * sources, binds, binds[0, :, :3, 3], shares(rng, 5, sources))
    np.testing.assert_allclose(result.bind_transforms, base.bind_transforms, atol=1e-12)
    np.testing.assert_allclose(result.rest_transforms, base.rest_transforms, atol=1e-11)
    assert (result.joints, result.name) == (base.joints, base.name)


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_faces_that_rest_as_they_are_bound_still_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sources = [random_skeleton(rng, at_rest=True) for _ in range(3)]
    places = rng.normal(size=(5, 3))
    result = blend_skeletons(
        sources, np.stack([source.bind_transforms for source in sources]), places, shares(rng, 5, 3)
    )
    np.testing.assert_array_equal(result.bind_transforms[:, :3, 3], places)
    np.testing.assert_allclose(worlds(result.rest_transforms, result.joints), result.bind_transforms, atol=1e-9)


def test_the_place_on_a_body_is_kept() -> None:
    """Rest transforms of roots count from the body's joint: what takes bind to rest there is one for the whole face."""
    rng = np.random.default_rng(3)
    body = compose(np.array([1.0, 150, 3]), rng.normal(size=4), np.ones(3))
    sources = []
    for _ in range(2):
        local = compose(rng.normal(size=(5, 3)), rng.normal(size=(5, 4)), np.ones((5, 3)))
        roots = np.array([True, False, False, False, True])
        own = random_skeleton(rng)
        bind = worlds(np.where(roots[:, None, None], body @ local, local), own.joints)
        sources.append(replace(own, rest_transforms=local, bind_transforms=bind))
    places = rng.normal(size=(5, 3)) + np.array([0, 150, 0])
    result = blend_skeletons(
        sources, np.stack([source.bind_transforms for source in sources]), places, shares(rng, 5, 2)
    )
    at_rest = worlds(result.rest_transforms, result.joints)
    np.testing.assert_allclose(body @ at_rest, result.bind_transforms, atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_a_source_in_other_units_and_axes_is_the_same_source(seed: int) -> None:
    """Another unit scales places only."""
    rng = np.random.default_rng(seed)
    base, other = random_skeleton(rng), random_skeleton(rng)
    to_base = np.diag([10.0, 10, 10, 1]) @ np.block([[turned(-np.pi / 2, 0), np.zeros((3, 1))], [np.eye(4)[3:]]])
    binds = np.stack([base.bind_transforms, other.bind_transforms])
    places, table = rng.normal(size=(5, 3)), shares(rng, 5, 2)
    expected = blend_skeletons([base, other], binds, places, table)
    foreign = np.linalg.inv(to_base) @ other.bind_transforms
    foreign[..., :3, :3] *= 10  # the same axes, places in the other unit
    rest = other.rest_transforms.copy()
    rest[:, :3, 3] /= 10
    for root in (0, 4):
        moved = np.linalg.inv(to_base) @ other.rest_transforms[root]
        moved[:3, :3] *= 10
        rest[root] = moved
    same = replace(other, bind_transforms=foreign, rest_transforms=rest)
    result = blend_skeletons([base, same], np.stack([binds[0], to_base @ foreign]), places, table)
    np.testing.assert_allclose(result.bind_transforms, expected.bind_transforms, atol=1e-9)
    np.testing.assert_allclose(result.rest_transforms, expected.rest_transforms, atol=1e-7)


def test_orientations_are_halfway() -> None:
    """Between two rotations about one axis, on the short way round, whatever the signs of their quaternions."""
    angles = np.radians([[170.0, 10, -100], [-170, 50, 100]])
    matrices = np.stack([[turned(a) @ np.diag([1, 2, 3.0]) for a in row] for row in angles])
    matrices[1] *= 3
    result = blend_linear(matrices, np.full((3, 2), 0.5))
    expected = [turned(np.radians(a)) @ np.diag([2, 4, 6.0]) for a in (180, 30, 180)]
    np.testing.assert_allclose(result, expected, atol=1e-12)


def test_opposite_orientations_take_the_larger_share() -> None:
    matrices = np.stack([[turned(0.0)], [turned(np.pi)]])
    np.testing.assert_allclose(blend_linear(matrices, np.array([[0.5, 0.5]]))[0], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(blend_linear(matrices, np.array([[0.2, 0.8]]))[0], turned(np.pi), atol=1e-12)


def test_skeletons_that_do_not_blend() -> None:
    base = skeleton()
    binds = np.stack([base.bind_transforms] * 2)
    table, places = np.full((3, 2), 0.5), binds[0, :, :3, 3]
    mirrored = binds.copy()
    mirrored[1, 2, :3, 0] *= -1
    with pytest.raises(TopologyError, match=r"root/jaw/lip: .*mirrored in some"):
        blend_skeletons([base, replace(base, bind_transforms=mirrored[1])], mirrored, places, table)
    none = p.Skeleton()
    assert blend_skeletons([none, none], np.zeros((2, 0, 4, 4)), np.zeros((0, 3)), np.zeros((0, 2))) is none


def clip(rng: np.random.Generator, joints: tuple[str, ...]) -> p.Animation:
    turns = rng.normal(size=(6, len(joints), 4))
    return p.Animation(
        name="clip",
        times=np.arange(6.0),
        joints=joints,
        translations=rng.normal(size=(6, len(joints), 3)),
        rotations=turns / np.linalg.norm(turns, axis=2, keepdims=True),
        scales=rng.uniform(0.5, 2, (6, len(joints), 3)),
    )


@settings(max_examples=30, deadline=None)
@given(SEEDS)
def test_clips_keep_their_motion_relative_to_rest(seed: int) -> None:
    """Rest transforms without unequal scales, so that nothing shears."""
    rng = np.random.default_rng(seed)
    old, new = (
        replace(
            random_skeleton(rng),
            rest_transforms=compose(rng.normal(size=(5, 3)), rng.normal(size=(5, 4)), rng.uniform(0.5, 2, (5, 1))),
        )
        for _ in range(2)
    )
    one = clip(rng, ("root/eye", "root", "root/jaw"))
    (rebased,) = rebase_animations([one], old, new)
    used = [3, 0, 1]
    before, after = local_transforms(old, one), local_transforms(new, rebased)
    relative = [np.linalg.inv(s.rest_transforms[used]) @ m for s, m in ((old, before), (new, after))]
    np.testing.assert_allclose(matrix_coefficients(relative[1]), matrix_coefficients(relative[0]), atol=1e-9)
    signs = [np.sign(np.einsum("tjc,tjc->tj", r[1:], r[:-1])) for r in (one.rotations, rebased.rotations)]  # type: ignore[index]
    assert (signs[0].shape, len(rebased.scales)) == ((5, 3), 6)  # type: ignore[arg-type]


def test_rotations_do_not_flip_between_samples() -> None:
    """A steady turn stays one where the new rest takes it across the sign change of quaternions."""
    old, new = p.Skeleton(joints=("a",), rest_transforms=np.eye(4)[None]), None
    turn = np.eye(4)
    turn[:3, :3] = turned(3.0)
    new = replace(old, rest_transforms=turn[None])
    angles = np.linspace(0, 1, 9)
    rotations = np.zeros((9, 1, 4))
    rotations[:, 0, 2], rotations[:, 0, 3] = np.sin(angles / 2), np.cos(angles / 2)
    one = p.Animation(name="turn", times=angles, joints=("a",), rotations=rotations)
    (rebased,) = rebase_animations([one], old, new)
    assert rebased.rotations is not None
    assert (np.einsum("tjc,tjc->tj", rebased.rotations[1:], rebased.rotations[:-1]) > 0.9).all()


def test_clips_that_need_no_rebasing_stay() -> None:
    """No joint with another rest, only coefficients or only shapes: the very objects."""
    rng = np.random.default_rng(4)
    old = random_skeleton(rng)
    rest = old.rest_transforms.copy()
    rest[1, 0, 3] += 1
    new = replace(old, rest_transforms=rest)
    eye, both = clip(rng, ("root/eye",)), clip(rng, ("root/eye", "root/jaw"))
    numbers = p.Animation(name="n", joints=("root/jaw",), coefficients=rng.random((1, 1, 9)))
    shapes = p.Animation(name="s", shapes=("jawOpen",), shape_weights=np.ones((1, 1)))
    result = rebase_animations([eye, numbers, shapes, both], old, new)
    assert result[0] is eye
    assert result[1] is numbers
    assert result[2] is shapes
    np.testing.assert_array_equal(result[3].translations[:, 0], both.translations[:, 0])  # type: ignore[index]
    np.testing.assert_array_equal(result[3].rotations[:, 0], both.rotations[:, 0])  # type: ignore[index]
    assert result[3].coefficients is None
    flat = replace(old, rest_transforms=old.rest_transforms * np.float64([[0, 1, 1, 1]] * 4))
    with pytest.raises(TopologyError, match="clip -> root/eye: singular"):
        rebase_animations([eye], flat, old)
    with pytest.raises(InputError, match="is not a joint of the skeleton"):
        rebase_animations([clip(rng, ("root/jaw", "tail"))], old, new)


def units(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


@settings(max_examples=30, deadline=None)
@given(SEEDS)
def test_normals_add_what_was_authored_to_the_surface(seed: int) -> None:
    rng = np.random.default_rng(seed)
    own, surfaces, surface = rng.normal(size=(3, 12, 3)), units(rng.normal(size=(3, 12, 3))), rng.normal(size=(12, 3))
    surface, table = units(surface), shares(rng, 12, 3)
    expected = surface + np.einsum("mk,kmc->mc", table, units(own) - surfaces)
    blended = blend_normals(list(own), surfaces, surface, table)
    np.testing.assert_allclose(blended, units(expected), atol=1e-9)
    np.testing.assert_allclose(blend_normals(list(own * 7), surfaces, surface, table), blended, atol=1e-12)
    follow = blend_normals(list(surfaces), surfaces, surface, table)
    np.testing.assert_allclose(follow, surface, atol=1e-12)  # normals of the surface stay normals of the surface
    whole = blend_normals([own[0]] * 3, surfaces[[0, 0, 0]], surfaces[0], table)
    np.testing.assert_allclose(whole, units(own[0]), atol=1e-12)  # sources that agree are given back


def test_normals_of_sources_without_are_those_of_their_surface() -> None:
    up, side = np.tile([0.0, 1, 0], (2, 1)), np.tile([1.0, 0, 0], (2, 1))
    assert blend_normals([None, None], np.stack([up, up]), up, np.full((2, 2), 0.5)) is None
    blended = blend_normals([None, side], np.stack([up, up]), up, np.array([[1.0, 0], [0.5, 0.5]]))
    np.testing.assert_allclose(blended, [[0, 1, 0], units(np.array([1.0, 1, 0]))], atol=1e-12)


def test_normals_that_cancel_or_have_no_length_are_the_surface() -> None:
    up, zero = np.tile([0.0, 1, 0], (2, 1)), np.zeros((2, 3))
    blended = blend_normals([-up, zero], np.stack([up, up]), up, np.array([[0.5, 0.5], [0.0, 1.0]]))
    np.testing.assert_allclose(blended, up)


def test_normal_offsets_lead_to_the_deformed_normals() -> None:
    mesh = grid_mesh()
    triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
    deformed = mesh.points + np.random.default_rng(5).normal(0, 0.2, mesh.points.shape)
    indices = np.array([0, 7, 35])
    offsets = normal_offsets(mesh.points, deformed, triangles, indices)
    expected = point_normals(deformed, triangles) - point_normals(mesh.points, triangles)
    np.testing.assert_allclose(offsets, expected[indices], atol=1e-12)
    np.testing.assert_array_equal(normal_offsets(mesh.points, mesh.points, triangles, indices), np.zeros((3, 3)))


def test_a_blended_rig_deforms_as_its_sources_do_where_they_agree() -> None:
    """The tiny face with itself: skin and skeleton are the base's."""
    parts = tiny_face()
    skins = [parts.meshes[0].skin] * 2
    assert blend_skins(skins, np.full((36, 2), 0.5)) is skins[0]
