"""Registration of a deformable face with scans: matches and steps in turn, from coarse to fine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.threads import one_thread
from facepipe.geometry.options import RegistrationOptions
from facepipe.geometry.polygons import point_areas
from facepipe.geometry.registration.step import (
    Demand,
    Membrane,
    Registered,
    View,
    ViewState,
    solve_model_step,
    solve_step,
)
from facepipe.geometry.registration.surface import Anchors, DeformableSurface, ScanTarget, Shown, means_around
from facepipe.geometry.similarity import Similarity


class Stage(NamedTuple):
    """Steps of one width."""

    reach: float  # factor of the options'
    huber: float  # factor of the options'
    most: int  # steps
    still: float  # mm, the RMS movement that ends it
    by_model: bool = False  # left to the modes where they can come near by themselves, on some of the points


def in_stages(
    stages: Sequence[Stage],
    advance: Callable[[Stage], float],
    progress: Callable[[int], None],
    lost: Callable[[], bool] = lambda: False,
) -> int:
    """Take the steps of all stages; how many.

    :param advance: takes one, and gives the RMS movement [mm]
    :param lost: whether no more stages are worth their steps
    """
    steps = 0
    for stage in stages:
        for _ in range(stage.most):
            steps += 1
            change = advance(stage)
            progress(steps)
            if change < stage.still:
                break
        if lost():
            break
    return steps


STAGES = (Stage(5.0, 4.0, 6, 0.3, by_model=True), Stage(2.0, 2.0, 4, 0.5), Stage(1.0, 1.0, 8, 0.05))
_ENOUGH_MODES = 20
_COARSE_POINTS = 3000


def register(
    surface: DeformableSurface,
    scan: ScanTarget,
    anchors: Anchors,
    start: Similarity,
    options: RegistrationOptions | None = None,
    progress: Callable[[int], None] = lambda step: None,
    shown: Shown | None = None,
    stages: Sequence[Stage] = STAGES,
    growth: float = np.inf,
) -> Registered:
    """Fit a face to a scan.

    Robust point-to-plane distances to the nearest places (Huber), anchors, the modes' prior and a membrane for the
    residual, minimised together (`step`). Source: face-model-from-scans, S13 steps 1 to 5 and the first constraint,
    in one system instead of one after another: the residual keeps what the modes can't show from bending them.

    :param anchors: in the scan's own coordinates
    :param start: from those to the face's, about right
    :param shown: what the scan shows besides the surface
    :param growth: logarithm: a scan that has grown or shrunk by more after a stage keeps the size of its `start`, from
        the first step on. The modes alone show it, in 0.4 s of 8
    :raises FitError: hardly a point of the face finds a place on the scan
    """
    views, options = [View(scan=scan, anchors=anchors, start=start, shown=shown)], options or RegistrationOptions()
    state = _State(surface, views, options)
    steps = state.advance(stages, progress, growth)
    if state.growth > growth:
        state = _State(surface, views, replace(options, scale=False))
        steps = state.advance(stages, progress)
    return state.registered(steps)[0]


def register_together(
    surface: DeformableSurface,
    views: Sequence[View],
    coefficients: FloatArray,
    residual: FloatArray,
    options: RegistrationOptions | None = None,
    progress: Callable[[int], None] = lambda step: None,
    stages: Sequence[Stage] = STAGES[1:],
) -> tuple[Registered, ...]:
    """Refine a face that lies about right on several scans: coefficients, residual, and each scan's place and weights
    of what it shows besides, in one system a step. A result for each scan.

    :param coefficients: (k,) and `residual` (n, 3) to start from
    :raises FitError: hardly a point of the face finds a place on one of them
    """
    state = _State(surface, views, options or RegistrationOptions())
    state.coefficients, state.residual = coefficients, residual
    return state.registered(state.advance(stages, progress))


class _State:
    """The state of a registration between steps."""

    def __init__(self, surface: DeformableSurface, views: Sequence[View], options: RegistrationOptions) -> None:
        self._surface, self._options = surface, options
        self._some = replace(surface, seen=surface.seen[:: max(1, len(surface.seen) // _COARSE_POINTS)])
        self._areas = point_areas(surface.base, surface.triangles)
        around = means_around(surface.base, surface.triangles)
        self._views = [ViewState(view, surface, around, options) for view in views]
        self.coefficients = surface.expected.copy()
        self.residual = np.zeros_like(surface.base)

    @cached_property
    def _membrane(self) -> Membrane:
        spreads = [view.spread for view in self._views]
        return Membrane.on_surface(self._surface, self._areas, self._options.membrane, spreads)

    @property
    def growth(self) -> float:
        """By how much scans have grown or shrunk, the logarithm."""
        return max(abs(view.growth) for view in self._views)

    @one_thread()
    def advance(self, stages: Sequence[Stage], progress: Callable[[int], None], growth: float = np.inf) -> int:
        """Take the steps of all stages, how many; up to one after which a scan has grown or shrunk by more."""
        self._points = self._surface.points(self.coefficients, self.residual)
        return in_stages(stages, self._advance, progress, lambda: self.growth > growth)

    @one_thread()
    def registered(self, steps: int) -> tuple[Registered, ...]:
        """A result for each scan."""
        return tuple(view.registered(self._surface, self.coefficients, self.residual, steps) for view in self._views)

    def _advance(self, stage: Stage) -> float:
        """Take one step; the RMS movement of seen points against the first scan, in millimetres."""
        before, all_seen = self._points, self._surface.seen
        by_model = stage.by_model and len(self.coefficients) >= _ENOUGH_MODES
        surface = self._some if by_model else self._surface
        share = len(all_seen) / max(len(surface.seen), 1)  # each stands for its neighbours too
        demand = Demand(
            reach=self._options.reach_mm * stage.reach,
            huber=self._options.huber_mm * stage.huber,
            areas=self._areas[surface.seen] * share,
            roughly=by_model,
        )
        pulls = [view.pull(surface, before, demand) for view in self._views]
        step = solve_model_step(surface, pulls) if by_model else solve_step(surface, self._membrane, pulls)
        self.coefficients, self.residual = step.coefficients, step.residual
        for view, move, weights in zip(self._views, step.moves, step.weights, strict=True):
            view.advance(move, weights)
        self._points = self._surface.points(self.coefficients, self.residual)
        moved = self._points[all_seen] - step.moves[0].apply(before[all_seen])
        return float(np.sqrt((moved**2).sum(axis=1).mean()))
