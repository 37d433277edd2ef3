"""A live blend: sources read and systems factored once, then solved for any weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.declare import check_ranges
from facepipe.geometry.differences import edge_vectors
from facepipe.geometry.gradient_system import GradientSystem
from facepipe.geometry.grouping import group_sums
from facepipe.processors.blend.anchors import anchor_named
from facepipe.processors.blend.expressions import Expression
from facepipe.processors.blend.kept_parts import kept_parts
from facepipe.processors.blend.mixing import Shared, mean_of_ends, mix
from facepipe.processors.blend.network import joint_worlds, network
from facepipe.processors.blend.options import BlendOptions
from facepipe.processors.blend.sculpts import Sculpt, pair_sculpts
from facepipe.processors.blend.sources import stack
from facepipe.processors.blend.weights import Weights
from facepipe.stage import Face


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

    def __init__(self, faces: Sequence[Face], options: BlendOptions | None = None, *, live: bool = True) -> None:
        self.live = live
        self.options = options or BlendOptions()
        check_ranges(self.options)
        self.faces = tuple(faces)
        self.sources = stack(faces)
        anchor = anchor_named(self.sources, self.options.anchor)
        self.network = network(self.sources, self.options.edges, self.options.region_width_mm, anchor)
        net = self.network
        self.kept = kept_parts(self.sources, net, self.options.keep_shape)
        paired = pair_sculpts(self.sources, net.triangles, self.options.missing, self.options.static_mm)
        self.sculpts, self.skipped, self.transferred = paired.sculpts, paired.skipped, paired.transferred
        self.system = GradientSystem(
            net.edges, net.edge_weights, net.main, net.bridges, net.anchor, self.options.solver
        )
        self.joint_worlds = joint_worlds(self.sources)
        self.edge_vectors = edge_vectors(self.sources.points, net.edges)
        followers, leaders = net.bridges.followers, net.bridges.leaders
        self.bridge_vectors = self.sources.points[:, followers] - self.sources.points[:, leaders]
        self._edge_masks = mean_of_ends(net.masks.T, net.edges[:, 0], net.edges[:, 1])  # (e, regions + 1)
        held = self.options.expressions == "static"
        self._expressions = [Expression(one, net, self.system, self.kept, hold_static=held) for one in self.sculpts]

    def neutral(self, weights: Weights) -> Neutral:
        """The blended neutral: ``M^T W M x = M^T W D`` (the document's S605), then the parts that keep their shape.

        :raises InputError: weights that don't fit the sources or regions
        """
        net = self.network
        table, notes = weights.shares(net.regions, len(self.sources.points))
        shares = net.point_shares(table)
        along_edges = self._edge_masks @ table
        along_bridges = mean_of_ends(shares, net.bridges.followers, net.bridges.leaders)
        wanted = mix(along_edges, self.edge_vectors)
        bridged = mix(along_bridges, self.bridge_vectors)
        points = self.system.solve(wanted, bridged, self.sources.points[0, net.anchor])
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
        bridges, places = self.network.joint_bridges, self.joint_worlds[:, :, :3, 3]
        joint, point, count = bridges.followers, bridges.leaders, places.shape[1]
        total = np.bincount(joint, bridges.weights, minlength=count)[:, None]
        own = group_sums(joint, shares[point] * bridges.weights[:, None], count) / total
        vectors = mix(0.5 * (own[joint] + shares[point]), places[:, joint] - self.sources.points[:, point])
        return own, group_sums(joint, (points[point] + vectors) * bridges.weights[:, None], count) / total
