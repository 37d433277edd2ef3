"""Shapes carried to the mesh of another head: what they are on meshes for which the answer is known."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from transfer_template import SHAPES, on, own, shapes, skin, template

from facepipe.geometry.polygons import edges
from facepipe.geometry.similarity import Similarity

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]


@pytest.fixture(scope="module", autouse=True)
def made_before() -> None:
    """The head is made before the first test, not in it."""
    assert len(own().deltas) == len(SHAPES)


def finer(points: FloatArray, triangles: IntArray) -> tuple[FloatArray, IntArray]:
    """The same surface with a point more on each edge."""
    pairs, _ = edges(np.full(len(triangles), 3), triangles.ravel())
    number = {tuple(pair): len(points) + i for i, pair in enumerate(pairs.tolist())}
    made = []
    for a, b, c in triangles.tolist():
        ab, bc, ca = (number[min(pair), max(pair)] for pair in ((a, b), (b, c), (c, a)))
        made += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([points, points[pairs].mean(axis=1)]), np.array(made)


def test_on_its_own_mesh_shapes_are_the_templates() -> None:
    found = own()
    assert found.reached.all()
    for name, delta in shapes().items():
        np.testing.assert_allclose(found.deltas[name], delta[template().rows], rtol=0, atol=1e-6)


def test_points_between_the_templates_move_as_its_triangles_do() -> None:
    points, triangles = skin()
    pairs, _ = edges(np.full(len(triangles), 3), triangles.ravel())
    found = on(*finer(points, triangles))
    for name, delta in shapes().items():
        at_rows = delta[template().rows]
        off = np.linalg.norm(found.deltas[name] - np.concatenate([at_rows, at_rows[pairs].mean(axis=1)]), axis=1)
        assert np.percentile(off, 99.5) < 1e-6
        assert off.max() < 1.0  # in the folds of a head of so few triangles


def test_turn_size_and_place_of_a_head_turn_and_scale_its_shapes() -> None:
    turn = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
    pose = Similarity(rotation=turn * np.sign(np.linalg.det(turn)), translation=np.array([9e4, -3e3, 7e4]), scale=25.4)
    points, triangles = skin()
    found = on(pose.undo(points), triangles, pose)
    for name, delta in own().deltas.items():
        np.testing.assert_allclose(found.deltas[name], delta @ pose.rotation / pose.scale, rtol=0, atol=1e-6 / 25.4)


def test_no_motion_crosses_the_mouth_where_the_template_lies_2_mm_off() -> None:
    points, triangles = skin()
    still, off = own(), on(points, triangles, fitted=template().points - [0.0, 2.0, 0.0])
    assert np.count_nonzero(off.sides * still.sides < 0) <= 0.02 * np.count_nonzero(still.sides)
    opened = np.linalg.norm(still.deltas["jawOpen"], axis=1)
    most = opened[still.sides == 1].max()
    assert opened[still.sides == -1].max() > 2.0 * most
    found = np.linalg.norm(off.deltas["jawOpen"], axis=1)
    assert found[off.sides == 1].max() < 1.1 * most  # not the lower lip's, though that is nearer


def test_seams_cut_nothing() -> None:
    points, triangles = skin()
    apart = np.where(points[triangles].mean(axis=1)[:, 0] > 0, len(points), 0)  # a seam down the middle of the face
    found, expected = on(np.concatenate([points, points]), triangles + apart[:, None]), own()
    used = np.unique(triangles + apart[:, None])
    for name, delta in expected.deltas.items():
        np.testing.assert_allclose(found.deltas[name][used], np.concatenate([delta, delta])[used], rtol=0, atol=1e-6)


def test_what_the_template_does_not_reach_goes_with_what_is_around_and_farther_off_less() -> None:
    points, triangles = skin()
    chin = template().landmarks[8]
    count, start = 30, len(points)
    strip = points[chin] + np.arange(1, 2 * count + 1)[:, None] // 2 * [0.0, -8.0, 0.0]
    strip[::2, 0] += 4.0
    at = np.concatenate([[chin], start + np.arange(2 * count)])
    hanging = np.stack([at[:-2], at[1:-1], at[2:]], axis=1)
    far = on(np.concatenate([points, strip]), np.concatenate([triangles, hanging]))
    moved = np.linalg.norm(far.deltas["jawOpen"][at], axis=1)
    assert not far.reached[start + 4 :].any()
    assert (np.diff(moved[4:-4]) < 1e-9).all()
    assert moved[8] > 0.3 * moved[0]
    assert moved[-1] < 0.05 * moved[0]


def test_loose_pieces_off_the_template_stand_still() -> None:
    points, triangles = skin()
    ball = points[template().landmarks[30]] + [0.0, 0.0, 60.0] + np.eye(3)
    loose = np.arange(len(points), len(points) + 3)[None]
    found = on(np.concatenate([points, ball]), np.concatenate([triangles, loose]))
    assert not found.reached[-3:].any()
    for delta in found.deltas.values():
        assert not delta[-3:].any()


def test_points_without_a_triangle_stand_still() -> None:
    points, triangles = skin()
    found = on(np.concatenate([points, points[:1] + 500.0]), triangles)
    assert not any(delta[-1].any() for delta in found.deltas.values())


def test_a_body_of_many_points_below_the_head_changes_nothing_and_is_not_searched() -> None:
    points, triangles = skin()
    count = 100  # a side: as long as a body, and each of its points as far from all of the head
    x, y = np.meshgrid(np.linspace(-400.0, 400.0, count), np.linspace(-1800.0, -1000.0, count))
    sheet = np.stack([x, y, np.zeros_like(x)], axis=2).reshape(-1, 3)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel() + len(points)
    cells = np.stack([corner, corner + 1, corner + count], axis=1)
    found = on(np.concatenate([points, sheet]), np.concatenate([triangles, cells]))
    for name, delta in own().deltas.items():
        np.testing.assert_allclose(found.deltas[name][: len(points)], delta, rtol=0, atol=1e-9)
        assert not found.deltas[name][len(points) :].any()


def test_sides_do_not_depend_on_the_order_of_points() -> None:
    points, triangles = skin()
    order = np.random.default_rng(5).permutation(len(points))
    place = np.argsort(order)
    found = on(points[order], place[triangles])
    np.testing.assert_array_equal(found.sides, own().sides[order])
