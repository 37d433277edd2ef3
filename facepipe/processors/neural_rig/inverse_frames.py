"""Frames settled one by one, once more where they are much worse than the others, and then as clips."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.frames_in_a_box import Box, Data, Settled, Smoothness, settle
from facepipe.processors.neural_rig.options import InvertNeuralRigOptions
from facepipe.rig.neural_rig import NeuralRig, share_limits

ENOUGH = 1e-5  # of ranges: a smaller step ends it
_AT_ONCE = 64  # frames
_WINDOW = 120  # frames of a clip that are solved together; those before are known
_FEW = 8  # frames, of which none can be said to be worse than the others
_WORSE = 3.0  # times the median of the costs, by those at rest
_SAME = 0.01  # of a cost: another start that ends so near was in the same valley
_BUSY = 0.5  # share of the controls that a random start moves
_SMALL = 1e-4  # mm^2 that are no reason to start again: a hundredth of a millimetre


@dataclass(frozen=True, kw_only=True)
class Frames:
    """Targets, and what is asked of their controls; x is how far these are from defaults, in shares of ranges."""

    rig: NeuralRig
    data: Data
    options: InvertNeuralRigOptions

    def settled(
        self, count: int, start: FloatArray | None, blocks: IntArray | None, done: Callable[[], object]
    ) -> tuple[FloatArray, float]:
        """(f, c) x, and the mean number of steps.

        :param count: of frames
        :param done: called once for each frame
        """
        rest = np.zeros((count, len(self.box.lower)))
        found = self._each(rest if start is None else start, np.arange(count), done)
        random, again = np.random.default_rng(self.options.seed), np.arange(count)
        still = self.data.cost(rest, again)
        for attempt in range(1, self.options.starts):
            again = np.intersect1d(again, self._worse(found.cost, still))
            shape = (len(again), rest.shape[1])
            other: FloatArray = random.uniform(self.box.lower, self.box.upper, shape) * (random.random(shape) < _BUSY)
            near = _nearest_good(again, count)
            if attempt == 1 and start is not None:
                other = rest[again]
            elif attempt == 1 and blocks is not None and len(near):
                other = found.x[near]
            tried = self._each(other, again)
            apart = np.abs(tried.cost - found.cost[again]) > _SAME * found.cost[again]
            found, again = _better(found, tried, again), again[apart]
        if blocks is None or self.options.smoothness == 0.0:
            return found.x, float(found.steps.mean())
        x, steps = found.x, found.steps
        for rows, before in _windows(np.asarray(blocks)):
            clip = self._settle(x[rows], rows, Smoothness(weight=self.options.smoothness, before=x[before]))
            x[rows] = clip.x
            steps[rows] += clip.steps
        return x, float(steps.mean())

    @cached_property
    def box(self) -> Box:
        """Limits of x."""
        lower, upper = share_limits(self.rig.controls)
        return Box(lower=lower, upper=upper, l1=self.options.l1)

    def _each(self, start: FloatArray, frames: IntArray, done: Callable[[], object] = lambda: None) -> Settled:
        """Each on its own."""
        found = []
        for first in range(0, len(frames), _AT_ONCE):
            rows = slice(first, first + _AT_ONCE)
            found.append(self._settle(start[rows], frames[rows]))
            for _ in frames[rows]:
                done()
        if not found:
            return Settled(x=start, cost=np.zeros(0), steps=np.zeros(0, np.int64))
        return Settled(
            x=np.concatenate([one.x for one in found]),
            cost=np.concatenate([one.cost for one in found]),
            steps=np.concatenate([one.steps for one in found]),
        )

    def _settle(self, start: FloatArray, frames: IntArray, smoothness: Smoothness | None = None) -> Settled:
        data = _Some(data=self.data, frames=frames)
        return settle(data, start, self.box, smoothness=smoothness, steps=self.options.steps, enough=ENOUGH)

    def _worse(self, cost: FloatArray, still: FloatArray) -> IntArray:
        """Frames that may be in a poor valley.

        :param still: (f,) costs at rest: what moves further is less well met
        """
        share = cost / np.maximum(still, 1e-30)
        usual = _WORSE * float(np.median(share)) if len(cost) >= _FEW else 0.0
        return np.flatnonzero((share > usual) & (cost > _SMALL))


@dataclass(frozen=True, kw_only=True)
class _Some:
    """The data of some frames, by their numbers among themselves."""

    data: Data
    frames: IntArray

    def cost(self, x: FloatArray, frames: IntArray) -> FloatArray:
        return self.data.cost(x, self.frames[frames])

    def normal(self, x: FloatArray, frames: IntArray) -> tuple[FloatArray, FloatArray]:
        return self.data.normal(x, self.frames[frames])


def _nearest_good(again: IntArray, count: int) -> IntArray:
    """Of each frame to start again: the nearest of those that are not; none where all are."""
    good = np.setdiff1d(np.arange(count), again)
    if not len(good):
        return good
    return np.asarray(good[np.abs(good[None, :] - again[:, None]).argmin(axis=1)])


def _better(found: Settled, other: Settled, rows: IntArray) -> Settled:
    """Some frames replaced where the other is better; steps of both count."""
    x, cost, steps = found.x.copy(), found.cost.copy(), found.steps.copy()
    better = other.cost < cost[rows]
    x[rows[better]], cost[rows[better]] = other.x[better], other.cost[better]
    steps[rows] += other.steps
    return Settled(x=x, cost=cost, steps=steps)


def _windows(blocks: IntArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Frames that are solved together, and the two known ones before them, clip by clip."""
    for clip in np.split(np.arange(len(blocks)), np.flatnonzero(np.diff(blocks)) + 1):
        for first in range(0, len(clip), _WINDOW):
            yield clip[first : first + _WINDOW], clip[max(first - 2, 0) : first]
