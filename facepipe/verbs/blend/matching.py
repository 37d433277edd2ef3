"""Weights that best explain a target: the document's adjusting step (claim 10), turned round."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.reports import Report
from facepipe.core.threads import one_thread
from facepipe.geometry.differences import edge_vectors
from facepipe.geometry.simplex_fit import fit_simplex
from facepipe.stage import Face
from facepipe.verbs.blend.graph import mean_of_ends
from facepipe.verbs.blend.session import BlendSession
from facepipe.verbs.blend.sources import stack
from facepipe.verbs.blend.weights import Weights


@dataclass(frozen=True, kw_only=True)
class MatchReport(Report):
    """Weights found for a target, and how near the blended edges come to the target's."""

    weights: Weights
    rms_mm: float
    max_mm: float


@one_thread()
def match(session: BlendSession, target: Face, locked: Mapping[str, int] | None = None) -> MatchReport:
    """The region weights, 0 or more and summing to 1, whose blend is nearest to `target`.

    A blend is linear in its weights, so the least squares over all edge vectors is a small convex problem. Parts that
    keep their shape are left out of it. Neither the place of the target nor its shapes matter.

    :param target: a face of the sources' topology
    :param locked: region -> number of the source (from 1) that it stays with
    :raises TopologyError, InputError: another topology, or locks that don't fit
    """
    graph, count = session.graph, len(session.sources.points)
    (_, wanted) = stack([session.faces[0], target]).points
    edges = graph.edges[~np.isin(graph.edges, session.kept.points).any(axis=1)]
    goal = edge_vectors(wanted, edges).ravel()
    basis = np.stack([edge_vectors(points, edges).ravel() for points in _responses(session)], axis=1)
    rows = len(graph.regions) + 1
    locks = {graph.regions.index(name): np.eye(count)[number - 1] for name, number in _checked(session, locked).items()}
    # shares sum to 1 in each region: only what differs from its mean counts, and rounding is relative to that
    means = np.repeat(basis.reshape(len(basis), rows, count).mean(axis=2), count, axis=1)
    basis, goal = basis - means, goal - means.sum(axis=1) / count
    fitted = fit_simplex(basis.T @ basis, basis.T @ goal, rows, count, locked=locks)
    off = np.linalg.norm((basis @ fitted.weights.ravel() - goal).reshape(-1, 3), axis=1) * session.sources.mm_per_unit
    table = [tuple(map(float, row)) for row in np.round(fitted.weights, 9)]  # last bits differ with the threads of BLAS
    weights = Weights(
        regions=dict(zip(graph.regions, table[:-1], strict=True)), default=table[-1], locked=dict(locked or {})
    )
    return MatchReport(weights=weights, rms_mm=float(np.sqrt((off**2).mean())), max_mm=float(off.max(initial=0.0)))


def _responses(session: BlendSession) -> list[FloatArray]:
    """(n, 3) points that each region's whole weight on each source gives, region by region, with the anchor at 0."""
    graph, responses = session.graph, []
    bridges = graph.bridges
    for mask in graph.masks:
        along = mean_of_ends(mask[:, None], graph.edges[:, 0], graph.edges[:, 1])
        across = mean_of_ends(mask[:, None], bridges.followers, bridges.leaders)
        for edge, bridge in zip(session.edge_vectors, session.bridge_vectors, strict=True):
            responses.append(session.system.solve(along * edge, across * bridge, np.zeros(3)))
    return responses


def _checked(session: BlendSession, locked: Mapping[str, int] | None) -> Mapping[str, int]:
    Weights(locked=locked or {}).shares(session.graph.regions, len(session.sources.points))
    return locked or {}
