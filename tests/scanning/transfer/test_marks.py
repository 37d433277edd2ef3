"""What a template that lies on a head says of its points: masks, and landmarks with points of their own."""

import numpy as np

from facepipe.scanning.transfer.marks import own_points
from facepipe.scanning.transfer.transfer import carried_masks

_SQUARE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def test_masks_are_those_of_the_surface_below_and_sum_to_one() -> None:
    left = np.array([1.0, 0.0, 0.0, 1.0])
    places = np.array([[0.0, 1.0, 0.3], [0.5, 1.2, -0.1], [2.0, 0.1, 0.0], [-5.0, 1.0, 0.0]])
    masks = carried_masks({"left": left, "right": 1.0 - left}, _SQUARE, _TRIANGLES, places)
    np.testing.assert_allclose(masks["left"], [1.0, 0.75, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(masks["left"] + masks["right"], 1.0, atol=1e-12)


def test_two_landmarks_near_one_point_get_one_each() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    marks = np.array([[0.1, 0, 0], [0.2, 0, 0], [2.9, 0, 0]])
    # nearest of both is point 0; the one that is nearer to point 1 gives way
    np.testing.assert_array_equal(own_points(marks, points), [0, 1, 2])


def test_more_landmarks_than_points_leave_some_without() -> None:
    assert sorted(own_points(np.zeros((3, 3)), np.array([[0.0, 0, 0], [1, 0, 0]]))) == [-1, 0, 1]
