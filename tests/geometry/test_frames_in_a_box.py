"""Limits of unknowns and what draws to 0: which ways are open, and how steep they are."""

from __future__ import annotations

import numpy as np

from facepipe.geometry.bounded_least_squares import Box


def test_ways_end_at_0_and_at_the_limits_and_a_small_slope_does_not_leave_0() -> None:
    x = np.array([0.0, 0.0, 0.0, 0.4, -0.4, 1.0, -2.0])
    slope = np.array([-3.0, 0.5, 3.0, 0.5, 0.5, -3.0, 3.0])
    with np.errstate(all="raise"):
        low, high, on_the_way = Box(lower=np.full(7, -2.0), upper=np.full(7, 1.0), l1=1.0).signed(x, slope)
    np.testing.assert_array_equal(low, [0, 0, -2, 0, -2, 0, -2])
    np.testing.assert_array_equal(high, [1, 0, 0, 1, 0, 1, 0])
    np.testing.assert_array_equal(on_the_way, [-2, 0, 2, 1.5, -0.5, 0, 0])
