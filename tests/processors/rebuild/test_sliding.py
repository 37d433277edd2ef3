"""Points of a fitted face slide along a scan, and reports say how far."""

from __future__ import annotations

import json

import numpy as np
import pytest
import scan_domes
from command_line import done
from neutral_files import PERSON, Files

from facepipe.scans import ScanLandmarks

BROWS = slice(17, 27)  # landmarks


def test_the_report_says_how_far_points_lie_from_landmarks_along_the_surface(
    fit_files: Files, capsys: pytest.CaptureFixture[str]
) -> None:
    scan, landmarks = scan_domes.scan(PERSON)
    points, sigmas = landmarks.points.copy(), np.full(68, np.nan)
    points[BROWS] += scan_domes.POSE.apply(np.array([[2.0, 0.0, 0.0]])) - scan_domes.POSE.apply(np.zeros((1, 3)))
    sigmas[BROWS] = 100.0  # mm
    fit_files.put(scan, ScanLandmarks(points=points, sigma_mm=sigmas))
    found = json.loads(done(capsys, *fit_files.words("--unit", "cm", "--json"), quiet=False))["fit"]["slid_mm"]
    assert 1.0 < found["brows"] < 2.1
    assert max(found["lids"], found["lips"]) < 0.1
    fit_files.put(scan, ScanLandmarks(points=np.where(np.arange(68)[:, None] < 48, np.nan, points)))
    printed = done(capsys, *fit_files.words("--unit", "cm", "--force"), quiet=False)
    assert "slid along the surface" in printed
    assert "brows" not in printed
