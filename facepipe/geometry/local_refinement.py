"""A face drawn onto its scan where it may follow: matches and steps in turn, each triangle changed like its neighbours.

Source: face-model-from-scans, S13, the first constraint: distances of landmarks and of nearest points, and differences
between the changes of neighbouring triangles, in one sum of squares over points ``x = base + move``:

    sum_i w_i (n_i . (p_i - x_i))^2 + sum_l a_l |y_l - x_l|^2 + S(T(x)) + sum_i h_i |move_i|^2

with matches p and their normals n, anchors y, and the smoothness S of changes T (`change_smoothness`,
`triangle_frames`). Each step is of Gauss-Newton's kind: T to first order about where the points are, one sparse factor,
matches looked for anew.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.change_smoothness import ChangeSmoothness
from facepipe.geometry.factor import factorise
from facepipe.geometry.polygons import point_areas
from facepipe.geometry.registration import DeformableSurface, RegistrationOptions, View
from facepipe.geometry.registration.solve import Stage, in_stages
from facepipe.geometry.registration.step import Demand, Registered, ViewState
from facepipe.geometry.registration.surface import means_around

_LEAST_FOLLOW = 1e-6  # a point that follows less counts as this one
_STAGES = (Stage(1.0, 2.0, 4, 0.1), Stage(1.0, 1.0, 12, 0.005))


@dataclass(frozen=True, kw_only=True)
class RefinementOptions:
    """Weights of a refinement's terms; of `matching`, the membrane is not used."""

    detail_mm: float = 10.0  # of waves of this length in the scan half the height is followed
    fade_mm: float = 8.0  # so far from what pulls at them, triangles go back to their own shape
    drift_mm: float = 5.0  # how far points are off along the surface to begin with: standard deviation
    matching: RegistrationOptions = field(default_factory=RegistrationOptions)

    @property
    def smooth(self) -> float:
        """Weight of the squared gradient of changes, mm^2.

        A wave of height h along the normal has ``|grad T|^2 = 2 k^4 h^2`` with ``k = 2 pi / length``, as slope of the
        surface and as turn of its normal; it is followed by half where that costs as much as a match of
        ``h^2 / sigma^2``.
        """
        return (self.detail_mm / (2.0 * np.pi)) ** 4 / (2.0 * self.matching.surface_sigma_mm**2)

    @property
    def near(self) -> float:
        """Weight of the squared change itself: beside what pulls, changes fall by e over ``sqrt(smooth / near)``."""
        return self.smooth / self.fade_mm**2


def refine_locally(
    surface: DeformableSurface,
    view: View,
    follow: FloatArray,
    options: RefinementOptions | None = None,
    progress: Callable[[int], None] = lambda step: None,
) -> Registered:
    """Draw a face that lies about right on a scan closer to it. The scan stays where the view has it.

    :param surface: at rest, without modes
    :param follow: (n,) 0 to 1, the share of the way that a point may go: points of 0 stay to the bit
    :raises FitError: hardly a point that may move finds a place on the scan
    """
    state = _State(surface, view, np.asarray(follow, np.float64), options or RefinementOptions())
    return state.run(progress)


class _State:
    """The state of a refinement between steps."""

    def __init__(self, surface: DeformableSurface, view: View, follow: FloatArray, options: RefinementOptions) -> None:
        free = follow > 0.0
        self._surface = replace(surface, seen=surface.seen[free[surface.seen]])
        self._options, self._free = options.matching, free
        self._stays = (options.matching.surface_sigma_mm / options.drift_mm) ** 2
        around = means_around(surface.base, surface.triangles)
        self._view = ViewState(view, self._surface, around, options.matching)
        self._areas = point_areas(surface.base, surface.triangles)
        self._spread = self._view.spread[:, np.flatnonzero(free)]
        self._follow = follow
        self._smoothness = ChangeSmoothness.at_rest(surface.base, surface.triangles, free, options.smooth, options.near)
        self._moves = np.zeros_like(surface.base)

    @property
    def points(self) -> FloatArray:
        """(n, 3) points where they are now."""
        return np.where(self._free[:, None], self._surface.base + self._moves, self._surface.base)

    def run(self, progress: Callable[[int], None]) -> Registered:
        """Take the steps of all stages."""
        steps = in_stages(_STAGES, self._advance, progress)
        return replace(self._view.registered(self._surface, np.zeros(0), self._moves, steps), points=self.points)

    def _advance(self, stage: Stage) -> float:
        """Take one step; the RMS movement of the points that move, in millimetres."""
        from scipy.sparse import diags_array

        points, seen, free = self.points, self._surface.seen, self._smoothness.free
        demand = Demand(
            reach=self._options.reach_mm * stage.reach,
            huber=self._options.huber_mm * stage.huber,
            areas=self._areas[seen],
            roughly=False,
        )
        pull = self._view.pull(self._surface, points, demand)
        system = self._smoothness.system(points)
        # what holds points that follow in part is to the match as ``1 - follow`` to ``follow``: a point alone goes the
        # share `follow` of the way
        normals, blocks = pull.matches.normals, np.zeros((len(points), 3, 3))
        follow = np.maximum(self._follow, _LEAST_FOLLOW)
        areas = np.maximum(self._areas, 1e-4 * self._areas.mean())  # points without a triangle stay
        held = (self._stays + 1.0 / follow - 1.0) * areas / self._options.surface_sigma_mm**2
        blocks += held[:, None, None] * np.eye(3)
        blocks[pull.seen] += pull.weights[:, None, None] * normals[:, :, None] * normals[:, None, :]
        right = -held[:, None] * self._moves
        apart = np.einsum("mi,mi->m", pull.matches.places - points[pull.seen], normals)
        right[pull.seen] += (pull.weights * apart)[:, None] * normals
        # an anchor counts as far as its points follow: those beside them would else be pushed to make up for held ones
        anchored = pull.anchor_weights * pull.anchors.places(self._follow)
        off = pull.anchors.targets - pull.anchors.places(self._surface.base) - self._spread @ self._moves[free]
        system.diagonal += blocks[free]
        system.right += right[free] + self._spread.T @ (anchored[:, None] * off)
        shared = self._spread.T @ diags_array(anchored) @ self._spread
        step = factorise(system.matrix(shared)).solve(system.right.ravel()).reshape(-1, 3)
        self._moves[free] += step
        return float(np.sqrt((step**2).sum(axis=1).mean()))
