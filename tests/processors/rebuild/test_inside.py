"""What lies inside a head, and no scan shows, goes with the skin around it when a neutral is fitted."""

from __future__ import annotations

import numpy as np
import pytest

from facepipe.heads.assembly import make
from facepipe.processors.rebuild.template import Template


@pytest.fixture(scope="module")
def template() -> Template:
    return Template.of(make(0), "head")


def test_the_mouths_inside_goes_back_with_the_chin(template: Template) -> None:
    base = template.points[template.rows]
    seen = np.zeros(len(base), bool)
    seen[template.seen] = True
    lips = base[template.landmarks[48:60]].mean(axis=0)
    away = np.zeros_like(base)
    away[:, 2] = -10.0 / (1.0 + np.exp((base[:, 1] - lips[1] + 10.0) / 4.0))  # mm, all below the lips
    alone = np.where(seen[:, None], away, 0.0)  # what a fit that knows the skin alone does
    moves = template.with_inside(base, alone)
    np.testing.assert_array_equal(moves[seen], away[seen])
    inside = ~seen & (np.abs(base[:, 0] - lips[0]) < 25) & (np.abs(base[:, 1] - lips[1] + 12) < 8) & (base[:, 2] > 70)
    assert inside.sum() > 100
    assert np.abs(alone - away)[inside, 2].max() > 8.0
    assert np.abs(moves - away)[inside, 2].mean() < 0.3 * np.abs(alone - away)[inside, 2].mean()


def test_one_move_of_all_is_everyones(template: Template) -> None:
    base, way = template.points[template.rows], np.array([1.0, -2, 3])
    np.testing.assert_allclose(template.with_inside(base, np.tile(way, (len(base), 1))), np.tile(way, (len(base), 1)))
