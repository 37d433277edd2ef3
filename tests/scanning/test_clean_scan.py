"""Scans made ready for registration: what is there of each point follows it, and normals face outward."""

from __future__ import annotations

import json

import numpy as np
import pytest
from import_data import shared
from solids import ball

from facepipe.core.errors import InputError
from facepipe.importers.scan_file import read_scan
from facepipe.scanning.clean_scan import CleanScan
from facepipe.scans import Scan


def test_colours_follow_their_points() -> None:
    """Colours are a function of place here, before and after."""
    points, triangles = ball(14)
    junk, its_triangles = ball(3, 0.02)
    scan = Scan(
        name="ball",
        points=np.concatenate([junk + 3, points]),
        triangles=np.concatenate([its_triangles, triangles[::-1, ::-1] + len(junk)]),
        colors=np.abs(np.concatenate([junk + 3, points])) / 4,
    )
    cleaned = CleanScan()(scan)
    assert cleaned.scan.colors is not None
    assert cleaned.scan.normals is not None
    assert np.abs(np.abs(cleaned.scan.points) / 4 - cleaned.scan.colors).max() == 0
    assert (np.einsum("ni,ni->n", cleaned.scan.normals, cleaned.scan.points) > 0.98).all()
    assert any("1 small pieces" in line for line in cleaned.report.warnings)
    assert json.loads(cleaned.report.to_json())["surface"]["small_triangles"] == len(its_triangles)


@pytest.mark.parametrize("sign", [1.0, -1.0, None])
def test_clouds_get_outward_normals_and_lose_lone_points(sign: float | None) -> None:
    points, _ = ball(14)
    places = np.concatenate([points, points[:5], [[9.0, 9.0, 9.0]]])
    normals = None if sign is None else sign * places / np.linalg.norm(places, axis=1, keepdims=True)
    cleaned = CleanScan()(Scan(name="cloud", points=places, normals=normals))
    assert cleaned.scan.is_cloud
    assert cleaned.scan.normals is not None
    assert (cleaned.scan.points == points).all()
    assert (np.einsum("ni,ni->n", cleaned.scan.normals, points) > 0.98).all()
    assert cleaned.report.turned_normals == (sign == -1.0)
    assert (cleaned.report.lone_points, cleaned.report.surface.merged_points) == (1, 5)
    assert not cleaned.border.any()


def test_the_real_scan_needs_no_mending() -> None:
    scan = read_scan(shared("scans/LeePerrySmith.glb"))
    cleaned = CleanScan()(scan)
    assert (cleaned.scan.points == scan.points).all()
    assert (np.sort(cleaned.scan.triangles, axis=1) == np.sort(scan.triangles, axis=1)).all()
    assert cleaned.report.warnings == ()


def test_what_holds_no_surface_is_named() -> None:
    with pytest.raises(InputError, match="dot -> surface"):
        CleanScan()(Scan(name="dot", points=np.zeros((3, 3)), triangles=np.array([[0, 1, 2]])))
    with pytest.raises(InputError, match="dot -> cloud"):
        CleanScan()(Scan(name="dot", points=np.zeros((3, 3))))
    with pytest.raises(InputError, match="smallest"):
        CleanScan(smallest=2.0)(Scan(name="dot", points=np.zeros((3, 3))))
