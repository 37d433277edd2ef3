"""Weights refined for the face's own blendshapes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.heat_weights import normalised
from facepipe.geometry.skin_decomposition import DecompositionOptions, decompose
from facepipe.parts import FaceParts
from facepipe.processors.skin.options import SkinOptions
from facepipe.processors.skin.report import FitReport
from facepipe.processors.skin.surface import Surface
from facepipe.rig import build

_FAINT = 1e-4  # weights below are no candidates
_CANDIDATES = 8  # joints that a point may have, at least twice the influences


def optimised(
    parts: FaceParts,
    surface: Surface,
    weights: FloatArray,
    options: SkinOptions,
    step: Callable[[], object] = lambda: None,
) -> tuple[FloatArray, FitReport]:
    """Weights (m, j), few a point, with which rigid joints come nearest to the face's blendshapes.

    A point keeps to the joints that it has some weight of, before these are cut to few, so that nothing crosses lips
    or lids that did not before. Joints stay where they are.

    :param step: called after every round
    :raises InputError: no blendshape that moves anything
    """
    shapes = _shapes(parts, surface)
    moved = np.linalg.norm(shapes - surface.points, axis=2).max(axis=0, initial=0.0) > 0
    if not moved.any():
        raise InputError(surface.where, "no blendshapes to optimise for, expected some that move points")
    width = min(max(_CANDIDATES, 2 * options.influences), weights.shape[1])
    candidates = np.argsort(-weights, axis=1, kind="stable")[:, :width]
    start = np.take_along_axis(weights, candidates, axis=1)
    start = normalised(np.where(start >= _FAINT, start, 0.0))
    settings = DecompositionOptions(most=options.influences, iterations=options.iterations, evenness=options.evenness)
    fitted = decompose(surface.points, shapes, surface.edges, candidates, start, settings, step)
    refined = np.zeros_like(weights)
    np.put_along_axis(refined, candidates, fitted.weights, axis=1)
    before, after = fitted.before[:, moved], fitted.after[:, moved]
    return refined, FitReport(
        shapes=len(shapes),
        points=int(moved.sum()),
        rms_before_mm=float(np.sqrt((before**2).mean())),
        rms_after_mm=float(np.sqrt((after**2).mean())),
        max_before_mm=float(before.max()),
        max_after_mm=float(after.max()),
    )


def _shapes(parts: FaceParts, surface: Surface) -> FloatArray:
    """(s, m, 3) the sewn points with every shape alone at 1, in millimetres of the world."""
    rig = build(parts)
    first = np.unique(surface.group, return_index=True)[1]
    linear = np.asarray(parts.skeleton.transform, np.float64)[:3, :3] * parts.meters_per_unit * 1000.0
    posed = np.empty((len(rig.shapes), len(first), 3))
    for number, weights in enumerate(np.eye(len(rig.shapes))):
        posed[number] = surface.points + (rig.morph(weights) - rig.points)[first] @ linear.T
    return posed
