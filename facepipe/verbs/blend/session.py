"""A live blend: sources read and systems factored once, then solved for any weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.threads import one_thread
from facepipe.declare import check_ranges
from facepipe.geometry.differences import edge_vectors
from facepipe.geometry.gradient_system import GradientSystem, MovingSystem
from facepipe.geometry.vectors import group_sums
from facepipe.stage import Face
from facepipe.verbs.blend.graph import Graph, Shared, anchor_named, build_graph, joint_worlds, mean_of_ends, mix
from facepipe.verbs.blend.kept_parts import KeptParts, kept_parts
from facepipe.verbs.blend.options import BlendOptions
from facepipe.verbs.blend.sculpts import Sculpt, pair_sculpts
from facepipe.verbs.blend.sources import stack
from facepipe.verbs.blend.weights import Weights


@dataclass(frozen=True, kw_only=True)
class Neutral(Shared):
    """A solved neutral."""

    table: FloatArray  # (regions + 1, K) normalised shares; the last row: in no region
    wanted: FloatArray  # (e, 3) blended edge vectors D
    joint_shares: FloatArray  # (j, K)
    joints: FloatArray  # (j, 3)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Solution:
    """A solved blend: the neutral and the offsets (u, 3) of every sculpt's points."""

    neutral: Neutral
    offsets: tuple[FloatArray, ...]
    sculpts: tuple[Sculpt, ...] = field(repr=False)


class BlendSession:
    """Sources and factors of one blend.

    What costs (reading, pairing, factoring) is done once, each shape's factor when it is first asked for; another call
    with other weights costs back-substitution only.

    :param faces: the sources; the first is the base
    :param live: keep every shape's factor for the next solve; otherwise memory stays that of one
    :raises InputError, TopologyError: sources or options that can't be blended
    """

    @one_thread()
    def __init__(self, faces: Sequence[Face], options: BlendOptions | None = None, *, live: bool = True) -> None:
        self.live = live
        self.options = options or BlendOptions()
        check_ranges(self.options)
        self.faces = tuple(faces)
        self.sources = stack(faces)
        anchor = anchor_named(self.sources, self.options.anchor)
        self.graph = build_graph(self.sources, self.options.edges, self.options.region_width_mm, anchor)
        graph = self.graph
        self.kept = kept_parts(self.sources, graph, self.options.keep_shape)
        paired = pair_sculpts(self.sources, graph.triangles, self.options.missing, self.options.static_mm)
        self.sculpts, self.skipped, self.transferred = paired.sculpts, paired.skipped, paired.transferred
        self.system = GradientSystem(
            graph.edges, graph.edge_weights, graph.main, graph.bridges, graph.anchor, self.options.solver
        )
        self.joint_worlds = joint_worlds(self.sources)
        self.edge_vectors = edge_vectors(self.sources.points, graph.edges)
        followers, leaders = graph.bridges.followers, graph.bridges.leaders
        self.bridge_vectors = self.sources.points[:, followers] - self.sources.points[:, leaders]
        # shares are linear in masks: one product with a table of weights then makes those of all edges
        self._edge_masks = mean_of_ends(graph.masks.T, graph.edges[:, 0], graph.edges[:, 1])  # (e, regions + 1)
        held = self.options.expressions == "static"
        self._expressions = [
            Expression(sculpt, graph, self.system, self.kept, hold_static=held) for sculpt in self.sculpts
        ]

    def neutral(self, weights: Weights) -> Neutral:
        """The blended neutral: ``M^T W M x = M^T W D`` (the document's S605), then the parts that keep their shape.

        :raises InputError: weights that don't fit the sources or regions
        """
        graph = self.graph
        table, notes = weights.shares(graph.regions, len(self.sources.points))
        shares = graph.point_shares(table)
        along_edges = self._edge_masks @ table
        along_bridges = mean_of_ends(shares, graph.bridges.followers, graph.bridges.leaders)
        wanted = mix(along_edges, self.edge_vectors)
        bridged = mix(along_bridges, self.bridge_vectors)
        points = self.system.solve(wanted, bridged, self.sources.points[0, graph.anchor])
        # after the solve, which bends loose parts as it does skin: their blended shape is laid on what it made of them
        points[self.kept.points] = self.kept.fit(points, shares)
        joint_shares, joints = self._joints(points, shares)
        return Neutral(
            table=table,
            shares=shares,
            edge_shares=along_edges,
            wanted=wanted,
            points=points,
            joint_shares=joint_shares,
            joints=joints,
            notes=notes,
        )

    def solve(self, weights: Weights, done: Callable[[], object] = lambda: None) -> Solution:
        """The neutral and all shapes.

        :param done: called after every sculpt
        """
        neutral, offsets = self.neutral(weights), []
        for expression in self._expressions:
            offsets.append(expression.solve(neutral))
            if not self.live:
                expression.release()
            done()
        return Solution(neutral=neutral, offsets=tuple(offsets), sculpts=self.sculpts)

    def expression(self, number: int) -> Expression:
        """The solve of one sculpt."""
        return self._expressions[number]

    def _joints(self, points: FloatArray, shares: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Shares (j, K) and places (j, 3) of the joints: weighted means over their bridges."""
        bridges, places = self.graph.joint_bridges, self.joint_worlds[:, :, :3, 3]
        joint, point, count = bridges.followers, bridges.leaders, places.shape[1]
        total = np.bincount(joint, bridges.weights, minlength=count)[:, None]
        joint_shares = group_sums(joint, shares[point] * bridges.weights[:, None], count) / total
        vectors = mix(0.5 * (joint_shares[joint] + shares[point]), places[:, joint] - self.sources.points[:, point])
        return joint_shares, group_sums(joint, (points[point] + vectors) * bridges.weights[:, None], count) / total


class Expression:
    """A sculpt solved for any weights; what that takes is factored at the first solve, and kept until `release`.

    An expression's edge vectors are the neutral's plus those of its offsets, and the solve is linear: so only the
    offsets are solved for, and they vanish where nothing moves.

    :param hold_static: points that move in no source are held at 0 inside the bi-Laplacian solve; otherwise, as in the
        document (S605', S606'), all points are solved and static ones put back after it
    """

    def __init__(
        self, sculpt: Sculpt, graph: Graph, system: GradientSystem, kept: KeptParts, *, hold_static: bool
    ) -> None:
        self.sculpt, self._graph, self._system, self._kept = sculpt, graph, system, kept
        self._moving = np.zeros(len(graph.component), dtype=bool)
        self._moving[sculpt.points] = True
        self._hold_static = hold_static
        self._rigid = kept.rigid_in(sculpt, self._moving)
        self._prepared: _Prepared | None = None

    def solve(self, shared: Shared) -> FloatArray:
        """(u, 3) offsets of the sculpt's points."""
        if self._prepared is None:
            self._prepared = self._prepare()
        prepared, graph, points = self._prepared, self._graph, self.sculpt.points
        bridges = graph.bridges
        along = shared.between(bridges.leaders[prepared.bridges], bridges.followers[prepared.bridges])
        wanted = mix(shared.edge_shares[prepared.edges], prepared.edge_vectors)
        bridged, anchored = mix(along, prepared.bridge_vectors), self._anchored(shared.shares)
        offsets = np.zeros((len(self._moving), 3))
        if prepared.held:
            offsets[prepared.held.points] = prepared.held.solve(wanted, bridged, anchored)
            if prepared.held.pinned:
                offsets[graph.anchor] = anchored
        else:
            # the document's way (S605', S606'): solved freely, then cut off, which may leave a step where motion ends
            everywhere = np.zeros((len(graph.edges), 3))
            everywhere[prepared.edges] = wanted
            offsets[points] = self._system.solve(everywhere, bridged, anchored)[points]
        self._kept.fit_moved(shared.points, offsets, self._rigid, self._moving)
        return offsets[points]

    def release(self) -> None:
        """Give the memory of the factor back; the next solve factors again."""
        self._prepared = None

    def asked(self, shared: Shared) -> tuple[IntArray, FloatArray]:
        """Edges (q,) at moving points, and the blended vectors (q, 3) of the offsets that are asked of them."""
        touching = np.flatnonzero(self._moving[self._graph.edges].any(axis=1))
        ends = self._graph.edges[touching]
        return touching, mix(shared.edge_shares[touching], self._vectors(ends[:, 0], ends[:, 1]))

    def _prepare(self) -> _Prepared:
        graph, bridges = self._graph, self._graph.bridges
        held = self._system.moving(self._moving) if self._hold_static else None
        edges = held.edges if held else np.flatnonzero(self._moving[graph.edges].any(axis=1))
        across = held.bridges if held else np.arange(len(bridges.followers))
        ends = graph.edges[edges]
        return _Prepared(
            held=held,
            edges=edges,
            bridges=across,
            edge_vectors=self._vectors(ends[:, 0], ends[:, 1]),
            bridge_vectors=self._vectors(bridges.leaders[across], bridges.followers[across]),
        )

    def _anchored(self, shares: FloatArray) -> FloatArray:
        anchor = self._graph.anchor
        if not self._moving[anchor]:
            return np.zeros(3)
        offsets = self.sculpt.offsets[:, np.searchsorted(self.sculpt.points, anchor)]
        return np.asarray(shares[anchor] @ offsets)

    def _vectors(self, start: IntArray, end: IntArray) -> FloatArray:
        """(K, q, 3) vectors of the sources' offsets from points to points."""
        place = np.full(len(self._moving), len(self.sculpt.points))  # static points: a row of zeros at the end
        place[self.sculpt.points] = np.arange(len(self.sculpt.points))
        padded = np.concatenate([self.sculpt.offsets, np.zeros((len(self.sculpt.offsets), 1, 3))], axis=1)
        return np.asarray(padded[:, place[end]] - padded[:, place[start]])


@dataclass(frozen=True)
class _Prepared:
    """The factor of one sculpt, and its right-hand sides before they are mixed."""

    held: MovingSystem | None  # None: the neutral's own system is solved
    edges: IntArray  # (q,)
    bridges: IntArray  # (b,)
    edge_vectors: FloatArray  # (K, q, 3) of offsets
    bridge_vectors: FloatArray  # (K, b, 3)
