"""A live blend: sources with sculpts and kept parts read and factored once, then solved for any weights."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.names import select, unique_identifiers
from facepipe.core.threads import one_thread
from facepipe.declare import check_ranges
from facepipe.geometry.deformation_transfer import Transfer
from facepipe.geometry.gradient_system import GradientSystem, MovingSystem, edge_vectors
from facepipe.geometry.polygons import touching
from facepipe.geometry.similarity import fit_similarities
from facepipe.geometry.vectors import group_sums
from facepipe.parts import Blendshape
from facepipe.rig import mesh_spaces
from facepipe.rig.rig import curves
from facepipe.stage import Face
from facepipe.verbs.blend.bodies import LooseParts
from facepipe.verbs.blend.contacts import Contacts, Held, Motion
from facepipe.verbs.blend.graph import Graph, Shared, anchor_named, build_graph, joint_worlds, mean_of_ends, mix
from facepipe.verbs.blend.options import BlendOptions, Missing
from facepipe.verbs.blend.sources import Sources, stack
from facepipe.verbs.blend.weights import Weights

_RIGID = 0.02  # of a part's motion: what a similarity may leave of it; of real jaws on scaled teeth it leaves 0.005
_AXIS = 0.02  # of a part's points: as many may lie still, on the axis that it turns about
CONCENTRIC = 0.25  # components whose centres lie this close, in radii of the larger, are one part: iris, lens and ball


@dataclass(frozen=True)
class Sculpt:
    """One shape at one weight: itself (1) or an inbetween."""

    shape: str
    weight: float
    inbetween: str | None  # name of the inbetween; None: the shape itself
    points: IntArray  # (u,) points that move in some source, ascending
    offsets: FloatArray  # (K, u, 3) in the base's bind space

    @property
    def name(self) -> str:
        """The shape's name, for an inbetween with its weight: ``jawOpen@0.5``."""
        return self.shape if self.inbetween is None else f"{self.shape}@{self.weight:g}"


@dataclass(frozen=True)
class Sculpts:
    """All sculpts of a blend, and the shapes that came from fewer sources or went."""

    sculpts: tuple[Sculpt, ...]
    skipped: tuple[str, ...]
    transferred: tuple[tuple[str, str], ...]  # (shape, source that lacked it)


def pair_sculpts(
    sources: Sources, triangles: IntArray, missing: Missing, threshold_mm: float, motion: int | None = None
) -> Sculpts:
    """Pair the shapes of all sources by name; inbetweens by weight.

    A source without some inbetween of a shape gives the point that its own shape passes at that weight.

    :param threshold_mm: a point that moves no further in any source is static
    :param motion: number of the source whose offsets all have; shapes that neither it nor the base has are left out
    :raises InputError: a shape that some source lacks, or that of `motion` does, where `missing` is ``error``
    """
    shapes = tuple(dict.fromkeys(name for own in sources.shapes for name in own))
    lacking = {shape: [k for k, own in enumerate(sources.shapes) if shape not in own] for shape in shapes}
    lost = {shape: lack for shape, lack in lacking.items() if (lack if motion is None else motion in lack)}
    foreign = [] if motion is None else [shape for shape in lost if shape not in sources.shapes[0]]
    wanted = [shape for shape in lost if shape not in foreign]
    if wanted and missing == "error":
        where = sources.names[lost[wanted[0]][0] if motion is None else motion]
        more = f" (and {len(wanted) - 1} more shapes)" if len(wanted) > 1 else ""
        what = f"no shape '{wanted[0]}', which other sources have{more}; expected it too (or --missing transfer|skip)"
        raise InputError(where, what)
    sculpts, skipped, transferred = [], [], []
    transfer = _Transfers(sources, triangles)
    # by name the blendshapes of every source, each with the first point of its mesh and what turns its offsets
    named: list[dict[str, list[tuple[Blendshape, int, FloatArray]]]] = [{} for _ in sources.parts]
    for k, parts in enumerate(sources.parts):
        for mesh, start, space in zip(parts.meshes, sources.mesh_offsets[:-1], mesh_spaces(parts), strict=True):
            linear = sources.to_base[k, :3, :3] @ space[:3, :3]
            for blendshape in mesh.blendshapes:
                named[k].setdefault(blendshape.name, []).append((blendshape, int(start), linear))
    for shape in shapes:
        lack = lacking[shape]
        if shape in foreign or (shape in lost and missing == "skip"):
            skipped.append(shape)
            continue
        counted = slice(None) if motion is None or shape in lost else slice(motion, motion + 1)
        transferred += [(shape, sources.names[k]) for k in lack if shape in lost and motion in (None, k)]
        for weight, name in _weights([one for own in named[counted] for one, _, _ in own.get(shape, ())]):
            # (K, n, 3) offsets at a weight of the shape; 0 in sources without it
            offsets = np.zeros(sources.points.shape)
            for k, own in enumerate(named):
                for blendshape, first, turn in own.get(shape, ()):
                    offsets[k, first + blendshape.point_indices] = _at(blendshape, weight) @ turn.T
            # in any source, whatever its weight: the moving points, and so the factor, are the same for all weights
            squares = np.einsum("kni,kni->kn", offsets[counted], offsets[counted])
            points = np.flatnonzero((np.sqrt(squares) * sources.mm_per_unit > threshold_mm).any(axis=0))
            if shape in lost:
                transfer.fill(offsets, points, lack)
            taken = offsets if motion is None else offsets[[motion] * len(offsets)]
            sculpts.append(Sculpt(shape, weight, name, points, taken.take(points, axis=1)))
    return Sculpts(tuple(sculpts), tuple(skipped), tuple(transferred))


def _weights(blendshapes: Sequence[Blendshape]) -> list[tuple[float, str | None]]:
    """Every weight that some of a shape has a sculpt at, with its name in the first that has it; names are unique."""
    named: dict[float, str] = {}
    for inbetween in (one for blendshape in blendshapes for one in blendshape.inbetweens):
        named.setdefault(float(inbetween.weight), inbetween.name)
    ordered = sorted(named.items())
    names = unique_identifiers(name for _, name in ordered)
    return [(1.0, None), *((weight, name) for (weight, _), name in zip(ordered, names, strict=True))]


def _at(shape: Blendshape, weight: float) -> FloatArray:
    """(k, 3) offsets of the shape set to `weight`."""
    offsets = {float(inbetween.weight): inbetween.offsets for inbetween in shape.inbetweens} | {1.0: shape.offsets}
    activations = curves(tuple(float(inbetween.weight) for inbetween in shape.inbetweens))
    parts = [float(curve(weight)) * np.asarray(offsets[at], dtype=np.float64) for at, curve in activations.items()]
    return np.asarray(sum(parts))


class _Transfers:
    """Deformation transfer onto the sources that lack a shape."""

    def __init__(self, sources: Sources, triangles: IntArray) -> None:
        self._sources, self._triangles = sources, triangles

    def fill(self, offsets: FloatArray, points: IntArray, lack: Sequence[int]) -> None:
        """Put transferred offsets into the rows `lack` of (K, n, 3) `offsets`; only `points` may move."""
        neutrals = self._sources.points
        has = [k for k in range(len(neutrals)) if k not in lack]
        fixed = np.ones(neutrals.shape[1], dtype=bool)
        fixed[points] = False
        for k in lack:
            transfer = Transfer(neutrals[k], self._triangles, fixed)
            deformed = transfer.solve(neutrals[has], neutrals[has] + offsets[has])
            offsets[k] = deformed - neutrals[k]


@dataclass(frozen=True)
class KeptParts:
    """Loose parts in the sources, and their shapes: each moved onto the base's by a similarity."""

    points: IntArray  # (p,) into all points
    part: IntArray  # (p,) number of the part, from 0
    neutrals: FloatArray  # (K, p, 3) as those have them whose shapes move them
    shapes: FloatArray  # (K, p, 3) moved onto the base's

    def fit(self, solved: FloatArray, shares: FloatArray) -> FloatArray:
        """(p, 3) the parts' mean shape under their shares, moved by similarities nearest to the solved points.

        :param solved: (n, 3) all points
        :param shares: (n, K) of all points
        """
        if not len(self.points):
            return np.zeros((0, 3))
        counts = np.bincount(self.part)
        part_shares = group_sums(self.part, shares[self.points], len(counts)) / counts[:, None]
        shape = mix(part_shares[self.part], self.shapes)
        return fit_similarities(shape, solved[self.points], self.part).apply(shape, self.part)

    def rigid_in(self, sculpt: Sculpt, moving: BoolArray) -> BoolArray:
        """(p,) points of the parts that move by similarities in all sources, all but a few points on an axis."""
        if not len(self.points):
            return np.zeros(0, dtype=bool)
        still = np.bincount(self.part, ~moving[self.points])
        chosen = np.asarray((still <= _AXIS * np.bincount(self.part))[self.part])
        points, number = self.points[chosen], self.part[chosen]
        if not len(points):
            return chosen
        rigid = np.ones(int(number.max()) + 1, dtype=bool)
        for start, sculpted in zip(self.neutrals[:, chosen], sculpt.offsets, strict=True):
            offsets = np.zeros((len(moving), 3))
            offsets[sculpt.points] = sculpted
            motion = offsets[points]
            off = fit_similarities(start, start + motion, number).apply(start, number) - start - motion
            left, whole = (np.bincount(number, (vectors**2).sum(axis=1)) for vectors in (off, motion))
            rigid &= left <= _RIGID**2 * whole
        chosen[chosen] = rigid[number]
        return chosen

    def fit_moved(
        self,
        neutral: FloatArray,
        offsets: FloatArray,
        rigid: BoolArray,
        moving: BoolArray,
    ) -> None:
        """Replace, in `offsets` (n, 3), those of the parts that are `rigid_in` a sculpt by the nearest similarity's.

        Static points stay so.
        """
        if not rigid.any():
            return
        points, number = self.points[rigid], np.unique(self.part[rigid], return_inverse=True)[1].ravel()
        start = neutral[points]
        fitted = fit_similarities(start, start + offsets[points], number).apply(start, number) - start
        offsets[points] = np.where(moving[points][:, None], fitted, 0.0)


def kept_parts(sources: Sources, graph: Graph, globs: str, motion: int | None = None) -> KeptParts:
    """The loose parts of the meshes whose names `globs` match.

    :param motion: number of the source whose shapes all have
    :raises InputError: a glob that matches no mesh
    """
    names = tuple(mesh.name for mesh in sources.base.meshes)
    chosen = _default(names) if globs == "auto" else select(names, globs, "keep_shape")
    ranges = dict(zip(names, zip(sources.mesh_offsets[:-1], sources.mesh_offsets[1:], strict=True), strict=True))
    points = np.concatenate([np.zeros(0, np.int64), *(np.arange(*ranges[name]) for name in chosen)])
    points = points[~graph.main[points]]
    mesh = np.searchsorted(sources.mesh_offsets, points, side="right")
    part = _merge_concentric(sources.points[0, points], graph.component[points], mesh)
    if not len(points):
        nothing = np.zeros((len(sources.points), 0, 3))
        return KeptParts(points, part, nothing, nothing)
    base = sources.points[0, points]
    aligned = [fit_similarities(source[points], base, part).apply(source[points], part) for source in sources.points]
    moved = sources.points if motion is None else sources.points[[motion] * len(aligned)]
    return KeptParts(points, part, moved[:, points], np.stack(aligned))


def _default(names: tuple[str, ...]) -> tuple[str, ...]:
    """Meshes that are eyeballs or teeth by their names."""
    words = ("eyeball", "teeth", "tooth")
    return tuple(
        name for name in names if any(word in name.lower() for word in words) or name in ("EyeLeft", "EyeRight")
    )


def _merge_concentric(points: FloatArray, component: IntArray, mesh: IntArray) -> IntArray:
    """(p,) part numbers from 0: the components, those about one centre in one mesh as one."""
    numbers, first, place = np.unique(component, return_index=True, return_inverse=True)
    place = place.ravel()
    counts = np.bincount(place, minlength=len(numbers))
    centres = group_sums(place, points, len(numbers)) / np.maximum(counts, 1)[:, None]
    radii = np.zeros(len(numbers))
    np.maximum.at(radii, place, np.linalg.norm(points - centres[place], axis=1))
    owner = np.arange(len(numbers))
    for number in np.argsort(-radii, kind="stable"):
        if owner[number] == number:
            near = np.linalg.norm(centres - centres[number], axis=1) <= CONCENTRIC * radii[number]
            near &= (mesh[first] == mesh[first[number]]) & (owner == np.arange(len(numbers))) & (radii <= radii[number])
            owner[near] = number
    return np.unique(owner[place], return_inverse=True)[1].ravel()


@dataclass(frozen=True, kw_only=True)
class Neutral(Shared):
    """A solved neutral."""

    table: FloatArray  # (regions + 1, K) normalised shares; the last row: in no region
    wanted: FloatArray  # (e, 3) blended edge vectors D
    joint_shares: FloatArray  # (j, K)
    joints: FloatArray  # (j, 3)
    held: Held  # contacts that are left
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Solution:
    """A solved blend: the neutral and the offsets (u, 3) of every sculpt's points."""

    neutral: Neutral
    offsets: tuple[FloatArray, ...]
    held: tuple[Held, ...]  # contacts that are left in every sculpt
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
        self.sources = stack(faces, self.options.align)
        anchor = anchor_named(self.sources, self.options.anchor)
        self.graph = build_graph(self.sources, self.options.edges, self.options.region_width_mm, anchor)
        graph = self.graph
        motion = self.options.motion_of
        if motion is not None:
            if motion > len(faces):
                what = f"source {motion}, expected the number of one, from 1 to {len(faces)}"
                raise InputError("option motion_of", what)
            motion -= 1
        self.kept = kept_parts(self.sources, graph, self.options.keep_shape, motion)
        paired = pair_sculpts(self.sources, graph.triangles, self.options.missing, self.options.static_mm, motion)
        self.sculpts, self.skipped, self.transferred = paired.sculpts, paired.skipped, paired.transferred
        self.system = GradientSystem(
            graph.edges, graph.edge_weights, graph.main, graph.bridges, graph.anchor, self.options.solver
        )
        self.contacts = Contacts(self.sources, graph, self.system, LooseParts(self.kept.points, self.kept.part))
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
        every = np.ones(len(points), bool)
        held = self.contacts.hold(self.contacts.stand(points), points, every, push=self.options.contacts)
        # shares (j, K) and places (j, 3) of the joints: weighted means over their bridges
        bridges, places = self.graph.joint_bridges, self.joint_worlds[:, :, :3, 3]
        joint, point, count = bridges.followers, bridges.leaders, places.shape[1]
        total = np.bincount(joint, bridges.weights, minlength=count)[:, None]
        joint_shares = group_sums(joint, shares[point] * bridges.weights[:, None], count) / total
        vectors = mix(0.5 * (joint_shares[joint] + shares[point]), places[:, joint] - self.sources.points[:, point])
        joints = group_sums(joint, (points[point] + vectors) * bridges.weights[:, None], count) / total
        return Neutral(
            table=table,
            shares=shares,
            edge_shares=along_edges,
            wanted=wanted,
            points=points,
            joint_shares=joint_shares,
            joints=joints,
            held=held,
            notes=notes,
        )

    def responses(self) -> Iterator[FloatArray]:
        """(n, 3) points that each region's whole weight on each source gives, region by region, the anchor at 0."""
        bridges = self.graph.bridges
        for mask in self.graph.masks:
            along = mean_of_ends(mask[:, None], self.graph.edges[:, 0], self.graph.edges[:, 1])
            across = mean_of_ends(mask[:, None], bridges.followers, bridges.leaders)
            for edge, bridge in zip(self.edge_vectors, self.bridge_vectors, strict=True):
                yield self.system.solve(along * edge, across * bridge, np.zeros(3))

    def solve(self, weights: Weights, done: Callable[[], object] = lambda: None) -> Solution:
        """The neutral and all shapes.

        :param done: called after every sculpt
        """
        neutral, offsets = self.neutral(weights), []
        stand, held = self.contacts.stand(neutral.points), list[Held]()
        for sculpt, expression in zip(self.sculpts, self._expressions, strict=True):
            pose, moving = neutral.points.copy(), np.zeros(len(neutral.points), bool)
            pose[sculpt.points] += expression.solve(neutral)
            moving[sculpt.points] = True
            motion = Motion(sculpt.name, sculpt.points, sculpt.offsets)
            held.append(self.contacts.hold(stand, pose, moving, motion, push=self.options.contacts))
            offsets.append(pose[sculpt.points] - neutral.points[sculpt.points])
            if not self.live:
                expression.release()
            done()
        return Solution(neutral=neutral, offsets=tuple(offsets), held=tuple(held), sculpts=self.sculpts)

    def expression(self, number: int) -> Expression:
        """The solve of one sculpt."""
        return self._expressions[number]


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
        graph, bridges, points = self._graph, self._graph.bridges, self.sculpt.points
        if self._prepared is None:
            held = self._system.moving(self._moving) if self._hold_static else None
            edges = held.edges if held else np.flatnonzero(touching(graph.edges, self._moving))
            across = held.bridges if held else np.arange(len(bridges.followers))
            ends = graph.edges[edges]
            self._prepared = _Prepared(
                held=held,
                edges=edges,
                bridges=across,
                edge_vectors=self._vectors(ends[:, 0], ends[:, 1]),
                bridge_vectors=self._vectors(bridges.leaders[across], bridges.followers[across]),
            )
        prepared = self._prepared
        along = shared.between(bridges.leaders[prepared.bridges], bridges.followers[prepared.bridges])
        wanted = mix(shared.edge_shares[prepared.edges], prepared.edge_vectors)
        bridged, anchored = mix(along, prepared.bridge_vectors), np.zeros(3)
        if self._moving[graph.anchor]:
            moved = self.sculpt.offsets[:, np.searchsorted(points, graph.anchor)]
            anchored = np.asarray(shared.shares[graph.anchor] @ moved)
        offsets = np.zeros((len(self._moving), 3))
        if prepared.held:
            offsets[prepared.held.points] = prepared.held.solve(wanted, bridged, anchored)
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
        edges = np.flatnonzero(touching(self._graph.edges, self._moving))
        ends = self._graph.edges.take(edges, axis=0)
        return edges, mix(shared.edge_shares.take(edges, axis=0), self._vectors(ends[:, 0], ends[:, 1]))

    def _vectors(self, start: IntArray, end: IntArray) -> FloatArray:
        """(K, q, 3) vectors of the sources' offsets from points to points."""
        place = np.full(len(self._moving), len(self.sculpt.points))  # static points: a row of zeros at the end
        place[self.sculpt.points] = np.arange(len(self.sculpt.points))
        padded = np.concatenate([self.sculpt.offsets, np.zeros((len(self.sculpt.offsets), 1, 3))], axis=1)
        return np.asarray(padded.take(place[end], axis=1) - padded.take(place[start], axis=1))


@dataclass(frozen=True)
class _Prepared:
    """The factor of one sculpt, and its right-hand sides before they are mixed."""

    held: MovingSystem | None  # None: the neutral's own system is solved
    edges: IntArray  # (q,)
    bridges: IntArray  # (b,)
    edge_vectors: FloatArray  # (K, q, 3) of offsets
    bridge_vectors: FloatArray  # (K, b, 3)
