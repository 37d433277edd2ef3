"""The mouth's inside stays behind the skin of drawn people."""

from __future__ import annotations

import numpy as np
import pytest

from facepipe.core.arrays import FloatArray
from facepipe.geometry.polygons import point_triangles
from facepipe.heads.asset import asset
from facepipe.heads.part_fits import fit_mouth
from facepipe.heads.people import draw

SKIN, INSIDE = 9409, slice(11248, 13294)  # points of the face, and of the mouth's inside


def drawn(seed: int) -> FloatArray:
    return asset().points + np.tensordot(draw(seed).identity.astype(np.float32), asset().modes, axes=1)


def before_the_skin(points: FloatArray) -> int:
    """Points of the mouth's inside, deep in the average head, that no skin hides from the front.

    Those between the lips may be seen.
    """
    lips = points[asset().landmarks[60:], 1]
    triangles = point_triangles(asset().counts, asset().indices)
    deep = points[INSIDE][asset().points[INSIDE, 2] < 11.0]
    corners = points[triangles[(triangles < SKIN).all(axis=1)]]
    near = (corners.min(axis=1) <= deep.max(axis=0)) & (corners.max(axis=1) >= deep.min(axis=0))
    a, b, c = corners[near[:, :2].all(axis=1)].transpose(1, 0, 2)
    count = 0
    for point in deep:
        across = [
            u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
            for u, v in ((b - point, c - point), (c - point, a - point), (a - point, b - point))
        ]
        shares = np.stack(across)
        over = ((shares >= 0).all(axis=0) | (shares <= 0).all(axis=0)) & (shares.sum(axis=0) != 0)
        depths = (shares * np.stack([a[:, 2], b[:, 2], c[:, 2]]))[:, over].sum(axis=0) / shares[:, over].sum(axis=0)
        count += not (depths > point[2]).any() and not lips.min() < point[1] < lips.max()
    return count


def test_the_inside_of_a_mouth_is_behind_the_skin() -> None:
    """Of somebody a quarter farther from the average than is drawn: a fit to a scan or a photo may be."""
    points = asset().points + 1.25 * (drawn(21) - asset().points)
    assert before_the_skin(points) > before_the_skin(fit_mouth(points)) == before_the_skin(asset().points) == 0


@pytest.mark.parametrize("seed", [1, 21])
def test_nothing_else_moves_and_the_average_head_stays(seed: int) -> None:
    """Nothing but teeth and gums, which go back as one, by 1.5 mm at most."""
    points = drawn(seed)
    moves = fit_mouth(points) - points
    rigid = [asset().parts[name].points for name in ("Teeth", "GumsAndTongue")]
    back = -moves[rigid[0], 2]
    assert 0.0 < back[0] < 0.1501
    for part in rigid:
        np.testing.assert_allclose(moves[part], np.broadcast_to([0.0, 0.0, -back[0]], moves[part].shape), atol=1e-12)
        moves[part] = 0.0
    moved = np.flatnonzero(moves.any(axis=1))
    assert ((moved >= INSIDE.start) & (moved < INSIDE.stop)).all()
    np.testing.assert_array_equal(fit_mouth(asset().points), asset().points)
