"""The benchmark of the geometry of photo fits: whom it draws, and how it counts."""

from __future__ import annotations

import numpy as np
import pytest
from benchmark_modules import BENCHMARKS
from narrow_face import NARROW, Apart, apart, narrow_triangles

from facepipe.heads.assembly import modes

assert BENCHMARKS.is_dir()


@pytest.mark.needs_torch
def test_people_are_off_the_nearest_of_the_modes_by_what_no_modes_hold() -> None:
    from geometry_people import RESIDUAL_MM, person

    who, again = person(3, 0), person(3, 0)
    off = who.narrow - who.nearest
    assert np.sqrt((off**2).sum(axis=1).mean()) == pytest.approx(RESIDUAL_MM, rel=0.01), "lids make way for eyeballs"
    span = modes()[:, :NARROW].reshape(len(modes()), -1)
    span /= np.linalg.norm(span, axis=1, keepdims=True)
    assert np.abs(span @ off.ravel()).max() < 0.02 * np.linalg.norm(off)
    assert np.array_equal(who.narrow, again.narrow)
    assert apart(who.nearest, who.narrow, narrow_triangles()).points < RESIDUAL_MM


@pytest.mark.needs_torch
def test_people_who_are_not_fitted_are_counted() -> None:
    from photo_geometry import MEAN, ONE, THREE, Measured, report, summarised

    far = {ONE: Apart(0.5, 1.0), THREE: Apart(0.75, 1.0), MEAN: Apart(1.0, 2.0)}
    fitted = Measured(number=0, look="", photos=[], errors=far, seconds={ONE: 2.0})
    missed = Measured(number=1, look="", photos=[], errors={MEAN: Apart(2.0, 4.0)}, failed={ONE: "no face found"})
    rows = summarised([fitted, missed])
    assert (rows[ONE]["people"], rows[ONE]["mean"], rows[ONE]["share_worst"]) == (1, 0.5, 0.5)
    assert (rows[MEAN]["people"], rows[MEAN]["mean"], rows[MEAN]["points_p95"]) == (2, 1.5, pytest.approx(3.9))
    lines = report([fitted, missed], rows)
    assert "one photo, mm mean: 0.500, aim 0.9" in lines
    assert "three photos, worst share of the mean head's error: 0.750, aim 0.6: missed" in lines
    assert "one photo, not fitted: 1 of 2 people" in lines
    assert "- person 1, one photo: no face found" in lines
