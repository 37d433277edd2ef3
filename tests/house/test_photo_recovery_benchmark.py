"""The benchmark of photo fits of known people: what it says of its aims."""

from __future__ import annotations

import benchmark_modules  # noqa: F401  (finds the modules of benchmarks/)
from photo_recovery import judged


def test_aims_that_are_missed_are_said_to_be() -> None:
    good = {"landmark_px": 1.2, "slider": 0.05, "geometry_mm": 0.7, "active": 20.0}
    plain = {**good, "landmark_px": 1.19, "active": 40.0}
    summary = {"neutral": good, "neutral, no sparsity": plain, "expression": {**good, "slider": 0.07}}
    missed = [line for line in judged(summary) if line.endswith("missed")]
    assert missed == ["slider error with expressions / neutral: 1.400, aim 1.3: missed"]
    assert len(judged(summary)) == 9
    worse = {**summary, "neutral": {**good, "landmark_px": 1.6, "active": 30.0}}
    assert sum(line.endswith("missed") for line in judged(worse)) == 4
