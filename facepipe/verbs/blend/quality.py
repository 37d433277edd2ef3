"""How good a blend is: the report, in millimetres and as text, cuts of lids into eyeballs, weights for a target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import FitError
from facepipe.core.reports import Report, table
from facepipe.core.threads import one_thread
from facepipe.geometry.balls import RadialSurface, fit_ball
from facepipe.geometry.bounded_least_squares import fit_simplex
from facepipe.geometry.gradient_system import edge_vectors
from facepipe.geometry.polygons import point_areas, triangle_normals, turned_triangles
from facepipe.geometry.similarity import fit_similarity
from facepipe.stage import Face
from facepipe.verbs.blend.graph import mean_of_ends, mix
from facepipe.verbs.blend.session import BlendSession, Solution
from facepipe.verbs.blend.sources import stack
from facepipe.verbs.blend.topologies import Conformed
from facepipe.verbs.blend.weights import Weights

_ROUND = 0.1  # RMS distance from a ball, in radii, up to which a part counts as an eyeball
_LARGE = 0.5  # area of a component, relative to the largest of its part, from which on it may be the outer shell
_AROUND = 2.0  # radii from an eyeball's centre within which the face is looked at
_SHOWN = 4  # names of a list


@dataclass(frozen=True, kw_only=True)
class LidContact:
    """Depths of points of the face in one eyeball (0 outside), each beside that of the same point in every source.

    Sockets reach into the eyeballs of many faces as they come: what counts is the point that goes furthest beyond the
    deepest that it does in a source. Where none goes beyond, it is the deepest.
    """

    depth_mm: float  # at rest
    sources_mm: tuple[float, ...]
    worst_shape: str | None = (
        None  # at weight 1, the one that goes furthest beyond, where one goes further than at rest
    )
    worst_depth_mm: float = 0.0
    worst_sources_mm: tuple[float, ...] = ()


def lid_contacts(session: BlendSession, solution: Solution) -> dict[str, LidContact]:
    """The contact at every kept part that is round and belongs to a mesh named like an eye."""
    contacts, kept, offsets = {}, session.kept, session.sources.mesh_offsets
    eyes: list[tuple[str, IntArray]] = []
    for number, mesh in enumerate(session.sources.base.meshes):
        inside = (kept.points >= offsets[number]) & (kept.points < offsets[number + 1])
        parts = np.unique(kept.part[inside])
        for count, part in enumerate(parts if "eye" in mesh.name.lower() else (), 1):
            name = mesh.name if len(parts) == 1 else f"{mesh.name} {count}"
            eyes.append((name, kept.points[kept.part == part]))
    for name, part in eyes:
        # points (s,) and triangles (t, 3), into them, of the outermost of a part's large components. Eyeballs are
        # modelled as one shell around another; small components are irises, lenses and caps.
        graph, points = session.graph, session.sources.points[0]
        triangles = graph.triangles[_places(part, len(points))[graph.triangles[:, 0]] >= 0]
        component = graph.component[part]
        areas = np.bincount(component, point_areas(points, triangles)[part])
        reach = np.zeros(len(areas))
        np.maximum.at(reach, component, np.linalg.norm(points[part] - points[part].mean(axis=0), axis=1))
        shell = part[component == np.where(areas >= _LARGE * areas.max(), reach, 0.0).argmax()]
        local = _places(shell, len(points))[triangles]
        shell = shell, local[local[:, 0] >= 0]
        stands = [_surface(points, shell) for points in (*session.sources.points, solution.neutral.points)]
        surfaces = [surface for surface in stands if surface is not None]
        if len(surfaces) == len(stands):
            contacts[name] = _Eye(session, solution, part, surfaces).contact()
    return contacts


def _surface(points: FloatArray, shell: tuple[IntArray, IntArray]) -> RadialSurface | None:
    shell_points = points[shell[0]]
    try:
        ball = fit_ball(shell_points, point_areas(shell_points, shell[1]))  # a cornea is modelled more densely
    except FitError:
        return None
    return RadialSurface(shell_points, ball.centre) if ball.rms <= _ROUND * ball.radius else None


class _Eye:
    """One eyeball and the face around it, in the sources and, last, in the blend."""

    def __init__(
        self, session: BlendSession, solution: Solution, part: IntArray, surfaces: list[RadialSurface]
    ) -> None:
        self._solution, self._surfaces, self._mm = solution, surfaces, session.sources.mm_per_unit
        stands = (*session.sources.points, solution.neutral.points)
        face = np.flatnonzero(session.graph.main)
        around = [
            ((points[face] - surface.centre) ** 2).sum(axis=1) < (_AROUND * surface.largest) ** 2
            for points, surface in zip(stands, surfaces, strict=True)
        ]
        face = face[np.any(around, axis=0)]
        self._face = [points[face] for points in stands]
        self._part = [points[part] for points in stands]
        self._on_face, self._on_part = (_places(own, len(stands[0])) for own in (face, part))

    def contact(self) -> LidContact:
        """The depths at rest and in the worst shape."""
        if not len(self._face[0]):
            return LidContact(depth_mm=0.0, sources_mm=(0.0,) * (len(self._face) - 1))
        rest = [surface.depths(points) for surface, points in zip(self._surfaces, self._face, strict=True)]
        beyond, (*sources, depth) = self._furthest(rest)
        shape, worst = None, [0.0] * len(rest)
        for number, sculpt in enumerate(self._solution.sculpts):
            # depths of the face around the eye under the sculpt, in every source and in the blend
            on_face, on_part = self._on_face[sculpt.points], self._on_part[sculpt.points]
            skin, eye = on_face >= 0, on_part >= 0
            posed = list(rest)
            for k, offsets in enumerate((*sculpt.offsets, self._solution.offsets[number])):
                if eye.any():
                    # the eyeball moves too: the face is seen from it
                    face, part = self._face[k].copy(), self._part[k].copy()
                    face[on_face[skin]] += offsets[skin]
                    part[on_part[eye]] += offsets[eye]
                    motion = fit_similarity(self._part[k], part)
                    posed[k] = motion.scale * self._surfaces[k].depths(motion.undo(face))
                elif skin.any():
                    posed[k] = rest[k].copy()
                    moved = self._face[k][on_face[skin]] + offsets[skin]
                    posed[k][on_face[skin]] = self._surfaces[k].depths(moved)
            further, depths = self._furthest(posed)
            if further > max(beyond, 0.0):
                beyond, shape, worst = further, sculpt.name, depths
        return LidContact(
            depth_mm=depth,
            sources_mm=tuple(sources),
            worst_shape=shape,
            worst_depth_mm=worst[-1],
            worst_sources_mm=() if shape is None else tuple(worst[:-1]),
        )

    def _furthest(self, depths: list[FloatArray]) -> tuple[float, list[float]]:
        """How far beyond the sources a point goes at most, and its depths in all, mm."""
        beyond = depths[-1] - np.max(depths[:-1], axis=0)
        point = beyond.argmax() if beyond.max() > 0 else depths[-1].argmax()
        return float(beyond[point]) * self._mm, [float(depth[point]) * self._mm for depth in depths]


def _places(points: IntArray, count: int) -> IntArray:
    """(count,) place of every point in `points`; -1 where it is not there."""
    places = np.full(count, -1)
    places[points] = np.arange(len(points))
    return places


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
    (_, wanted) = stack([session.faces[0], target]).points  # as it lies: a blend stands in the first one's place
    edges = graph.edges[~np.isin(graph.edges, session.kept.points).any(axis=1)]
    goal = edge_vectors(wanted, edges).ravel()
    # points that each region's whole weight on each source gives, region by region, with the anchor at 0
    responses, bridges = [], graph.bridges
    for mask in graph.masks:
        along = mean_of_ends(mask[:, None], graph.edges[:, 0], graph.edges[:, 1])
        across = mean_of_ends(mask[:, None], bridges.followers, bridges.leaders)
        for edge, bridge in zip(session.edge_vectors, session.bridge_vectors, strict=True):
            points = session.system.solve(along * edge, across * bridge, np.zeros(3))
            responses.append(edge_vectors(points, edges).ravel())
    basis = np.stack(responses, axis=1)
    rows, locked = len(graph.regions) + 1, locked or {}
    Weights(locked=locked).shares(graph.regions, count)  # checks them
    locks = {graph.regions.index(name): np.eye(count)[number - 1] for name, number in locked.items()}
    # shares sum to 1 in each region: only what differs from its mean counts, and rounding is relative to that
    means = np.repeat(basis.reshape(len(basis), rows, count).mean(axis=2), count, axis=1)
    basis, goal = basis - means, goal - means.sum(axis=1) / count
    fitted = fit_simplex(basis.T @ basis, basis.T @ goal, rows, count, locked=locks)
    off = np.linalg.norm((basis @ fitted.weights.ravel() - goal).reshape(-1, 3), axis=1) * session.sources.mm_per_unit
    table = [tuple(map(float, row)) for row in np.round(fitted.weights, 9)]  # last bits differ with the threads of BLAS
    weights = Weights(regions=dict(zip(graph.regions, table[:-1], strict=True)), default=table[-1], locked=dict(locked))
    return MatchReport(weights=weights, rms_mm=float(np.sqrt((off**2).mean())), max_mm=float(off.max(initial=0.0)))


@dataclass(frozen=True, kw_only=True)
class Deviation:
    """Lengths of the differences between solved edge vectors and the blended ones that were asked for."""

    edges: int
    mean_mm: float
    rms_mm: float
    p95_mm: float
    p99_mm: float
    max_mm: float


@dataclass(frozen=True, kw_only=True)
class ShapeQuality:
    """One sculpt of the result."""

    moving: int  # points
    static: int  # points that are the blended neutral's to the bit
    deviation: Deviation  # over the edges at moving points
    border_step_mm: float  # the largest deviation over edges between static and moving points
    flipped_triangles: int  # at weight 1, against the same mix of the sources' normals
    largest_offset_mm: float


@dataclass(frozen=True, kw_only=True)
class BlendReport(Report):
    """What a blend did and how good it is."""

    sources: tuple[str, ...]
    points: int
    loose_parts: int  # connected components beside the one that holds the anchor
    kept_parts: int  # those of them that keep their shape
    weights: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # as used: normalised, per source
    deviation: Deviation
    regions: Mapping[str, Deviation] = field(default_factory=dict)  # edges by the region that most of them is in
    shapes: Mapping[str, ShapeQuality] = field(default_factory=dict)
    lids: Mapping[str, LidContact] = field(default_factory=dict)  # by eyeball mesh
    flipped_triangles: int = 0  # of the neutral, against the same mix of the sources' normals
    aligned: str = "none"  # what later sources are laid on the first one by
    skipped: tuple[str, ...] = ()  # shapes that some source lacks
    transferred: tuple[str, ...] = ()  # "shape: source it was transferred to"
    authored: tuple[str, ...] = ()
    seconds: float = 0.0
    match: MatchReport | None = None  # what found the weights
    conformed: Mapping[str, Conformed] = field(default_factory=dict)  # sources of other topologies

    def as_text(self, out: Path) -> str:
        """What was made, and how near it came to the edges that were asked for."""
        rows: list[list[object]] = [["edges off what was asked for, mm", "edges", "RMS", "p95", "max"]]
        for name, one in (*self.regions.items(), ("all", self.deviation)):
            rows.append([name, f"{one.edges:,}", *(f"{mm:.4f}" for mm in (one.rms_mm, one.p95_mm, one.max_mm))])
        steps = [(shape.border_step_mm, name) for name, shape in self.shapes.items()]
        worst = [max(steps, key=lambda step: step[0])] if steps else []
        lids = []
        for name, contact in self.lids.items():
            lids.append(f"{name}: lids cut in by {_depth(contact.depth_mm, contact.sources_mm)}")
            if contact.worst_shape is not None:
                depth = _depth(contact.worst_depth_mm, contact.worst_sources_mm)
                lids[-1] += f"; at worst {depth} with {contact.worst_shape}"
        lines = [
            *([] if self.match is None else [_match(self.match, self.sources)]),
            f"{out}: {len(self.sources)} source{'s' * (len(self.sources) != 1)}, {self.points:,} points, "
            f"{len(self.shapes)} shapes and inbetweens in {self.seconds:.2f} s",
            table(rows),
            *(f"worst step at the border of a shape: {mm:.4f} mm ({name})" for mm, name in worst),
            f"flipped triangles: {self.flipped_triangles} in the neutral, "
            f"{sum(shape.flipped_triangles for shape in self.shapes.values())} in shapes",
            f"loose parts: {self.loose_parts}; parts that keep their shape: {self.kept_parts}",
            *lids,
            *_names("shapes transferred", self.transferred),
            *_names("shapes left out, as some source lacks them", self.skipped),
            *([f"sources are laid on the first one by: {self.aligned}"] if self.aligned != "none" else []),
        ]
        return "\n".join(lines)


def measure(session: BlendSession, solution: Solution) -> tuple[BlendReport, FloatArray]:
    """The report of a solution, and the seam residual (n,): RMS deviation of the edges at each point, mm."""
    sources, graph, neutral = session.sources, session.graph, solution.neutral
    lengths = _lengths(edge_vectors(neutral.points, graph.edges) - neutral.wanted, sources.mm_per_unit)
    # an edge across regions counts in one alone, of which its ends have most: sums over regions are those of all
    region = np.argmax(graph.masks[:, graph.edges[:, 0]] + graph.masks[:, graph.edges[:, 1]], axis=0)
    names = (*graph.regions, "default")
    normals = _triangle_mix(neutral.shares, sources.points, graph.triangles)
    count, warnings = len(neutral.points), []
    if len(sources.points) == 1:
        warnings.append("one source: the result is that face")
    short = int((_lengths(edge_vectors(sources.points, graph.edges), 1.0) <= 0).any(axis=0).sum())
    if short:
        warnings.append(f"{short} edges without length in some source: they stay as short as their blended vectors")
    report = BlendReport(
        sources=sources.names,
        points=count,
        loose_parts=len(np.unique(graph.component)) - 1,
        kept_parts=len(np.unique(session.kept.part)),
        weights={name: tuple(map(float, row)) for name, row in zip(names, neutral.table, strict=True)},
        deviation=_deviation(lengths),
        regions={name: _deviation(lengths[region == i]) for i, name in enumerate(names) if (region == i).any()},
        shapes={sculpt.name: _shape(session, solution, number) for number, sculpt in enumerate(solution.sculpts)},
        lids=lid_contacts(session, solution),
        flipped_triangles=int(turned_triangles(normals, neutral.points, graph.triangles).sum()),
        aligned=sources.aligned,
        skipped=session.skipped,
        transferred=tuple(f"{shape}: {name}" for shape, name in session.transferred),
        warnings=(*sources.warnings, *graph.notes, *neutral.notes, *warnings),
    )
    ends = graph.edges.ravel()
    squares = np.bincount(ends, np.repeat(lengths**2, 2), minlength=count)
    return report, np.sqrt(squares / np.maximum(np.bincount(ends, minlength=count), 1))


def _shape(session: BlendSession, solution: Solution, number: int) -> ShapeQuality:
    graph, sculpt, mm = session.graph, solution.sculpts[number], session.sources.mm_per_unit
    neutral = solution.neutral
    edges, wanted = session.expression(number).asked(neutral)
    moving = np.zeros(len(neutral.points), dtype=bool)
    moving[sculpt.points] = True
    offsets = np.zeros(neutral.points.shape)
    offsets[sculpt.points] = solution.offsets[number]
    ends = graph.edges[edges]
    lengths = _lengths(edge_vectors(offsets, ends) - wanted, mm)
    border = moving[ends[:, 0]] != moving[ends[:, 1]]
    # triangles that the shape turns over, beyond what it does in the sources
    touched = graph.triangles[moving[graph.triangles].any(axis=1)]
    sculpted = session.sources.points.copy()
    sculpted[:, sculpt.points] += sculpt.offsets
    expected = _triangle_mix(neutral.shares, sculpted, touched)
    return ShapeQuality(
        moving=len(sculpt.points),
        static=len(offsets) - len(sculpt.points),
        deviation=_deviation(lengths[moving[ends].any(axis=1)]),
        border_step_mm=float(lengths[border].max(initial=0.0)),
        flipped_triangles=int(turned_triangles(expected, neutral.points + offsets, touched).sum()),
        largest_offset_mm=float(_lengths(solution.offsets[number], mm).max(initial=0.0)),
    )


def _triangle_mix(shares: FloatArray, points: FloatArray, triangles: IntArray) -> FloatArray:
    """(t, 3) mean normals of the triangles over the sources' points (K, n, 3): wherever these lie, and however far."""
    return mix(shares[triangles].mean(axis=1), np.stack([triangle_normals(point, triangles) for point in points]))


def _lengths(vectors: FloatArray, mm_per_unit: float) -> FloatArray:
    return np.asarray(np.linalg.norm(vectors, axis=-1) * mm_per_unit)


def _deviation(lengths: FloatArray) -> Deviation:
    if not len(lengths):
        return Deviation(edges=0, mean_mm=0.0, rms_mm=0.0, p95_mm=0.0, p99_mm=0.0, max_mm=0.0)
    p95, p99 = np.percentile(lengths, [95, 99])
    return Deviation(
        edges=len(lengths),
        mean_mm=float(lengths.mean()),
        rms_mm=float(np.sqrt((lengths**2).mean())),
        p95_mm=float(p95),
        p99_mm=float(p99),
        max_mm=float(lengths.max()),
    )


def _match(match: MatchReport, sources: Sequence[str]) -> str:
    """The weights that were found, a region a line, and how near they come to the target."""
    # file names where all differ, else the paths
    names = [Path(path).name for path in sources]
    rows: list[list[object]] = [["found weights", *(names if len(set(names)) == len(names) else sources)]]
    for name, row in match.weights.regions.items():
        lock = match.weights.locked.get(name)
        rows.append([name, *(f"{one:.3f}" for one in row), *([f"locked to {lock}"] if lock else [])])
    rows.append(["default", *(f"{one:.3f}" for one in match.weights.default or ())])
    return f"{table(rows)}\nedges differ from the target's by {match.rms_mm:.4f} mm RMS, {match.max_mm:.4f} mm at most"


def _depth(depth: float, sources: Sequence[float]) -> str:
    return f"{depth:.2f} mm (sources {', '.join(f'{one:.2f}' for one in sources)})"


def _names(title: str, names: Sequence[str]) -> list[str]:
    some = ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
    return [f"{title}: {len(names)} ({some})"] if names else []
