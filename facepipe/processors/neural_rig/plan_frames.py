"""Which values the controls of a rig are set to, for frames to learn it from."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.processors.neural_rig.options import SampleMotionOptions
from facepipe.rig.neural_rig import Control


def plan(controls: Sequence[Control], options: SampleMotionOptions) -> tuple[FloatArray, IntArray]:
    """(f, c) values and (f,) blocks: each sweep is a block; what is drawn at random stands alone, a block each.

    :raises InputError: no frame asked for
    """
    low, high, rest = (np.array([getattr(one, key) for one in controls]) for key in ("minimum", "maximum", "default"))
    pieces = list(_sweeps(low, high, rest, options.sweep))
    random = np.random.default_rng(options.seed)
    spread = low + (high - low) * _hypercube(options.spread, len(controls), random)
    singles = np.concatenate(
        [
            np.where(_moved(options.spread, len(controls), options.busy, random), spread, rest),
            _combinations(low, high, rest, options.together, random),
        ]
    )
    sizes = [len(piece) for piece in pieces] + [1] * len(singles)
    values = np.concatenate([*pieces, singles])
    if not len(values):
        raise InputError("motion", "no frame, expected some of spread, sweep or together")
    return values, np.repeat(np.arange(len(sizes)), sizes)


def _hypercube(count: int, controls: int, random: np.random.Generator) -> FloatArray:
    """(count, controls) in 0..1: of each control, one in each `count`-th of its range (McKay et al. 1979)."""
    if not count:
        return np.zeros((0, controls))
    order = np.stack([random.permutation(count) for _ in range(controls)], axis=1)
    return np.asarray((order + random.random((count, controls))) / count)


def _moved(count: int, controls: int, busy: float, random: np.random.Generator) -> BoolArray:
    """(count, controls) which of them a frame moves: a share of them up to `busy`, another in each frame."""
    share = np.full(count, 1.0) if busy == 1.0 else busy * random.random(count)
    moved = random.random((count, controls)) < share[:, None]
    moved[np.arange(count), random.integers(controls, size=count)] = True  # no frame stays at rest
    return np.asarray(moved)


def _sweeps(low: FloatArray, high: FloatArray, rest: FloatArray, count: int) -> Iterator[FloatArray]:
    """Each control from one limit to the other, the others at rest."""
    for control in range(len(low)) if count else ():
        frames = np.tile(rest, (count, 1))
        frames[:, control] = np.linspace(low[control], high[control], count)
        yield frames


def _combinations(
    low: FloatArray, high: FloatArray, rest: FloatArray, count: int, random: np.random.Generator
) -> FloatArray:
    """(count, c): two or three controls anywhere, the others at rest; each control as often as any other."""
    frames = np.tile(rest, (count, 1))
    turns: list[int] = []
    for row in range(count):
        wanted = min(2 + row % 2, len(low))
        while len(turns) < wanted:
            turns += [one for one in random.permutation(len(low)).tolist() if one not in turns]
        chosen, turns = turns[:wanted], turns[wanted:]
        frames[row, chosen] = random.uniform(low[chosen], high[chosen])
    return frames
