"""Eyes of drawn people: round balls of one size, under lids that slide over them and meet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from contacts import BLINKS, PARTLY, blink, eye_sheets, person
from scipy.spatial import cKDTree

from facepipe.geometry.balls import RadialSurface, fit_ball
from facepipe.geometry.contacts import Sheet
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.heads import make
from facepipe.heads.assembly import make_head, with_parts_fitted
from facepipe.heads.asset import arrays, asset
from facepipe.heads.part_fits import fit_eyes
from facepipe.heads.people import draw
from facepipe.heads.surfaces import card_mesh, cards
from facepipe.parts import Mesh
from facepipe.stage import Face

MM = 10.0  # of a centimetre
FLIP = np.array([-1.0, 1.0, 1.0])
AROUND = 80.0  # mm from an eyeball; no skin that is farther can hide it


@pytest.fixture(scope="module")
def sheets() -> tuple[Sheet, ...]:
    """Of the average head, with the skin around each eye alone."""
    average = person(0)
    found = []
    for sheet in eye_sheets(average):
        middle = average.neutral[sheet.hard].mean(axis=(0, 1))
        away = np.linalg.norm(average.neutral[sheet.skin].mean(axis=1) - middle, axis=1)
        found.append(replace(sheet, skin=sheet.skin[away < AROUND]))
    return tuple(found)


@pytest.fixture(scope="module")
def face() -> Face:
    """A person with sliders."""
    return Face.from_parts(make(3))


def drawn(seed: int) -> np.ndarray:
    weights = np.clip(np.random.Generator(np.random.PCG64(seed)).standard_normal(100), -2.5, 2.5)
    return asset().points + np.tensordot(weights.astype(np.float32), asset().modes, axes=1)


@pytest.mark.parametrize("seed", [3, pytest.param(6, marks=pytest.mark.slow), pytest.param(14, marks=pytest.mark.slow)])
def test_a_blink_hides_the_eyeballs_which_never_come_through_lids(seed: int, sheets: tuple[Sheet, ...]) -> None:
    found = blink(person(seed), sheets)
    assert found.shown <= 0.01
    assert found.through.cells == 0


@pytest.mark.parametrize("slider", ["eyeOpening", "eyeSize", "childlike"])
def test_a_blink_hides_eyes_that_a_slider_opens(slider: str, face: Face, sheets: tuple[Sheet, ...]) -> None:
    opened, closed = (
        MM * face.evaluate(weights, sliders={slider: 1.0}) for weights in ({}, dict.fromkeys(BLINKS, 1.0))
    )
    assert (opened - closed)[arrays("lids")["lids"], 1].max() > 8.0
    for sheet in sheets:
        assert (sheet.shown(closed) <= 0.01 * sheet.shown(opened)).all()
        for weight in PARTLY:
            partly = MM * face.evaluate(dict.fromkeys(BLINKS, weight), sliders={slider: 1.0})
            assert sheet.through(partly).cells == 0


@pytest.mark.parametrize("seed", [1, 2])
def test_eyeballs_are_the_average_ones_moved_and_scaled_alike(seed: int) -> None:
    points, _ = fit_eyes(drawn(seed), asset().shapes)
    balls = [asset().parts[f"Eyeball{side}"].points for side in ("Left", "Right")]
    spans = [np.ptp(points[ball], axis=0) / np.ptp(asset().points[ball], axis=0) for ball in balls]
    np.testing.assert_allclose(spans, spans[0][0], rtol=1e-6)
    assert 0.8 < spans[0][0] < 1.25


@pytest.mark.parametrize("feminine", [0.0, 1.0])
def test_no_lid_lies_in_its_eyeball_at_rest(feminine: float) -> None:
    """Skin from the lids' margins on, of drawn people; what lies behind the margins nobody sees."""
    lids, rings = arrays("lids")["lids"], arrays("lids")["lid_rings"]
    for seed in range(1, 21):
        head = asset()
        weights = draw(seed, years=75.0, feminine=feminine).identity.astype(np.float32)
        points = with_parts_fitted(head.points + np.tensordot(weights, head.modes, axes=1))
        for own, side in zip(lids, ("Left", "Right"), strict=True):
            ball = points[head.parts[f"Eyeball{side}"].points]
            depths = RadialSurface(ball, fit_ball(ball).centre).depths(points[own[rings > 0]])
            assert MM * depths.max() < 0.05, seed


def test_nothing_but_eyes_changes() -> None:
    before = drawn(4)
    points, shapes = fit_eyes(before, asset().shapes)
    eyes = [np.arange(part.points.start, part.points.stop) for name, part in asset().parts.items() if "Eyeball" in name]
    kept = np.setdiff1d(np.arange(len(points)), np.concatenate([arrays("lids")["lids"].ravel(), *eyes]))
    np.testing.assert_array_equal(points[kept], before[kept])
    for name, ways in asset().shapes.items():
        assert set(shapes[name]) == set(ways)
        for weight, offsets in ways.items():
            np.testing.assert_array_equal(shapes[name][weight][kept], offsets[kept])


def test_both_eyes_of_the_average_head_blink_alike() -> None:
    points, shapes = fit_eyes(asset().points, asset().shapes)
    left, right = arrays("lids")["lids"]
    for weight in (0.25, 0.5, 0.75, 1.0):
        ends = [(points + shapes[f"eyeBlink{side}"][weight])[own] for side, own in (("Left", left), ("Right", right))]
        assert np.linalg.norm(ends[0] * FLIP - ends[1], axis=1).max() < 0.05


def test_lashes_stay_out_of_the_skin_in_a_blink() -> None:
    held = cards("lashes")
    for seed in (0, 3):
        head = make_head(draw(seed).identity).meshes[0]
        lashes = card_mesh("Lashes", held, head, "eyes")
        closed = [moved(one, ("eyeBlinkLeft", "eyeBlinkRight")) for one in (lashes, head)]
        near = cKDTree(closed[1]).query(closed[0])[1]
        normals = point_normals(closed[1], point_triangles(head.face_vertex_counts, head.face_vertex_indices))[near]
        height = np.einsum("nc,nc->n", closed[0] - closed[1][near], normals)
        assert height.reshape(held.grids[0])[:, 1:].min() > 0.0


def moved(one: Mesh, names: tuple[str, ...]) -> np.ndarray:
    points = one.points.copy()
    for shape in one.blendshapes:
        if shape.name in names:
            points[shape.point_indices] += shape.offsets
    return points
