"""The weights whose blend comes nearest to a target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from facepipe.core.arrays import FloatArray
from facepipe.core.reports import Report, table
from facepipe.core.threads import one_thread
from facepipe.geometry.bounded_least_squares import fit_simplex
from facepipe.geometry.gradient_system import edge_vectors
from facepipe.geometry.similarity import fit_similarity
from facepipe.stage import Face
from facepipe.verbs.blend.session import BlendSession
from facepipe.verbs.blend.sources import UNALIGNED, stack
from facepipe.verbs.blend.weights import Weights

_EXACT_MM = 1e-3  # RMS: a target that is as near as that as it lies is a blend of the sources, in its place
_STEPS = 30
_STILL = 1e-10  # radians, and of the size: a smaller step is none
_TOLD = 0.05  # degrees and per cent that a target is turned and scaled by, from which on the report says it


@dataclass(frozen=True, kw_only=True)
class MatchReport(Report):
    """Weights found for a target, and how near the blended edges come to the target's."""

    weights: Weights
    rms_mm: float
    max_mm: float
    turned_degrees: float = 0.0  # what the target was turned by to come nearest
    scaled: float = 1.0  # and what it was scaled by

    def found(self, sources: Sequence[str]) -> str:
        """The weights, a region a line, and how near they come to the target."""
        # file names where all differ, else the paths
        names = [Path(path).name for path in sources]
        rows: list[list[object]] = [["found weights", *(names if len(set(names)) == len(names) else sources)]]
        for name, row in self.weights.regions.items():
            lock = self.weights.locked.get(name)
            rows.append([name, *(f"{one:.3f}" for one in row), *([f"locked to {lock}"] if lock else [])])
        rows.append(["default", *(f"{one:.3f}" for one in self.weights.default or ())])
        lines = [
            table(rows),
            f"edges differ from the target's by {self.rms_mm:.4f} mm RMS, {self.max_mm:.4f} mm at most",
        ]
        if self.turned_degrees > _TOLD or abs(self.scaled - 1.0) > _TOLD / 100.0:
            turned = f"turned by {self.turned_degrees:.1f} degrees and scaled by {self.scaled:.3f}"
            lines.append(f"the target was {turned} to come nearest: how it stands and its size don't count")
        return "\n".join(lines)


@one_thread()
def match(session: BlendSession, target: Face, locked: Mapping[str, int] | None = None) -> MatchReport:
    """The region weights, 0 or more and summing to 1, whose blend is nearest to `target`.

    A blend is linear in its weights, so the least squares over all edge vectors is a small convex problem. Parts that
    keep their shape are left out of it. Neither the place of the target nor its shapes matter, and where sources are
    aligned neither do its turn and size. The target is not aligned as the sources are: a blend stands in the first
    one's place already, and laid on it by landmarks its weights would be wrong by as much as its landmarks differ.

    :param target: a face of the sources' topology
    :param locked: region -> number of the source (from 1) that it stays with
    :raises TopologyError, InputError: another topology, or locks that don't fit
    """
    graph, count = session.graph, len(session.sources.points)
    (_, wanted) = stack([session.faces[0], target]).points  # as it lies
    edges = graph.edges[~np.isin(graph.edges, session.kept.points).any(axis=1)]
    responses = [edge_vectors(points, edges).ravel() for points in session.responses()]
    locked = locked or {}
    Weights(locked=locked).shares(graph.regions, count)  # checks them
    locks = {graph.regions.index(name): np.eye(count)[number - 1] for name, number in locked.items()}
    problem = _Problem(np.stack(responses, axis=1), len(graph.regions) + 1, count, locks)
    best = problem.solve(edge_vectors(wanted, edges))
    exact = _EXACT_MM / session.sources.mm_per_unit
    if session.options.align != UNALIGNED and best.rms > exact:
        best = problem.solve_turned(best)
    lengths = best.lengths * session.sources.mm_per_unit
    shares = [tuple(map(float, row)) for row in np.round(best.shares, 9)]  # last bits differ with the threads of BLAS
    named = dict(zip(graph.regions, shares[:-1], strict=True))
    return MatchReport(
        weights=Weights(regions=named, default=shares[-1], locked=dict(locked)),
        rms_mm=float(np.sqrt((lengths**2).mean())),
        max_mm=float(lengths.max(initial=0.0)),
        turned_degrees=float(np.degrees(Rotation.from_matrix(best.turn).magnitude())),
        scaled=best.scale,
    )


@dataclass(frozen=True, kw_only=True)
class _Fit:
    """Shares (regions + 1, K) for a goal that was turned and scaled."""

    shares: FloatArray
    goal: FloatArray  # (e, 3) edge vectors as they were compared
    off: FloatArray  # (e, 3) what the blended ones differ by
    turn: FloatArray  # (3, 3) what the target was turned by
    scale: float = 1.0

    @property
    def lengths(self) -> FloatArray:
        """(e,) of what edges differ by."""
        return np.asarray(np.linalg.norm(self.off, axis=1))

    @property
    def rms(self) -> float:
        """Of the lengths."""
        return float(np.sqrt((self.off**2).sum(axis=1).mean()))


class _Problem:
    """``|B a - g|^2`` over shares a of each region, of edge vectors g."""

    def __init__(self, basis: FloatArray, rows: int, count: int, locks: Mapping[int, FloatArray]) -> None:
        self._rows, self._count, self._locks = rows, count, locks
        # shares sum to 1 in each region: only what differs from its mean counts, and rounding is relative to that
        means = basis.reshape(len(basis), rows, count).mean(axis=2)
        self._basis, self._mean = basis - np.repeat(means, count, axis=1), means.sum(axis=1)

    def solve(self, goal: FloatArray) -> _Fit:
        """The shares for a goal (e, 3) as it lies."""
        return self._fit(goal, np.eye(3), 1.0)[0]

    def solve_turned(self, start: _Fit) -> _Fit:
        """The shares for what a similarity makes of a goal, and that similarity.

        Gauss-Newton: a small turn and a small change of size add four columns to the linear problem, which are
        projected out of it; so weights and similarity are found together, however alike their changes are.
        """
        whole = self._mean.reshape(-1, 3)
        # a vector and its negative: no place is fitted
        laid = fit_similarity(np.concatenate([start.goal, -start.goal]), np.concatenate([whole, -whole]))
        fit = self._fit(laid.scale * start.goal @ laid.rotation.T, laid.rotation, laid.scale)[0]
        best = fit if fit.rms < start.rms else start
        for _ in range(_STEPS):
            goal = best.goal
            turns = np.stack([np.cross(axis, goal).ravel() for axis in np.eye(3)], axis=1)
            step = self._fit(goal, best.turn, best.scale, np.column_stack([turns, goal.ravel()]))[1]
            turn, scale = Rotation.from_rotvec(step[:3]).as_matrix(), 1.0 + float(step[3])
            if not scale > 0:
                break
            moved = scale * goal @ turn.T
            fit = self._fit(moved, turn @ best.turn, scale * best.scale)[0]
            if not fit.rms < best.rms:
                break
            best = fit
            if np.abs(step).max() < _STILL:
                break
        return best

    def _fit(
        self, goal: FloatArray, turn: FloatArray, scale: float, moves: FloatArray | None = None
    ) -> tuple[_Fit, FloatArray]:
        """The shares for a goal that may also move along the columns (3e, m), and how far it does (m,)."""
        Q, R = np.linalg.qr(np.zeros((goal.size, 0)) if moves is None else moves)
        basis, wanted = self._basis, goal.ravel() - self._mean
        free = basis - Q @ (Q.T @ basis)
        fitted = fit_simplex(free.T @ free, free.T @ wanted, self._rows, self._count, locked=self._locks)
        off = basis @ fitted.weights.ravel() - wanted
        made = _Fit(shares=fitted.weights, goal=goal, off=off.reshape(-1, 3), turn=turn, scale=scale)
        return made, np.linalg.solve(R, Q.T @ off)
