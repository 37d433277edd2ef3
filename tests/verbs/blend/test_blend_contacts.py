"""Skin in eyeballs: how deep it is found, against balls that are known, and that a blend holds it out of them."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh
from blend_faces import by_region, head, misaligned, only_shapes, rolling_eyes
from scipy.spatial.transform import Rotation

from facepipe.geometry.balls import fit_ball
from facepipe.geometry.polygons import triangle_normals
from facepipe.heads.assembly import make_head
from facepipe.heads.people import draw
from facepipe.parts import FaceParts, Mesh
from facepipe.stage import Face
from facepipe.verbs.blend import BlendOptions, BlendSession, Weights
from facepipe.verbs.blend.bodies import Body, Surface
from facepipe.verbs.blend.contacts import Motion
from facepipe.verbs.blend.quality import Contact, contacts
from facepipe.verbs.blend.session import Solution

LOOK, BLINK = "eyeLookInLeft", "eyeBlinkLeft"
TOLERANCE = 1e-3  # mm; the eyeballs are balls to float32


@functools.cache
def solved() -> tuple[BlendSession, Solution]:
    """Two samples, with a shape that moves an eyeball and one that moves its lids."""
    parts = [only_shapes(rolling_eyes(head("sample", number)), LOOK, BLINK) for number in range(2)]
    faces = [Face.from_parts(parts[0]), Face.from_parts(misaligned(parts[1]))]
    blend = BlendSession(faces, BlendOptions(contacts=False))
    return blend, blend.solve(by_region("features"))


def test_depths_are_distances_to_the_nearest_place_at_sharp_edges_too() -> None:
    tooth: Any = trimesh.creation.box((4.0, 2.0, 6.0))
    for _ in range(3):
        tooth = tooth.subdivide()
    body = Body("Teeth", np.arange(len(tooth.vertices)), np.asarray(tooth.faces), np.zeros(0, np.int64))
    surface = Surface(body, np.asarray(tooth.vertices), None, 1.0)
    points = np.random.default_rng(3).uniform(-1.0, 1.0, (2000, 3)) * (2.5, 1.5, 3.5)
    deep = (np.array([2.0, 1.0, 3.0]) - np.abs(points)).min(axis=1)  # of a box, below its nearest side
    inside = deep > 0
    np.testing.assert_allclose(surface.depths(points)[inside], deep[inside], atol=1e-9)
    assert not surface.depths(points[~inside]).any()
    touching = surface.touching(points)
    np.testing.assert_array_equal(touching.rows, np.flatnonzero(inside))
    np.testing.assert_allclose(touching.depths, deep[inside], atol=1e-9)


def seen(blend: BlendSession, solution: Solution) -> dict[str, Contact]:
    """The contacts of a solution as it is."""
    rest, every = solution.neutral.points.copy(), np.ones(len(solution.neutral.points), bool)
    stand, held = blend.contacts.stand(rest), []
    at_rest = blend.contacts.hold(stand, rest, every, push=False)
    for sculpt, offsets in zip(solution.sculpts, solution.offsets, strict=True):
        points, moving = rest.copy(), ~every
        points[sculpt.points] += offsets
        moving[sculpt.points] = True
        motion = Motion(sculpt.name, sculpt.points, sculpt.offsets)
        held.append(blend.contacts.hold(stand, points, moving, motion, push=False))
    return contacts(blend, replace(solution, neutral=replace(solution.neutral, held=at_rest), held=tuple(held)))


def contact(solution: Solution) -> Contact:
    """That of the left eyeball; nothing where skin lies nowhere in it."""
    return seen(solved()[0], solution).get("EyeballLeft", Contact(sources_mm=(0.0, 0.0)))


def eye() -> np.ndarray:
    """Points of the left eyeball."""
    blend, _ = solved()
    number = [mesh.name for mesh in blend.sources.base.meshes].index("EyeballLeft")
    return np.arange(*blend.sources.mesh_offsets[number : number + 2])


def nearest(points: np.ndarray) -> int:
    """The point of the face that lies nearest to the eyeball."""
    face = np.flatnonzero(solved()[0].graph.main)
    return int(face[np.linalg.norm(points[face] - fit_ball(points[eye()]).centre, axis=1).argmin()])


def pose(solution: Solution, name: str, moves: dict[int, np.ndarray]) -> Solution:
    """The solution with more motion of points in one shape of the blend, and none of it in the sources."""
    number = [sculpt.name for sculpt in solution.sculpts].index(name)
    sculpt, offsets = solution.sculpts[number], solution.offsets[number]
    points = np.union1d(sculpt.points, list(moves))
    wide, ours = np.zeros((len(sculpt.offsets), len(points), 3)), np.zeros((len(points), 3))
    at = np.searchsorted(points, sculpt.points)
    wide[:, at], ours[at] = sculpt.offsets, offsets
    for point, move in moves.items():
        ours[np.searchsorted(points, point)] += move
    sculpts, all_offsets = list(solution.sculpts), list(solution.offsets)
    sculpts[number], all_offsets[number] = replace(sculpt, points=points, offsets=wide), ours
    return replace(solution, sculpts=tuple(sculpts), offsets=tuple(all_offsets))


def pushed(solution: Solution, depth_mm: float) -> tuple[int, np.ndarray]:
    """A point of the face, and the move that takes it to a depth in the eyeball."""
    points, mm = solution.neutral.points, solved()[0].sources.mm_per_unit
    own = fit_ball(points[eye()])
    point = nearest(points)
    out = (points[point] - own.centre) / np.linalg.norm(points[point] - own.centre)
    return point, own.centre + (own.radius - depth_mm / mm) * out - points[point]


def test_faces_whose_lids_stay_outside_have_no_depth() -> None:
    found = contact(solved()[1])
    assert found.depth_mm <= TOLERANCE
    assert max(found.sources_mm) <= TOLERANCE
    assert found.worst_depth_mm <= TOLERANCE


def test_a_lid_pushed_into_the_eyeball_is_reported_at_rest() -> None:
    _, solution = solved()
    point, move = pushed(solution, 2.5)
    points = solution.neutral.points.copy()
    points[point] += move
    found = contact(replace(solution, neutral=replace(solution.neutral, points=points)))
    assert found.depth_mm == pytest.approx(2.5, abs=TOLERANCE)
    assert found.sources_mm == pytest.approx((0.0, 0.0), abs=TOLERANCE)


def test_a_lid_pushed_in_by_one_shape_names_it() -> None:
    _, solution = solved()
    point, move = pushed(solution, 1.5)
    found = contact(pose(solution, BLINK, {point: move - shape_offset(solution, BLINK, point)}))
    assert found.worst_shape == BLINK
    assert found.worst_depth_mm == pytest.approx(1.5, abs=TOLERANCE)
    assert found.worst_sources_mm == pytest.approx((0.0, 0.0), abs=TOLERANCE)
    assert found.depth_mm <= TOLERANCE


def shape_offset(solution: Solution, name: str, point: int) -> np.ndarray:
    number = [sculpt.name for sculpt in solution.sculpts].index(name)
    full = np.zeros(solution.neutral.points.shape)
    full[solution.sculpts[number].points] = solution.offsets[number]
    return np.asarray(full[point])


def test_an_eyeball_that_moves_into_its_lids_is_measured_where_it_is() -> None:
    blend, solution = solved()
    forward = np.array([0.0, 0.0, 6.0 / blend.sources.mm_per_unit])
    found = contact(pose(solution, LOOK, dict.fromkeys(map(int, eye()), forward)))
    number = [sculpt.name for sculpt in solution.sculpts].index(LOOK)
    points = solution.neutral.points.copy()
    points[solution.sculpts[number].points] += solution.offsets[number]
    moved = fit_ball(points[eye()])
    to_face = np.linalg.norm(points[blend.graph.main] - moved.centre - forward, axis=1)
    expected = (moved.radius - to_face).max() * blend.sources.mm_per_unit
    assert expected > 2.0
    assert found.worst_shape == LOOK
    assert found.worst_depth_mm == pytest.approx(expected, abs=0.02)


def test_an_eyeball_that_turns_in_place_cuts_into_nothing() -> None:
    _, solution = solved()
    points = solution.neutral.points
    turn = Rotation.from_euler("y", 40, degrees=True).as_matrix()
    centre = fit_ball(points[eye()]).centre
    moves = {int(point): (turn - np.eye(3)) @ (points[point] - centre) for point in eye()}
    assert contact(pose(solution, LOOK, moves)).worst_depth_mm <= 0.02


def one_mesh(parts: FaceParts) -> FaceParts:
    """Both eyeballs in one mesh."""
    left, right = (next(mesh for mesh in parts.meshes if mesh.name == name) for name in ("EyeballLeft", "EyeballRight"))
    both = Mesh(
        name="Eyeballs",
        points=np.concatenate([left.points, right.points]),
        face_vertex_counts=np.concatenate([left.face_vertex_counts, right.face_vertex_counts]),
        face_vertex_indices=np.concatenate([left.face_vertex_indices, right.face_vertex_indices + len(left.points)]),
    )
    return replace(parts, meshes=(*(mesh for mesh in parts.meshes if mesh not in (left, right)), both))


def test_two_eyeballs_in_one_mesh_are_two_balls() -> None:
    """Lids cut in, as the left eyeball is made larger: each eye is measured as if it were alone."""

    def swollen(parts: FaceParts) -> FaceParts:
        def larger(mesh: Mesh) -> Mesh:
            middle = np.asarray(mesh.points).mean(axis=0)
            return replace(mesh, points=middle + 1.2 * (mesh.points - middle)) if mesh.name == "EyeballLeft" else mesh

        return replace(parts, meshes=tuple(map(larger, parts.meshes)))

    faces = [swollen(only_shapes(rolling_eyes(head("sample", number)))) for number in range(2)]
    found = []
    for change in (lambda parts: parts, one_mesh):
        blend = BlendSession(
            [Face.from_parts(change(parts)) for parts in faces], BlendOptions(keep_shape="Eye*", contacts=False)
        )
        found.append(seen(blend, blend.solve(by_region("features"))))
    apart, together = (
        [faces.get(name, Contact(sources_mm=(0.0, 0.0))) for name in names]
        for faces, names in zip(found, (("EyeballLeft", "EyeballRight"), ("Eyeballs 1", "Eyeballs 2")), strict=True)
    )
    assert apart[0].depth_mm > 0.2 > apart[1].depth_mm
    for one, other in zip(apart, together, strict=True):
        assert (other.depth_mm, *other.sources_mm) == pytest.approx((one.depth_mm, *one.sources_mm), abs=0.01)


def bare(parts: FaceParts) -> FaceParts:
    """Without materials."""
    return replace(parts, meshes=tuple(replace(mesh, material=None, material_faces=()) for mesh in parts.meshes))


@functools.cache
def held(hold: bool) -> tuple[BlendSession, Solution]:
    """Two people of the head in the box: the eyes of one in the face of the other, at rest and in two shapes."""
    parts = [only_shapes(bare(make_head(draw(seed).identity)), "eyeLookInLeft", BLINK) for seed in (20, 16)]
    blend = BlendSession([Face.from_parts(part) for part in parts], BlendOptions(contacts=hold))
    first = {"cheek": 0.0, "chin": 0.0, "ears": 0.9, "eyebrows": 0.6, "eyes": 0.54, "forehead": 0.0, "mouth": 0.0}
    regions = {**first, "neck": 1.0, "nose": 0.0}
    weights = Weights(regions={name: (1.0 - one, one) for name, one in regions.items()}, default=(0.8, 0.2))
    return blend, blend.solve(weights)


def depths(blend: BlendSession, points: np.ndarray, eyeball: str) -> np.ndarray:
    """(m,) mm of every point of the face inside the ball through an eyeball's outer shell, the cornea left out."""
    number = [mesh.name for mesh in blend.sources.base.meshes].index(eyeball)
    part = np.arange(*blend.sources.mesh_offsets[number : number + 2])
    ball = fit_ball(points[part][np.linalg.norm(points[part] - points[part].mean(axis=0), axis=1).argsort()[-600:]])
    face = points[blend.graph.main]
    return np.asarray(ball.radius - np.linalg.norm(face - ball.centre, axis=1)) * blend.sources.mm_per_unit


def test_a_blend_has_lids_no_deeper_in_eyeballs_than_its_sources() -> None:
    """Point by point, by the distance to the balls: no code of the blend's."""
    beyond = {}
    for hold in (False, True):
        blend, solution = held(hold)
        over = []
        for eyeball in ("EyeballLeft", "EyeballRight"):
            own = depths(blend, solution.neutral.points, eyeball)
            theirs = np.max([depths(blend, points, eyeball) for points in blend.sources.points], axis=0)
            over.append(float((own - np.maximum(theirs, 0.0)).max()))
        beyond[hold] = max(over)
    assert beyond[False] > 0.12
    assert beyond[True] < 0.06  # a ball is no eyeball to 0.04 mm


def test_what_is_held_out_changes_nothing_far_from_it_and_moves_no_static_point() -> None:
    (_, free), (blend, solution) = held(False), held(True)
    moved = np.linalg.norm(solution.neutral.points - free.neutral.points, axis=1) * blend.sources.mm_per_unit
    assert 0.1 < moved.max() < 3.0
    names = [mesh.name for mesh in blend.sources.base.meshes]
    balls = [np.arange(*blend.sources.mesh_offsets[k : k + 2]) for k, name in enumerate(names) if "Eyeball" in name]
    teeth = np.arange(*blend.sources.mesh_offsets[names.index("Teeth") : names.index("Teeth") + 2])
    near = np.concatenate([*balls, teeth])
    far = np.linalg.norm(solution.neutral.points[:, None] - solution.neutral.points[near[::40]], axis=2).min(axis=1)
    assert not moved[far * blend.sources.mm_per_unit > 40.0].any()
    assert not moved[np.concatenate(balls)].any()
    for own, other, sculpt in zip(solution.offsets, free.offsets, solution.sculpts, strict=True):
        assert own.shape == other.shape == (len(sculpt.points), 3)


def test_a_blend_turns_no_triangle_over_that_no_source_turns() -> None:
    """Counted anew, from the normals of all triangles in the sources and the blend, in each shape."""
    blend, solution = held(True)
    stands = [(np.zeros(0, np.int64), np.zeros((3, 0, 3)))]
    stands += [
        (sculpt.points, np.concatenate([sculpt.offsets, own[None]]))
        for sculpt, own in zip(solution.sculpts, solution.offsets, strict=True)
    ]
    for points, offsets in stands:
        poses = np.stack([*blend.sources.points, solution.neutral.points])
        poses[:, points] += offsets
        *theirs, own = (triangle_normals(pose, blend.graph.triangles) for pose in poses)
        away = np.all([np.einsum("ti,ti->t", own, normals) < 0 for normals in theirs], axis=0)
        assert not away.any()


def wedge(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Flesh between two walls (n, 3) that meet at an edge, and its triangles: a lip at a corner of the mouth."""
    solid: Any = trimesh.creation.extrude_triangulation(
        np.array([[0.0, 0.0], [10.0, -10.0 * np.tan(angle / 2)], [10.0, 10.0 * np.tan(angle / 2)]]),
        np.array([[0, 1, 2]]),
        20.0,
    )
    for _ in range(3):
        solid = solid.subdivide()
    return np.asarray(solid.vertices) - (0.0, 0.0, 10.0), np.asarray(solid.faces)


def test_skin_lies_in_a_lip_only_inside_its_flesh() -> None:
    """Beyond the edge of a thin fold places are below the plane of one of its walls, and yet in the open."""
    points, flesh = wedge(0.2)
    one_wall = np.flatnonzero(points[:, 1] <= 1e-9)  # what is known of the other lip ends at the edge
    place = np.full(len(points), -1)
    place[one_wall] = np.arange(len(one_wall))
    wall = place[flesh][(place[flesh] >= 0).all(axis=1)]
    body = Body("lip", one_wall, wall, np.zeros(0, np.int64), flesh=flesh)
    random = np.random.default_rng(5)
    asked = random.uniform((0.5, -0.8, -5.0), (8.0, 0.8, 5.0), (1000, 3))
    inside = np.abs(asked[:, 1]) < asked[:, 0] * np.tan(0.1)
    clear = np.abs(np.abs(asked[:, 1]) - asked[:, 0] * np.tan(0.1)) > 0.05
    upward = np.tile((0.0, 1.0, 0.0), (len(asked), 1))
    depths = Surface(body, points, None, 1.0).depths(asked, upward)
    without = Surface(replace(body, flesh=np.zeros((0, 3), np.int64)), points, None, 1.0).depths(asked)
    assert (without[clear & ~inside] > 0.1).sum() > 100
    assert not depths[clear & ~inside].any()
    np.testing.assert_array_equal(depths[clear & inside], without[clear & inside])
    assert depths[clear & inside].min() > 0


def test_flesh_that_ends_beyond_what_is_known_of_a_lip_is_found() -> None:
    """At corners of the mouth lips are joined: the nearest place of the other is its border."""
    points, flesh = wedge(0.6)
    one_wall = np.flatnonzero((points[:, 1] <= 1e-9) & (points[:, 0] > 2.0))
    place = np.full(len(points), -1)
    place[one_wall] = np.arange(len(one_wall))
    wall = place[flesh][(place[flesh] >= 0).all(axis=1)]
    surface = Surface(Body("lip", one_wall, wall, np.zeros(0, np.int64), flesh=flesh), points, None, 1.0)
    asked = np.random.default_rng(5).uniform((1.5, -1.0, -5.0), (2.0, 1.0, 5.0), (200, 3))
    high = np.abs(asked[:, 1]) - asked[:, 0] * np.tan(0.3)
    upward = np.tile((0.0, 1.0, 0.0), (len(asked), 1))
    found = np.isin(np.arange(len(asked)), surface.touching(asked, upward).rows)
    assert found[high < -0.05].all()
    assert not found[high > 0.05].any()
