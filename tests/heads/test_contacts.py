"""The measure of what comes through skin: known depths, and the figures of ICT-FaceKit as it is."""

from __future__ import annotations

import numpy as np
import pytest
from contacts import Subject, blink, eye_sheets, mouth_sheet
from import_data import shared
from solids import ball

from facepipe.geometry.contacts import STEP, Sheet
from facepipe.importers import ict, load

RADIUS = 10.0


def plate(size: float, z: float) -> np.ndarray:
    return np.array([[-size, -size, z], [size, -size, z], [size, size, z], [-size, size, z]])


def sheet(front: float) -> tuple[Sheet, np.ndarray]:
    """A ball behind a plate that faces the viewer, and the points with the plate's front at z."""
    points, triangles = ball(48, RADIUS)
    skin = np.array([[0, 1, 2], [0, 2, 3]]) + len(points)
    closed = np.concatenate([points, plate(60.0, 12.0)])
    return Sheet.of(skin, triangles, [closed]), np.concatenate([points, plate(60.0, front)])


def test_a_ball_behind_skin_has_no_contact() -> None:
    measured, points = sheet(10.5)
    assert measured.before_skin(points).cells == measured.through(points).cells == 0
    np.testing.assert_array_equal(measured.shown(points), 0)


@pytest.mark.parametrize("depth", [1.0, 3.0])
def test_a_ball_through_skin_has_the_depth_and_the_area_of_its_cap(depth: float) -> None:
    measured, points = sheet(RADIUS - depth)
    cap = np.pi * (RADIUS**2 - (RADIUS - depth) ** 2) / STEP**2
    assert measured.shown(points)[0] == pytest.approx(cap, rel=0.05)
    for found in (measured.before_skin(points), measured.through(points)):
        assert found.cells > cap  # five views see more than the one from before
        assert depth * 0.98 < found.depth < depth * 2  # along a slanting ray it is deeper


def test_a_ball_beside_skin_shows_and_has_no_contact() -> None:
    measured, points = sheet(9.0)
    points[-4:, 0] -= 75.0
    assert measured.before_skin(points).cells == measured.through(points).cells == 0
    assert measured.shown(points)[0] == pytest.approx(np.pi * RADIUS**2 / STEP**2, rel=0.05)


@pytest.mark.slow
def test_raw_shapes_of_ict_show_teeth_through_the_rolled_lip_alone() -> None:
    raw = Subject(load("ict", shared("ict_facekit/ict_facekit.npz"), ict.Options()).parts)
    mouth = mouth_sheet(raw)
    found = {name for name in raw.shapes if mouth.before_skin(raw.points({name: 1.0})).cells}
    assert found == {"mouthRollUpper"}
    assert mouth.before_skin(raw.points({"jawOpen": 1.0, "mouthSmileLeft": 1.0, "mouthSmileRight": 1.0})).cells == 0
    assert 0.01 < blink(raw, eye_sheets(raw)).shown < 0.5
