"""Points of a fitted face slide along a scan less where its landmarks are seen from near, and reports say how far."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import scan_domes
from coloured_scans import coloured_scan
from command_line import done
from neutral_files import PERSON, Files
from scipy.spatial import cKDTree

from facepipe.core.arrays import FloatArray
from facepipe.geometry.polygons import point_normals
from facepipe.heads.assembly import average
from facepipe.heads.asset import asset
from facepipe.pictures.surface_view import draw_surface
from facepipe.scanning.landmarks import FindScanLandmarks, find
from facepipe.scanning.rebuild.built_in_head import people
from facepipe.scanning.rebuild.fit_neutral import fit_neutral
from facepipe.scanning.rebuild.template import Template
from facepipe.scans import ScanLandmarks

FAR_MM = 2.2  # RMS along each coordinate of landmarks that are seen from far alone
BROWS, LIPS = (slice(17, 27), 10.0), (slice(48, 68), 5.0)  # landmarks, and mm around them


def slid(template: Template, points: FloatArray, truth: FloatArray, part: tuple[slice, float]) -> float:
    """Mean distance in mm, along the surface, of points (n, 3) from where they truly are."""
    rows = template.rows[template.seen]
    normals = point_normals(truth[template.rows], template.triangles)[template.seen]
    near = cKDTree(truth[asset().landmarks[part[0]]]).query(truth[rows])[0] < part[1]
    off = (points - truth)[rows]
    along = off - np.einsum("ni,ni->n", off, normals)[:, None] * normals
    return float(np.linalg.norm(along[near], axis=1).mean())


def test_the_report_says_how_far_points_lie_from_landmarks_along_the_surface(
    fit_files: Files, capsys: pytest.CaptureFixture[str]
) -> None:
    scan, landmarks = scan_domes.scan(PERSON)
    points, sigmas = landmarks.points.copy(), np.full(68, np.nan)
    points[BROWS[0]] += scan_domes.POSE.apply(np.array([[2.0, 0.0, 0.0]])) - scan_domes.POSE.apply(np.zeros((1, 3)))
    sigmas[BROWS[0]] = 100.0  # mm
    fit_files.put(scan, ScanLandmarks(points=points, sigma_mm=sigmas))
    found = json.loads(done(capsys, *fit_files.words("--unit", "cm", "--json"), quiet=False))["fit"]["slid_mm"]
    assert 1.0 < found["brows"] < 2.1
    assert max(found["lids"], found["lips"]) < 0.1
    fit_files.put(scan, ScanLandmarks(points=np.where(np.arange(68)[:, None] < 48, np.nan, points)))
    printed = done(capsys, *fit_files.words("--unit", "cm", "--force"), quiet=False)
    assert "slid along the surface" in printed
    assert "brows" not in printed


@pytest.mark.slow
def test_a_closer_look_at_a_coloured_scan_keeps_brows_and_lips_in_place(monkeypatch: pytest.MonkeyPatch) -> None:
    scan, truth = coloured_scan(2)
    body = average()
    template = Template.of(body, "head")
    finder, found = FindScanLandmarks(draw=draw_surface), []
    near = finder(scan).landmarks
    monkeypatch.setattr(find, "look_closer", lambda look, frame, seen, angles, draw: seen)
    far = replace(finder(scan).landmarks, sigma_mm=np.full(68, FAR_MM))
    for landmarks in (near, far):
        fit, place, _ = fit_neutral(template, scan, landmarks, people(body))
        found.append([slid(template, place.undo(fit.points), truth, part) for part in (BROWS, LIPS)])
    (brows, lips), (brows_before, lips_before) = found
    print(f"brows {brows_before:.2f} to {brows:.2f} mm, lips {lips_before:.2f} to {lips:.2f} mm")
    assert brows < 0.9 * brows_before
    assert lips < 1.1 * lips_before
