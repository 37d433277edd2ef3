"""Factors leave nothing behind."""

from __future__ import annotations

import numpy as np
import psutil
from scipy.sparse import diags_array
from solvers import SOLVERS

from facepipe.geometry.factor import Solver, factorise


@SOLVERS
def test_right_hand_sides_are_not_kept(solver: Solver) -> None:
    # cholespy keeps a copy of them for ever, 10 MB of each factor here
    matrix, right = diags_array([-1.0, 2.5, -1.0], offsets=[-1, 0, 1], shape=(20_000, 20_000)), np.ones((20_000, 64))
    sizes = []
    for _ in range(8):
        solved = factorise(matrix, solver).solve(right)
        sizes.append(psutil.Process().memory_info().rss)
    np.testing.assert_allclose(matrix @ solved, right, atol=1e-9)
    assert sizes[-1] - sizes[1] < 30e6
