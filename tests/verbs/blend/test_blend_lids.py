"""How deep lids cut into eyeballs: against balls that are known, eyeballs that move, and two of them in one mesh."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from blend_faces import by_region, head, misaligned, only_shapes, rolling_eyes
from scipy.spatial.transform import Rotation

from facepipe.geometry.balls import fit_ball
from facepipe.parts import FaceParts, Mesh
from facepipe.stage import Face
from facepipe.verbs.blend import BlendOptions, BlendSession
from facepipe.verbs.blend.quality import LidContact, lid_contacts
from facepipe.verbs.blend.session import Solution

LOOK, BLINK = "eyeLookInLeft", "eyeBlinkLeft"
TOLERANCE = 1e-3  # mm; the eyeballs are balls to float32


@functools.cache
def solved() -> tuple[BlendSession, Solution]:
    """Two samples, with a shape that moves an eyeball and one that moves its lids."""
    parts = [only_shapes(rolling_eyes(head("sample", number)), LOOK, BLINK) for number in range(2)]
    blend = BlendSession([Face.from_parts(parts[0]), Face.from_parts(misaligned(parts[1]))])
    return blend, blend.solve(by_region("features"))


def contact(solution: Solution) -> LidContact:
    return lid_contacts(solved()[0], solution)["EyeballLeft"]


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
    contacts = []
    for change in (lambda parts: parts, one_mesh):
        blend = BlendSession([Face.from_parts(change(parts)) for parts in faces], BlendOptions(keep_shape="Eye*"))
        contacts.append(lid_contacts(blend, blend.solve(by_region("features"))))
    apart, together = contacts
    assert list(together) == ["Eyeballs 1", "Eyeballs 2"]
    assert apart["EyeballLeft"].depth_mm > 0.2 > apart["EyeballRight"].depth_mm
    for one, other in zip((apart["EyeballLeft"], apart["EyeballRight"]), together.values(), strict=True):
        assert (other.depth_mm, *other.sources_mm) == pytest.approx((one.depth_mm, *one.sources_mm), abs=0.01)
