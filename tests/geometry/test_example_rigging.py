"""Shapes split from composites: what must come back exactly, invariances, and dense oracles."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from solids import sheet_and_tetrahedron

from facepipe.core.errors import InputError
from facepipe.geometry.example_rigging import Split, SplitOptions, split_shapes
from facepipe.geometry.example_rigging.field_solve import FieldSystem, examples_of, solve_fields
from facepipe.geometry.example_rigging.split import dealt_out

SIZE = 13
SHEET = SIZE * SIZE  # points 0..168: a sheet of 120 mm; then a loose tetrahedron, and a point in no triangle
COUNT = SHEET + 5
SHAPES = 6
# left and right bumps, a wide one, two that overlap, one that no composite holds
WEIGHTS = np.array([[1.0, 1.0, 0, 0, 0, 0], [0, 0, 1.0, 0, 0, 0], [0.5, 0, 0.7, 0, 0, 0], [0, 0, 0, 0.8, 0.6, 0]])


def triangles() -> np.ndarray:
    return sheet_and_tetrahedron(SIZE)


def neutral() -> np.ndarray:
    rows, columns = np.divmod(np.arange(SHEET), SIZE)
    sheet = np.stack([10.0 * columns, 10.0 * rows, 4.0 * np.sin(0.3 * columns + 0.2 * rows)], axis=1)
    loose = 10.0 * np.eye(5, 3) + [60.0, 30.0, -20.0]
    return np.concatenate([sheet, loose]) + np.random.default_rng(0).normal(size=(COUNT, 3))


def templates() -> np.ndarray:
    points = neutral()
    centres = np.array([[30, 60], [90, 60], [60, 30], [40, 90], [60, 95], [90, 30]])
    widths = np.array([15, 15, 30, 15, 15, 10])
    ways = np.random.default_rng(1).normal(size=(SHAPES, 3))
    reach = ((points[None, :, :2] - centres[:, None]) ** 2).sum(axis=2) / widths[:, None] ** 2
    bumps = np.where(reach < 9.0, 5.0 * np.exp(-0.5 * reach), 0.0)
    return np.asarray(bumps[:, :, None] * ways[:, None])


def personal() -> np.ndarray:
    """Templates with gains and turns of their own, and a little that is neither."""
    points, deltas = neutral(), templates()
    slow = np.stack([np.sin(points[:, 0] / 30 + shape) for shape in range(SHAPES)])
    turned = np.cross(0.1 * np.cos(points / 40), deltas)
    return np.asarray((1.0 + 0.2 * slow[:, :, None]) * deltas + turned)


def shown(deltas: np.ndarray, weights: np.ndarray = WEIGHTS) -> np.ndarray:
    return np.asarray(neutral() + np.tensordot(weights, deltas, axes=1))


def split(deltas: np.ndarray, weights: np.ndarray = WEIGHTS, given: np.ndarray | None = None, **more: Any) -> Split:
    """From exact composites of the deltas.

    :param given: weights in place of the true ones
    """
    stated = weights if given is None else given
    more = whole(len(weights)) | more
    return split_shapes(neutral(), templates(), shown(deltas, weights), stated, triangles(), **more)


def whole(count: int) -> dict[str, Any]:
    """Scans of `count` composites without holes, no stiff piece."""
    names = [f"s{number}" for number in range(SHAPES)]
    return {"point_weights": np.ones((count, COUNT)), "stiff": np.full(COUNT, -1), "names": names}


def error(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(e,) mean distance of points."""
    return np.asarray(np.linalg.norm(found - truth, axis=2).mean(axis=1))


def test_composites_of_the_templates_give_the_templates() -> None:
    found = split(templates())
    np.testing.assert_allclose(found.deltas, templates(), atol=1e-6)
    np.testing.assert_allclose(found.weights, WEIGHTS, atol=1e-6)
    assert found.residual_p95.max() < 1e-6
    np.testing.assert_allclose(found.gains, 1.0, atol=1e-6)
    assert found.changes.max() < 1e-6


def test_a_shape_alone_in_a_composite_is_its_delta() -> None:
    """With a weak prior, whatever it does where its template moves, a fold as well as a gain."""
    truth = templates()
    truth[2] += 0.3 * np.abs(templates()[2]).max(axis=1, keepdims=True) * np.sin(neutral())
    options = SplitOptions(detail=10.0, noise=1e-5, weight_spread=0.0)
    found = split(truth, np.eye(SHAPES)[2:3], options=options)
    np.testing.assert_allclose(found.deltas[2], truth[2], atol=1e-4)
    assert found.observed[2] > 0.999


def test_gains_and_turns_come_back() -> None:
    found, truth = split(personal()), personal()
    excited = WEIGHTS.any(axis=0)
    assert (error(found.deltas, truth) < 0.6 * error(templates(), truth))[excited].all()
    assert error(found.deltas, truth)[excited].sum() < 0.35 * error(templates(), truth)[excited].sum()
    assert found.residual_means.max() < 0.05


def test_what_no_composite_holds_stays_the_template_to_the_bit() -> None:
    found = split(personal())
    assert found.deltas[5].tobytes() == templates()[5].tobytes()
    assert found.observed[5] == 0.0
    assert found.gains[5] == 1.0
    assert any("s5" in warning and "kept" in warning for warning in found.warnings)


def test_a_turned_moved_and_scaled_face_gives_turned_and_scaled_shapes() -> None:
    Q = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    Q *= np.linalg.det(Q)
    scale, lengths = 3.0, ("field_length", "detail_length", "noise", "noise_length")
    plain = SplitOptions()
    scaled = SplitOptions(**{name: scale * getattr(plain, name) for name in lengths})
    found = split(personal())
    points, deltas = scale * neutral() @ Q.T + [5.0, -7.0, 11.0], scale * templates() @ Q.T
    composites = scale * shown(personal()) @ Q.T + [5.0, -7.0, 11.0]
    moved = split_shapes(points, deltas, composites, WEIGHTS, triangles(), scaled, **whole(4))
    np.testing.assert_allclose(moved.deltas, scale * found.deltas @ Q.T, atol=1e-3)
    np.testing.assert_allclose(moved.weights, found.weights, atol=1e-4)


def test_the_same_input_gives_the_same_bytes() -> None:
    assert split(personal()).deltas.tobytes() == split(personal()).deltas.tobytes()


def test_wrong_weights_are_found_where_shapes_come_back() -> None:
    """Up to the scale that a shape and its weights share."""
    wrong = WEIGHTS * np.array([1.15, 0.9, 1.0, 1.0, 1.0, 1.0])
    wrong[2, 0] *= 0.75
    found = split(personal(), given=wrong)
    ratio = found.weights[2, 0] / found.weights[0, 0]
    assert abs(ratio - 0.5) < 0.2 * abs(wrong[2, 0] / wrong[0, 0] - 0.5)
    assert (found.weights[WEIGHTS == 0] == 0).all()
    kept = split(personal(), given=wrong, options=SplitOptions(weight_spread=0.0))
    assert kept.weights.tobytes() == wrong.tobytes()


def test_weights_stay_in_their_bounds() -> None:
    strong = np.where(WEIGHTS > 0, 0.1, 0.0)
    options = SplitOptions(weight_spread=1.0, largest_weight=0.4)
    found = split(templates(), given=strong, options=options)
    assert found.weights.min() >= 0.0
    assert found.weights.max() <= 0.4
    assert any("bounds" in warning for warning in found.warnings)


def test_what_was_not_scanned_shows_nothing() -> None:
    composites, seen = shown(personal()), np.ones((len(WEIGHTS), COUNT))
    seen[:, ::3] = 0.0
    damaged = composites + 50.0 * (seen == 0)[:, :, None]
    one, other = (
        split_shapes(neutral(), templates(), given, WEIGHTS, triangles(), **whole(4) | {"point_weights": seen})
        for given in (composites, damaged)
    )
    np.testing.assert_allclose(one.deltas, other.deltas, atol=1e-9)
    truth = personal()
    assert error(one.deltas, truth)[:5].sum() < 0.5 * error(templates(), truth)[:5].sum()


def test_shapes_that_scans_hardly_show_are_named() -> None:
    """Shape 2 moves no point that was scanned in the composites that hold it."""
    seen = np.ones((len(WEIGHTS), COUNT))
    seen[1:3, templates()[2].any(axis=1)] = 0.0
    assert "the scans hardly show s2" in split(personal(), point_weights=seen).warnings
    assert not any("hardly" in warning for warning in split(personal()).warnings)


def test_a_stiff_piece_has_one_gain_and_turn() -> None:
    stiff = np.full(COUNT, -1)
    stiff[SHEET : SHEET + 4] = 0
    found = split(personal(), stiff=stiff)
    piece = slice(SHEET, SHEET + 4)
    for shape in range(5):
        template = templates()[shape, piece]
        if not template.any():
            continue
        columns = [template, *(np.cross(axis, template) for axis in np.eye(3))]
        A = np.stack([column.ravel() for column in columns], axis=1)
        b = (found.deltas[shape, piece] - template).ravel()
        np.testing.assert_allclose(A @ np.linalg.lstsq(A, b, rcond=None)[0], b, atol=1e-8)


def test_a_loose_piece_moves_with_the_scans() -> None:
    """Gradients alone would leave it behind."""
    truth = templates()
    truth[:, SHEET:] *= 1.5
    found = split(truth, options=SplitOptions(weight_spread=0.0))
    assert error(found.deltas[2:3, SHEET:], truth[2:3, SHEET:]) < 0.1 * error(
        templates()[2:3, SHEET:], truth[2:3, SHEET:]
    )


def test_shapes_that_always_go_together_are_named() -> None:
    found = split(personal())
    assert found.together == ((3, 4),)  # 0 and 1 are never alone either, but move other points
    assert [line for line in found.warnings if "separate" in line and "s3 and s4" in line]
    assert found.rank == 4
    apart = np.concatenate([WEIGHTS, np.eye(SHAPES)[3:4]])
    assert split(personal(), apart).together == ()


def test_shapes_that_are_one_to_all_composites_keep_their_templates() -> None:
    """Two names of one motion, always together; the others are found as before."""
    twins, own = templates(), personal()
    twins[4], own[4] = 0.7 * twins[3], 0.7 * own[3]
    found = split_shapes(neutral(), twins, shown(own), WEIGHTS, triangles(), **whole(4))
    assert found.undecided == (3, 4)
    assert np.array_equal(found.deltas[3:5], twins[3:5])
    assert (found.observed[3:5] == 0.0).all()
    assert (found.gains[3:5] == 1.0).all()
    assert error(found.deltas, own)[:3].sum() < 0.5 * error(twins, own)[:3].sum()
    assert split(personal()).undecided == ()


def test_what_one_composite_shows_of_two_shapes_is_shared() -> None:
    seen = split(personal()).observed
    assert max(seen[3:5]) < 0.95
    assert seen[2] > 0.95
    more = split(personal(), np.concatenate([WEIGHTS, np.eye(SHAPES)[3:4]])).observed
    assert (more[3:5] > seen[3:5]).all()


def test_fields_solve_the_dense_least_squares() -> None:
    """Against all unknowns in one matrix, made of what each of them does to the composites."""
    options = SplitOptions(weight_spread=0.0)
    examples = examples_of(
        neutral(), templates(), shown(personal()), WEIGHTS, triangles(), *list(whole(4).values())[:2]
    )
    system = FieldSystem(examples, options)
    size = int(system.starts[-1])
    columns = []
    for unknown in range(size):
        z = np.zeros(size)
        z[unknown] = 1.0
        moved = np.zeros_like(templates())
        for row, field in zip(system.rows, system.shape_fields(z), strict=True):
            at = system.sample[row.points]
            moved[row.shape, at] = field[:, :1] * templates()[row.shape, at] + np.cross(
                field[:, 1:], templates()[row.shape, at]
            )
        columns.append(np.tensordot(WEIGHTS, moved, axes=1)[:, system.sample].ravel())
    F = np.stack(columns, axis=1)
    trust = np.repeat(system.trust.ravel(), 3)
    left = (shown(personal()) - shown(templates()))[:, system.sample].ravel()
    expected = np.linalg.solve(np.eye(size) + F.T @ (trust[:, None] * F), F.T @ (trust * left))
    found = solve_fields(system, options).z
    np.testing.assert_allclose(F @ found, F @ expected, atol=2e-3)
    np.testing.assert_allclose(found, expected, atol=2e-2)


def test_dealing_out_is_the_ridge_solution() -> None:
    rng = np.random.default_rng(2)
    weights, spread, confidence = rng.normal(size=(4, 6)), rng.uniform(0.5, 2.0, (7, 6)), rng.uniform(0, 1, (7, 4))
    values, noise = rng.normal(size=(7, 4, 3)), 0.3
    found = dealt_out(weights, spread, noise, confidence, values)
    for place in range(7):
        pull = weights.T * confidence[place] / noise**2
        expected = np.linalg.solve(pull @ weights + np.diag(spread[place] ** -2.0), pull @ values[place])
        np.testing.assert_allclose(found[place], expected, atol=1e-9)


@pytest.mark.parametrize(("which", "number"), [("composites", np.nan), ("templates", np.inf)])
def test_numbers_that_are_not_finite_are_refused(which: str, number: float) -> None:
    given = {"templates": templates(), "composites": shown(personal())}
    given[which] = np.full_like(given[which], number)
    with pytest.raises(InputError, match="NaN or infinity"):
        split_shapes(neutral(), given["templates"], given["composites"], WEIGHTS, triangles(), **whole(4))


def test_options_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="option noise"):
        SplitOptions(noise=0.0)
