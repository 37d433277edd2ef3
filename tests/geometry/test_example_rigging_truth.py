"""Shapes split from composites of actors whose own shapes are known, on a real head.

Six actors at length: benchmarks/rebuild_truth.py.
"""

from __future__ import annotations

import numpy as np
import pytest
from scan_actors import ict
from split_truth import KINDS, composites, known, ratios, weights, whole

from facepipe.geometry.example_rigging import SplitOptions, split_shapes

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("seed", [101])
def test_personal_shapes_are_much_nearer_than_generic_ones(seed: int) -> None:
    for kind, largest in KINDS.items():
        ratio, excited, worse = ratios(seed, kind)
        print(f"{kind} {seed}: {ratio:.3f}, excited {excited:.3f}, worse than generic {worse} of 53")
        assert ratio <= largest
        assert worse <= 12


@pytest.mark.parametrize("seed", [100])
def test_weights_wrong_by_10_to_20_percent_are_found(seed: int) -> None:
    actor, true = known(seed), weights()
    rng = np.random.default_rng([seed, 10])
    wrong = true * (1.0 + rng.choice([-1.0, 1.0], true.shape) * rng.uniform(0.1, 0.2, true.shape))
    given = composites(actor, "exact", seed)
    arrays = actor.neutral, actor.generic, given, wrong, ict().triangles
    options = (SplitOptions(weight_spread=spread) for spread in (0.0, 0.1))
    kept, found = (split_shapes(*arrays, one, **whole(actor)) for one in options)
    repeated = (true > 0) & ((true > 0).sum(axis=0) > 1)
    before, after = (np.abs(scaled(one, true) - true)[repeated].mean() for one in (wrong, found.weights))
    errors = [actor.errors(one).sum() / actor.errors(actor.generic).sum() for one in (kept.deltas, found.deltas)]
    print(f"{seed}: weights off by {before:.3f}, found {after:.3f}; shapes {errors[0]:.3f}, found {errors[1]:.3f}")
    assert after < 0.3 * before
    assert errors[1] < 0.8 * errors[0]


def scaled(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Weights with each shape's scale as in the truth: a larger shape with smaller weights shows the same."""
    return np.asarray(found * (found * true).sum(axis=0) / np.maximum((found * found).sum(axis=0), 1e-12))
