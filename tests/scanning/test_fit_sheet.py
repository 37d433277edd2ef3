"""Sheets of scan, face and distance: surfaces and clouds in the same place, on one scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scan_domes

from facepipe.geometry.polygons import point_normals
from facepipe.geometry.similarity import Similarity
from facepipe.parts import Material
from facepipe.scanning.rebuild_pictures import FitPicture, fit_sheet
from facepipe.scans import no_triangles
from facepipe.verbs.whole_faces import whole_parts, whole_points

HOME = Similarity(rotation=np.eye(3), translation=np.zeros(3))
SIZE = 64


def shown(side: int = 31) -> FitPicture:
    """A person beside its own scan."""
    parts, (scan, landmarks) = scan_domes.face(9), scan_domes.scan(9, side, HOME)
    points = whole_points(parts)
    scan = replace(scan, normals=point_normals(scan.points, scan.triangles))
    return FitPicture(
        parts=whole_parts(parts, points),
        landmarks=landmarks.points,
        scan=scan,
        distances=np.abs(points[:, 0]) / 60.0,
        size=SIZE,
    )


def cells(fit: FitPicture) -> list[np.ndarray]:
    """Pixels of the first row's pictures."""
    pixels = np.asarray(fit_sheet(fit)).astype(float)
    gap = max(2, SIZE // 40)
    return [pixels[gap : gap + SIZE, gap + i * (SIZE + gap) : gap + i * (SIZE + gap) + SIZE] for i in range(3)]


def test_a_face_that_lies_on_its_scan_looks_like_it() -> None:
    """But for the eyeball, which the scan lacks."""
    scan, face, _ = cells(shown())
    assert np.median(np.abs(scan - face)) < 3.0


def test_a_cloud_looks_like_the_surface() -> None:
    surface = shown(61)
    cloud = replace(surface, scan=replace(surface.scan, triangles=no_triangles()))
    assert np.median(np.abs(cells(surface)[0] - cells(cloud)[0])) < 12.0


def test_the_scale_is_round_and_can_be_given() -> None:
    """Distances up to 1 mm: the same picture as one with a scale of 1 mm, and another than one of 2 mm."""
    fit = shown()
    own, same, other = (cells(replace(fit, largest_mm=largest))[2] for largest in (None, 1.0, 2.0))
    assert np.array_equal(own, same)
    assert np.abs(own - other).max() > 30.0


def test_what_the_scan_does_not_show_is_grey() -> None:
    fit = shown()
    pixels = cells(replace(fit, distances=np.full(len(fit.distances), np.nan)))[2]
    assert np.ptp(pixels, axis=2).max() < 30.0


def test_clear_parts_are_left_out() -> None:
    """The eyeball as glass: the same as without it."""
    fit = shown()
    head, eye = fit.parts.meshes
    glass = replace(
        fit.parts, meshes=(head, replace(eye, material="Glass")), materials=(Material(name="Glass", opacity=0.2),)
    )
    count = len(head.points)
    bare = replace(fit, parts=replace(fit.parts, meshes=(head,)), distances=fit.distances[:count])
    for one, other in zip(cells(replace(fit, parts=glass)), cells(bare), strict=True):
        assert np.array_equal(one, other)
    assert not np.array_equal(cells(fit)[1], cells(bare)[1])


def test_a_neutral_that_differs_is_drawn_last() -> None:
    fit = shown()
    narrow, wide = (np.asarray(fit_sheet(one)) for one in (fit, replace(fit, neutral=fit.parts)))
    gap = max(2, SIZE // 40)
    assert wide.shape[1] == narrow.shape[1] + SIZE + gap
    assert np.array_equal(wide[gap : gap + SIZE, -gap - SIZE : -gap], cells(fit)[1])
