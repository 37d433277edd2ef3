"""How much scanned composites tell of each shape, and which shapes they can't tell apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.example_rigging.detail import parts, told_by
from facepipe.geometry.example_rigging.examples import Examples
from facepipe.geometry.example_rigging.options import SplitOptions

_MOVES = 0.05  # a place moves with a shape if by more than this share of the shape's largest motion
_NULL = 1e-6  # singular values below this share of the largest are 0
_TOGETHER = 0.1  # two shapes go together if this share of what they move in common can be of either


@dataclass(frozen=True, kw_only=True)
class RankReport:
    """What the weights alone leave open, whatever the scans show."""

    rank: int  # of the weights
    excited: int  # shapes that some composite holds
    ambiguous: FloatArray  # (e,) 0..1: share of a shape's motion that other shapes could have made just as well
    together: tuple[tuple[int, int], ...]  # pairs that can't be told apart where both move, most first


def observed(examples: Examples, weights: FloatArray, options: SplitOptions) -> FloatArray:
    """(e,) 0..1: how much of each shape's motion the composites decide, the rest being the template's; 0 unexcited.

    The diagonal of the resolution matrix of gains at each point, weighted by squared motion.
    """
    chosen = weights[:, examples.excited]
    motion = np.linalg.norm(examples.templates[examples.excited], axis=2).T
    spreads = (options.shared_gain, options.own_gain, options.shared_turn, options.own_turn, options.detail)
    shares = _resolution(chosen, np.hypot.reduce(spreads) * motion, options.noise, examples.confidence.T)
    energy = examples.areas[:, None] * motion**2
    found = np.zeros(weights.shape[1])
    found[examples.excited] = (shares * energy).sum(axis=0) / np.maximum(energy.sum(axis=0), np.finfo(float).tiny)
    return found


def rank_report(examples: Examples, sample: IntArray) -> RankReport:
    """What weights leave open at sampled points: the null space of the weights of the shapes that move there."""
    motion = np.linalg.norm(examples.templates[:, sample], axis=2).T  # (s, e)
    moves = (motion > _MOVES * motion.max(axis=0)) & examples.weights.any(axis=0)
    energy = np.where(moves, motion**2 * examples.areas[sample, None], 0.0)
    count = examples.weights.shape[1]
    open_energy, mixed = np.zeros(count), np.zeros((count, count))
    patterns, places = np.unique(moves, axis=0, return_inverse=True)
    for number, pattern in enumerate(patterns):
        shapes, here = np.flatnonzero(pattern), np.flatnonzero(places.ravel() == number)
        null = _null_projector(examples.weights[:, shapes])
        open_energy[shapes] += np.diag(null) * energy[np.ix_(here, shapes)].sum(axis=0)
        root = np.sqrt(energy[np.ix_(here, shapes)])
        shared = root.T @ root
        # of two shapes alone the projector's other entries are at most a half
        mixed[np.ix_(shapes, shapes)] += 2.0 * np.abs(null) * shared
    total = energy.sum(axis=0)
    total[total <= 0] = 1.0
    strength = np.triu(mixed, 1) / np.sqrt(np.outer(total, total))
    pairs = np.argwhere(strength > _TOGETHER)
    pairs = pairs[np.argsort(-strength[tuple(pairs.T)], kind="stable")]
    return RankReport(
        rank=int(np.linalg.matrix_rank(examples.weights)),
        excited=len(examples.excited),
        ambiguous=np.clip(open_energy / total, 0.0, 1.0),
        together=tuple((int(a), int(b)) for a, b in pairs),
    )


def _null_projector(weights: FloatArray) -> FloatArray:
    """(x, x) projector onto what no composite (c, x) shows."""
    if not weights.size:
        return np.eye(weights.shape[1])
    _, values, rows = np.linalg.svd(weights / np.linalg.norm(weights, axis=0))
    seen = rows[: int((values > _NULL * values[0]).sum())]
    return np.asarray(np.eye(weights.shape[1]) - seen.T @ seen)


def _resolution(weights: FloatArray, spread: FloatArray, noise: float, confidence: FloatArray) -> FloatArray:
    """(p, x) 0..1: the diagonal of the resolution matrix of `dealt_out`, whose parameters these are."""
    found = np.empty(spread.shape)
    for part in parts(len(spread)):
        shares, told, trusted = told_by(weights, spread[part], noise, confidence[part])
        solved = np.linalg.solve(told, trusted[:, :, None] * weights)
        found[part] = (shares * solved).sum(axis=1)
    return np.clip(found, 0.0, 1.0)
