"""Refined neutrals against the truth: simulated scans of people that the database can't show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from ict_people import ict_database, ict_template, read
from scan_actors import Actor, ict
from scan_simulator import simulate

from facepipe.scanning.rebuild import FitNeutralOptions, NeutralScan
from facepipe.scanning.rebuild.fit_neutral import fit_neutral
from facepipe.scanning.rebuild.refine_neutral import RefineNeutralReport, refine_neutral

_STIFF = FitNeutralOptions(membrane=3000.0)
_PERSON = 101


@dataclass
class _Refined:
    """A neutral as fitted and as refined, and how far its points are from where they truly are, in millimetres."""

    fit: NeutralScan
    points: np.ndarray  # (n, 3) refined
    report: RefineNeutralReport
    before: np.ndarray  # (n,)
    after: np.ndarray  # (n,)


def _refined(options: FitNeutralOptions, weights: np.ndarray | None = None) -> _Refined:
    template, person = ict_template(), Actor(_PERSON)
    simulated = simulate(person.neutral, _PERSON)
    scan, landmarks = read("neutral", simulated)
    fit, home, _ = fit_neutral(template, scan, landmarks, ict_database(template), options)
    found, place, report = refine_neutral(template, fit.points, scan, landmarks, weights=weights)
    count = len(person.neutral)
    errors = [
        np.linalg.norm(simulated.pose.undo(place.undo(points))[:count] - person.neutral, axis=1)
        for points, place in ((fit.points, home), (found, place))
    ]
    return _Refined(fit, found, report, *errors)


def _nose() -> np.ndarray:
    """(n,) 1 within 28 mm of the middle of the nose's landmarks, 0 beyond 38; loose parts stay."""
    points = ict().neutral
    away = np.linalg.norm(points - points[ict().landmarks[27:36]].mean(axis=0), axis=1)
    weights = np.clip((38.0 - away) / 10.0, 0.0, 1.0)
    weights[ict_template().loose] = 0.0
    return np.asarray(weights)


@pytest.mark.slow
def test_a_region_that_was_fitted_too_stiffly_comes_to_its_scan_and_nearer_to_the_truth() -> None:
    weights = _nose()
    case = _refined(_STIFF, weights)
    report, inside = case.report, weights > 0.9
    print(f"surface {report.before_mean_mm:.3f} -> {report.surface_mean_mm:.3f}, moved {report.moved_mean_mm:.2f}")
    print(f"true {case.before[inside].mean():.3f} -> {case.after[inside].mean():.3f}")
    assert report.surface_mean_mm < 0.35 * report.before_mean_mm
    assert case.after[inside].mean() < 0.7 * case.before[inside].mean()
    assert np.array_equal(case.points[weights == 0.0], case.fit.points[weights == 0.0])
    assert report.flipped_triangles <= 5


@pytest.mark.slow
def test_a_face_that_was_fitted_well_stays_as_true() -> None:
    case = _refined(FitNeutralOptions())
    face = slice(0, ict().full_face)
    report = case.report
    print(f"surface {report.before_mean_mm:.4f} -> {report.surface_mean_mm:.4f}, moved {report.moved_mean_mm:.3f}")
    for name, of in (("mean", np.mean), ("p95", lambda off: np.percentile(off, 95))):
        print(f"true {name} {of(case.before[face]):.3f} -> {of(case.after[face]):.3f}")
        assert of(case.after[face]) < 1.01 * of(case.before[face])
    assert report.surface_mean_mm < report.before_mean_mm
    assert report.flipped_triangles <= 5
