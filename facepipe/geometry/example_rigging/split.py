"""A person's own shapes from scanned composites."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.deformation_transfer import gradient_operator
from facepipe.geometry.example_rigging.field_solve import (
    Examples,
    FieldSolution,
    FieldSystem,
    examples_of,
    solve_fields,
)
from facepipe.geometry.factor import factorise
from facepipe.geometry.options import SplitOptions

_PLACES_AT_ONCE = 4096  # places at a time: a bound on memory
_PAIRS_NAMED = 5  # pairs that a warning names
_HARDLY_OBSERVED = 0.05  # excited shapes observed less than this are as good as not scanned
_MOVING_SHARE = 0.05  # a place moves with a shape if by more than this share of the shape's largest motion
_NULL_SINGULAR_VALUE = 1e-6  # singular values below this share of the largest are 0
_TOGETHER_SHARE = 0.1  # two shapes go together if this share of what they move in common can be of either
# and are one for the composites from this share on: less leaves them truer than their templates, as people's own way is
# much the same in neighbouring shapes
_ONE_SHAPE_SHARE = 0.9


def added_detail(
    examples: Examples, weights: FloatArray, residuals: FloatArray, deltas: FloatArray, options: SplitOptions
) -> FloatArray:
    """(x, n, 3) what the excited shapes gain from residuals (c, n, 3).

    :param deltas: (x, n, 3) of the excited shapes so far
    """
    chosen = weights[:, examples.excited]
    poisson = AnchoredPoisson(examples, options.detail_length)
    motion = poisson.smooth(np.linalg.norm(deltas, axis=2).T)  # (n, x)
    motion[examples.stiff >= 0] = 0.0
    from_points = dealt_out(
        chosen, options.detail * motion, options.noise, examples.confidence.T, residuals.transpose(1, 0, 2)
    )
    corners = examples.triangles
    slopes = poisson.gradient @ np.asarray(residuals.transpose(1, 0, 2).reshape(residuals.shape[1], -1))  # (2t, 3c)
    slopes = slopes.reshape(len(corners), 2, len(residuals), 3).transpose(0, 2, 1, 3).reshape(len(corners), -1, 6)
    squares = [np.square(poisson.gradient @ delta).reshape(-1, 6).sum(axis=1) for delta in deltas]
    steep = np.sqrt(np.array(squares).T) + motion[corners].mean(axis=1) / options.field_length
    steep[(examples.stiff[corners] >= 0).any(axis=1)] = 0.0
    trusted = examples.confidence[:, corners].min(axis=2).T
    noise = options.noise / options.noise_length
    from_slopes = dealt_out(chosen, options.detail * steep, noise, trusted, slopes)  # (t, x, 6)
    count = chosen.shape[1]
    from_slopes = from_slopes.reshape(-1, count, 2, 3).transpose(0, 2, 1, 3).reshape(-1, 3 * count)
    found = poisson.solve(from_slopes, from_points.reshape(-1, 3 * count))
    return np.ascontiguousarray(found.reshape(-1, count, 3).transpose(1, 0, 2))


def dealt_out(
    weights: FloatArray, spread: FloatArray, noise: float, confidence: FloatArray, values: FloatArray
) -> FloatArray:
    """(p, x, d) the most probable parts of shapes in values (p, c, d) of composites, place by place.

    ``S A^T C (C A S A^T C + noise^2)^-1 C values`` with weights A, ``S = diag(spread^2)`` and ``C^2 = confidence``.

    :param weights: (c, x)
    :param spread: (p, x) of the parts
    :param noise: spread of the values' errors
    :param confidence: (p, c) 0..1
    """
    probable = np.empty((len(values), weights.shape[1], values.shape[2]))
    for part in parts(len(values)):
        shares, covariance, trusted = normal_equations(weights, spread[part], noise, confidence[part])
        solved = np.linalg.solve(covariance, trusted[:, :, None] * values[part])
        probable[part] = shares.transpose(0, 2, 1) @ solved
    return probable


def normal_equations(
    weights: FloatArray, spread: FloatArray, noise: float, confidence: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``C A S`` (p, c, x), ``C A S A^T C + noise^2`` (p, c, c) and the diagonal of C (p, c)."""
    trusted = np.sqrt(confidence)
    shares = trusted[:, :, None] * weights * (spread * spread)[:, None, :]
    covariance = (shares @ weights.T) * trusted[:, None, :]
    covariance += noise * noise * np.eye(len(weights))
    return shares, covariance, trusted


def parts(count: int) -> list[slice]:
    """Slices of `count` places."""
    return [slice(start, start + _PLACES_AT_ONCE) for start in range(0, count, _PLACES_AT_ONCE)]


class AnchoredPoisson:
    """Minimises ``sum_t area_t |grad x - g_t|^2 + sum_i area_i |x_i - p_i|^2 / length^2`` over the neutral.

    Gradients decide what is finer than the length, points what is coarser, above all where a whole piece is: gradients
    leave that free.

    :ivar gradient: sparse (2t, n), rows 2i and 2i + 1 in the plane of triangle i
    """

    def __init__(self, examples: Examples, length: float) -> None:
        from scipy.sparse import diags_array

        self.gradient, areas = gradient_operator(examples.neutral, examples.triangles)
        self._divergence = (self.gradient.T @ diags_array(np.repeat(areas, 2))).tocsr()
        self._hold = examples.areas / length**2
        self._factor = factorise(self._divergence @ self.gradient + diags_array(self._hold))

    def solve(self, gradients: FloatArray, points: FloatArray) -> FloatArray:
        """(n, k) from gradients (2t, k) and points (n, k)."""
        return self._factor.solve(self._divergence @ gradients + self._hold[:, None] * points)

    def smooth(self, values: FloatArray) -> FloatArray:
        """(n, k) values (n, k) diffused over the length; none becomes negative that was not."""
        return np.maximum(self._factor.solve(self._hold[:, None] * values), 0.0)


@dataclass(frozen=True, kw_only=True)
class Split:
    """The shapes, and how far to believe them."""

    deltas: FloatArray  # (e, n, 3) the person's own; the template's, to the bit, where no composite holds the shape
    weights: FloatArray  # (c, e) as the composites show them
    observed: FloatArray  # (e,) 0..1 how much the composites decided of each shape, the rest being the template's
    gains: FloatArray  # (e,) motion along the template's, over the template's; 1 unexcited
    changes: FloatArray  # (e,) mm, mean distance from the template over the area that the shape moves
    residual_means: FloatArray  # (c,) mm, mean over the composite's points of confidence above 0
    residual_p95: FloatArray  # (c,) mm
    rank: int  # of the weights
    together: tuple[tuple[int, int], ...]  # pairs that weights don't separate where both move, most first
    warnings: tuple[str, ...]
    undecided: tuple[
        int, ...
    ] = ()  # shapes of pairs that composites can't distinguish at all: the template's, to the bit


def split_shapes(
    neutral: FloatArray,
    template_deltas: FloatArray,
    composites: FloatArray,
    weights: FloatArray,
    triangles: IntArray,
    options: SplitOptions | None = None,
    *,
    point_weights: FloatArray,
    stiff: IntArray,
    names: Sequence[str],
) -> Split:
    """Split composites, each a weighted sum of shapes on the neutral, into the shapes.

    First the part of the person that is smooth over the face: gains and turns of the templates, with the weights; then
    what that leaves, dealt out per triangle and point and joined by a Poisson system with one factor for all shapes.

    Source: the document on face models from scans, step S16, and Li, Weise & Pauly, "Example-Based Facial Rigging",
    SIGGRAPH 2010, whose prior per triangle is kept and the smooth part put before it.

    :param neutral: (n, 3) mm
    :param template_deltas: (e, n, 3) mm: the shapes as a template makes them for this neutral
    :param composites: (c, n, 3) mm: points of the registered scans, stabilised on the neutral
    :param weights: (c, e) of the shapes that each composite was to show, none all 0
    :param triangles: (t, 3)
    :param point_weights: (c, n) 0..1: how far each point was scanned. Points scanned in none follow the smooth part
    :param stiff: (n,) numbers of pieces that bend no more than their templates do, such as teeth and eyeballs, -1 for
        none: one gain and turn for all of a piece
    :param names: (e,) of the shapes, for the warnings
    :raises InputError: NaN or infinity
    """
    options = options or SplitOptions()
    examples = examples_of(neutral, template_deltas, composites, weights, triangles, point_weights, stiff)
    system = FieldSystem(examples, options)
    solution = solve_fields(system, options)
    deltas = system.deltas(solution.z)
    if options.detail > 0:
        left = examples.residuals(deltas, solution.weights)
        excited = examples.excited
        deltas[excited] += added_detail(examples, solution.weights, left, deltas[excited], options)
    shared = inseparable(examples, system.sample)
    undecided = np.unique(np.argwhere(shared >= _ONE_SHAPE_SHARE))
    # of what composites show as one, the prior alone would say whose it is
    deltas[undecided] = examples.templates[undecided]
    return _report(examples, solution, deltas, options, shared, names)


def _report(
    examples: Examples,
    solution: FieldSolution,
    deltas: FloatArray,
    options: SplitOptions,
    shared: FloatArray,
    names: Sequence[str],
) -> Split:
    """The split with its measures and warnings; `shared` (e, e) is what `inseparable` gives."""
    seen = observed(examples, solution.weights, options)
    pairs = np.argwhere(shared > _TOGETHER_SHARE)
    pairs = pairs[np.argsort(-shared[tuple(pairs.T)], kind="stable")]
    together = tuple((int(a), int(b)) for a, b in pairs)
    undecided = np.unique(np.argwhere(shared >= _ONE_SHAPE_SHARE))
    seen[undecided] = 0.0
    left = examples.residuals(deltas, solution.weights)
    means, p95 = np.zeros(len(left)), np.zeros(len(left))
    for number, (vectors, confidence) in enumerate(zip(left, examples.confidence, strict=True)):
        distances = np.linalg.norm(vectors[confidence > 0], axis=1)
        if len(distances):
            means[number], p95[number] = distances.mean(), np.percentile(distances, 95)
    # gains ``<template, delta> / <template, template>``, products weighted by area; changes where a shape moves points
    # by a twentieth of its largest motion: over all of the head they would hardly show
    gains, changes = np.ones(len(deltas)), np.zeros(len(deltas))
    for shape in examples.excited:
        template = examples.templates[shape]
        square = (examples.areas[:, None] * template**2).sum()
        if square > 0:
            gains[shape] = (examples.areas[:, None] * template * deltas[shape]).sum() / square
        motion = np.linalg.norm(template, axis=1)
        area = np.where(motion > 0.05 * motion.max(), examples.areas, 0.0)
        if area.any():
            changes[shape] = np.average(np.linalg.norm(deltas[shape] - template, axis=1), weights=area)
    return Split(
        deltas=deltas,
        weights=solution.weights,
        observed=seen,
        gains=gains,
        changes=changes,
        residual_means=means,
        residual_p95=p95,
        rank=int(np.linalg.matrix_rank(examples.weights)),
        together=together,
        warnings=_warnings(examples, solution, seen, together, names),
        undecided=tuple(undecided.tolist()),
    )


def _warnings(
    examples: Examples,
    solution: FieldSolution,
    seen: FloatArray,
    together: Sequence[tuple[int, int]],
    names: Sequence[str],
) -> tuple[str, ...]:
    warnings = []
    unexcited = np.flatnonzero(~examples.weights.any(axis=0)).tolist()
    if unexcited:
        warnings.append(f"no composite shows {', '.join(names[shape] for shape in unexcited)}: kept from the template")
    hidden = [shape for shape in examples.excited.tolist() if seen[shape] < _HARDLY_OBSERVED]
    if hidden:
        warnings.append(f"the scans hardly show {', '.join(names[shape] for shape in hidden)}")
    if together:
        pairs = ", ".join(f"{names[a]} and {names[b]}" for a, b in together[:_PAIRS_NAMED])
        more = f" and {len(together) - _PAIRS_NAMED} more pairs" if len(together) > _PAIRS_NAMED else ""
        warnings.append(f"the weights don't separate, where both move: {pairs}{more}")
    if solution.held:
        stopped = ", ".join(f"{names[shape]} in composite {composite}" for composite, shape in solution.held)
        warnings.append(f"weights at their bounds: {stopped}")
    if not solution.settled:
        warnings.append("gains and turns did not converge")
    return tuple(warnings)


def observed(examples: Examples, weights: FloatArray, options: SplitOptions) -> FloatArray:
    """(e,) 0..1: how much of each shape's motion the composites decide, the rest being the template's; 0 unexcited.

    The diagonal of the resolution matrix of gains at each point, weighted by squared motion.
    """
    chosen = weights[:, examples.excited]
    motion = np.linalg.norm(examples.templates[examples.excited], axis=2).T
    spreads = (options.shared_gain, options.own_gain, options.shared_turn, options.own_turn, options.detail)
    spread, confidence = np.hypot.reduce(spreads) * motion, examples.confidence.T
    shares = np.empty(spread.shape)
    for part in parts(len(spread)):
        split, covariance, trusted = normal_equations(chosen, spread[part], options.noise, confidence[part])
        shares[part] = (split * np.linalg.solve(covariance, trusted[:, :, None] * chosen)).sum(axis=1)
    shares = np.clip(shares, 0.0, 1.0)
    energy = examples.areas[:, None] * motion**2
    found = np.zeros(weights.shape[1])
    found[examples.excited] = (shares * energy).sum(axis=0) / np.maximum(energy.sum(axis=0), np.finfo(float).tiny)
    return found


def inseparable(examples: Examples, sample: IntArray) -> FloatArray:
    """(e, e) above the diagonal, 0..1: how much of what two shapes move in common can be of either, whatever the scans
    show: by the null space, at sampled points, of the weights of the shapes that move there.
    """
    motion = np.linalg.norm(examples.templates[:, sample], axis=2).T  # (s, e)
    moves = (motion > _MOVING_SHARE * motion.max(axis=0)) & examples.weights.any(axis=0)
    energy = np.where(moves, motion**2 * examples.areas[sample, None], 0.0)
    count = examples.weights.shape[1]
    mixed = np.zeros((count, count))
    patterns, places = np.unique(moves, axis=0, return_inverse=True)
    for number, pattern in enumerate(patterns):
        shapes, here = np.flatnonzero(pattern), np.flatnonzero(places.ravel() == number)
        # projector onto what no composite shows of them
        weights, null = examples.weights[:, shapes], np.eye(len(shapes))
        if weights.size:
            _, values, rows = np.linalg.svd(weights / np.linalg.norm(weights, axis=0))
            seen = rows[: int((values > _NULL_SINGULAR_VALUE * values[0]).sum())]
            null -= seen.T @ seen
        root = np.sqrt(energy[np.ix_(here, shapes)])
        shared = root.T @ root
        # of two shapes alone the projector's other entries are at most a half
        mixed[np.ix_(shapes, shapes)] += 2.0 * np.abs(null) * shared
    total = energy.sum(axis=0)
    total[total <= 0] = 1.0
    return np.asarray(np.triu(mixed, 1) / np.sqrt(np.outer(total, total)))
