"""Skin that a blend would bring into eyeballs, teeth, gums or the other lip is held out of them, as in the sources.

Sockets reach into eyeballs and cheeks into gums on many heads as they come. So nothing is pushed out altogether: a
point may lie as deep in what it touches as it does in the source that has it deepest, in the same pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.gradient_system import GradientSystem
from facepipe.geometry.local_push import Demands, least_push
from facepipe.geometry.polygons import point_normals, touching
from facepipe.verbs.blend.bodies import Body, LooseParts, Stand, Surface, Touching, find_bodies
from facepipe.verbs.blend.folds import Folds
from facepipe.verbs.blend.graph import Graph
from facepipe.verbs.blend.sources import Sources

LEAST_MM = 0.02  # what is less is left as it is
_REACH_MM = 14.0  # skin that gives way around what is pushed
_ROUNDS = 12  # of finding contacts and pushing at most; after 5 one triangle in 30 blends of 142 shapes was turned
# Of contacts, once triangles are turned back: at corners of mouths a place that moves by 0.02 mm may be 0.3 mm deep in
# flesh at once.
_LEFT_MM = 0.1
_STEPS = (1.0, -0.5, -0.25, -0.25)  # all of a push, a half, a quarter, or nothing


class Motion(NamedTuple):
    """A shape of the sources."""

    shape: str
    points: IntArray  # (u,) that move in some source
    offsets: FloatArray  # (K, u, 3)


@dataclass(frozen=True, kw_only=True)
class Touch:
    """Where skin in one pose lies in a body, at the point that goes furthest beyond the deepest source has it there.

    Where none goes beyond, it is the deepest point.
    """

    body: Body
    shape: str | None  # None: at rest
    point: int
    depth_mm: float
    sources_mm: tuple[float, ...]  # of the same point in the same pose

    @property
    def beyond_mm(self) -> float:
        """How much deeper it lies than in any source."""
        return self.depth_mm - max(self.sources_mm)


class Held(NamedTuple):
    """What is left in one pose."""

    touches: tuple[Touch, ...]  # one for each body that skin lies in
    turned: int  # triangles that face away from those of all sources


class Contacts:
    """All bodies of a blend, their surfaces in the sources, and the pushes that hold skin out of them."""

    def __init__(self, sources: Sources, graph: Graph, system: GradientSystem, loose: LooseParts) -> None:
        self._sources, self._graph, self._system = sources, graph, system
        self.bodies = find_bodies(sources, graph, loose)
        self._stands = [self.stand(points) for points in sources.points]
        hard = np.zeros(len(graph.component), bool)
        for body in self.bodies:
            hard[body.points if body.ball is None else body.ball] |= not body.soft
        goes = ~hard[graph.bridges.followers]
        self._followers, self._leaders = graph.bridges.followers[goes], graph.bridges.leaders[goes]

    def stand(self, points: FloatArray) -> Stand:
        """A face (n, 3) at rest."""
        return Stand(self.bodies, points, self._sources.mm_per_unit)

    def hold(
        self, stand: Stand, pose: FloatArray, moving: BoolArray, motion: Motion | None = None, *, push: bool = True
    ) -> Held:
        """Push skin out of bodies in `pose` (n, 3), in place, and turn triangles back that no source turns over.

        :param stand: the blend at rest
        :param moving: (n,) points that may be pushed; all others are as they are at rest
        :param motion: that of the sources; None: at rest
        :param push: False looks only
        """
        scene = _Scene(
            stand, pose, moving, self._stands, _Poses(self._sources.points, motion), self._sources.mm_per_unit
        )
        # at rest all is looked at; in a shape, what moves or is met by what moves
        meetings = [
            _Meeting(scene, body, skin, np.full((len(self._stands), len(skin)), np.nan))
            for body in self.bodies
            if len(skin := body.skin if motion is None or moving[body.points].any() else body.skin[moving[body.skin]])
        ]
        touched = self._graph.triangles.take(np.flatnonzero(touching(self._graph.triangles, moving)), axis=0)
        folds = Folds(pose, [scene.source_poses[k] for k in range(len(self._stands))], touched)
        eyes: list[list[_Meeting | Folds]] = [[one] for one in meetings if one.body.ball is not None]
        # teeth, gums and lips together, which meet the same skin
        mouth: list[_Meeting | Folds] = [one for one in meetings if one.body.ball is None]
        wrong: list[_Meeting | Folds] = [*meetings, folds]
        for one in wrong:
            one.look()
        for group in (*eyes, mouth, wrong) if push else ():
            self._settle(group, scene)
        for last in (False, False, True) if push else ():
            if not len(folds.turned):
                break
            self._settle([folds], scene)  # what is left goes before contacts: it takes them a few hundredths deeper
            for meeting in meetings:
                meeting.look()
            deepest = max((meeting.beyond.max(initial=0.0) for meeting in meetings), default=0.0)
            if last or deepest <= _LEFT_MM / scene.mm_per_unit:
                break
            self._settle(wrong, scene)
        name = None if motion is None else motion.shape
        return Held(tuple(one.touch(name) for one in meetings if len(one.beyond)), len(folds.turned))

    def _settle(self, group: Sequence[_Meeting | Folds], scene: _Scene) -> None:
        """Push skin until nothing of the group is wrong, or no push makes it better."""
        for _ in range(_ROUNDS):
            demands = [one.demands() for one in group]
            if not any(len(one.needs) for one in demands):
                break
            cost, pushes = sum(one.cost for one in group), self._pushes(demands, scene)
            for share in _STEPS:
                scene.pose[:] += share * pushes
                for one in group:
                    one.look()
                if sum(one.cost for one in group) < cost:
                    break
            else:
                break

    def _pushes(self, demands: Sequence[Demands], scene: _Scene) -> FloatArray:
        """(n, 3) of skin, and of lashes and brows, which follow it."""
        joined = Demands(*(np.concatenate(parts) for parts in zip(*demands, strict=True)))
        free = scene.moving & self._graph.main
        free[self._graph.anchor] = False
        pushes = least_push(self._system, scene.pose, free, joined, _REACH_MM / scene.mm_per_unit)
        follows = scene.moving[self._followers]
        pushes[self._followers[follows]] = pushes[self._leaders[follows]]
        return pushes


class _Poses:
    """The sources in one pose, made when they are asked for."""

    def __init__(self, points: FloatArray, motion: Motion | None) -> None:
        self._points, self._motion = points, motion
        self._made: dict[int, FloatArray] = {}

    def __getitem__(self, source: int) -> FloatArray:
        """(n, 3)"""
        if self._motion is None:
            return np.asarray(self._points[source])
        if source not in self._made:
            made = self._points[source].copy()
            made[self._motion.points] += self._motion.offsets[source]
            self._made[source] = made
        return self._made[source]


@dataclass(frozen=True)
class _Scene:
    """The blend and the sources in one pose."""

    stand: Stand
    pose: FloatArray  # (n, 3) of the blend, which is pushed
    moving: BoolArray  # (n,)
    source_stands: Sequence[Stand]
    source_poses: _Poses
    mm_per_unit: float


@dataclass(eq=False)
class _Meeting:
    """A body and the skin that is looked at, in one pose."""

    scene: _Scene
    body: Body
    skin: IntArray  # (s,)
    allowed: FloatArray  # (K, s) depth in each source, NaN where it was not looked for
    surface: Surface | None = None
    sources: list[Surface] = field(default_factory=list)
    found: Touching = field(init=False)
    beyond: FloatArray = field(init=False)  # (m,) of what was found

    def look(self) -> None:
        """Find where the skin lies in the body, and how much deeper than in any source."""
        scene, body = self.scene, self.body
        if self.surface is None or body.soft:  # what is hard stays where it is when skin is pushed
            self.surface = scene.stand.surface(body, scene.pose, scene.moving)
        every = np.arange(len(self.skin))
        self.found = self.surface.touching(scene.pose[self.skin], self._normals(scene.pose, every))
        rows = self.found.rows[np.isnan(self.allowed[0, self.found.rows])]
        if len(rows) and not self.sources:
            stands = enumerate(scene.source_stands)
            self.sources = [own.surface(body, scene.source_poses[k], scene.moving) for k, own in stands]
        for k, surface in enumerate(self.sources if len(rows) else ()):
            pose = scene.source_poses[k]
            self.allowed[k, rows] = surface.depths(pose[self.skin[rows]], self._normals(pose, rows))
        self.beyond = self.found.depths - self.allowed[:, self.found.rows].max(axis=0)

    def _normals(self, pose: FloatArray, rows: IntArray) -> FloatArray | None:
        """(m, 3) of the skin at `rows` (m,), where the body is a lip."""
        if self.body.facing is None:
            return None
        normals = point_normals(pose[self.body.skin], self.body.facing)
        return np.asarray(normals[np.searchsorted(self.body.skin, self.skin[rows])])

    @property
    def cost(self) -> float:
        """The sum of squares of what lies deeper than in any source."""
        return float((np.maximum(self.beyond, 0.0) ** 2).sum())

    def demands(self) -> Demands:
        """That skin goes the way out, or the other lip the other way."""
        deep = self.beyond > LEAST_MM / self.scene.mm_per_unit
        out = self.found.out[deep]
        points = np.stack([self.skin[self.found.rows[deep]], self.found.leaders[deep]], axis=1)
        none = np.full(len(points), -1)
        ways = np.stack([out, -out, np.zeros_like(out)], axis=1)
        return Demands(np.column_stack([points, none]), ways, self.beyond[deep])

    def touch(self, shape: str | None) -> Touch:
        """The worst of what was found."""
        worst = int(self.beyond.argmax() if self.beyond.max() > 0 else self.found.depths.argmax())
        row, mm = self.found.rows[worst], self.scene.mm_per_unit
        return Touch(
            body=self.body,
            shape=shape,
            point=int(self.skin[row]),
            depth_mm=float(self.found.depths[worst]) * mm,
            sources_mm=tuple(float(depth) * mm for depth in self.allowed[:, row]),
        )
