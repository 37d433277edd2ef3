"""How good a blend is: the report, in millimetres, and as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.reports import Report, table
from facepipe.geometry.differences import edge_vectors
from facepipe.geometry.polygons import triangle_normals, turned_triangles
from facepipe.verbs.blend.graph import mix
from facepipe.verbs.blend.lids import LidContact, lid_contacts
from facepipe.verbs.blend.session import BlendSession, Solution

if TYPE_CHECKING:
    from facepipe.verbs.blend.matching import MatchReport

_SHOWN = 4  # names of a list


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
    skipped: tuple[str, ...] = ()  # shapes that some source lacks
    transferred: tuple[str, ...] = ()  # "shape: source it was transferred to"
    authored: tuple[str, ...] = ()
    seconds: float = 0.0
    match: MatchReport | None = None  # what found the weights

    def as_text(self, out: Path) -> str:
        """What was made, and how near it came to the edges that were asked for."""
        lines = [
            *([] if self.match is None else [_match(self.match, self.sources)]),
            f"{out}: {len(self.sources)} source{'s' * (len(self.sources) != 1)}, {self.points:,} points, "
            f"{len(self.shapes)} shapes and inbetweens in {self.seconds:.2f} s",
            _deviations(self),
            *_shapes(self),
            f"flipped triangles: {self.flipped_triangles} in the neutral, "
            f"{sum(shape.flipped_triangles for shape in self.shapes.values())} in shapes",
            f"loose parts: {self.loose_parts}; parts that keep their shape: {self.kept_parts}",
            *(_lids(name, contact) for name, contact in self.lids.items()),
            *_names("shapes transferred", self.transferred),
            *_names("shapes left out, as some source lacks them", self.skipped),
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
    count = len(neutral.points)
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
        skipped=session.skipped,
        transferred=tuple(f"{shape}: {name}" for shape, name in session.transferred),
        warnings=(*sources.warnings, *graph.notes, *neutral.notes, *_warnings(session)),
    )
    return report, _at_points(lengths, graph.edges, count)


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
    return ShapeQuality(
        moving=len(sculpt.points),
        static=len(offsets) - len(sculpt.points),
        deviation=_deviation(lengths[moving[ends].any(axis=1)]),
        border_step_mm=float(lengths[border].max(initial=0.0)),
        flipped_triangles=_flipped(session, solution, number, moving, offsets),
        largest_offset_mm=float(_lengths(solution.offsets[number], mm).max(initial=0.0)),
    )


def _flipped(session: BlendSession, solution: Solution, number: int, moving: BoolArray, offsets: FloatArray) -> int:
    """Triangles that the shape turns over, beyond what it does in the sources."""
    triangles = session.graph.triangles
    touched = triangles[moving[triangles].any(axis=1)]
    sculpt = solution.sculpts[number]
    sculpted = session.sources.points.copy()
    sculpted[:, sculpt.points] += sculpt.offsets
    expected = _triangle_mix(solution.neutral.shares, sculpted, touched)
    return int(turned_triangles(expected, solution.neutral.points + offsets, touched).sum())


def _triangle_mix(shares: FloatArray, points: FloatArray, triangles: IntArray) -> FloatArray:
    """(t, 3) mean normals of the triangles over the sources' points (K, n, 3): wherever these lie, and however far."""
    return mix(shares[triangles].mean(axis=1), np.stack([triangle_normals(point, triangles) for point in points]))


def _warnings(session: BlendSession) -> list[str]:
    lines = []
    if len(session.sources.points) == 1:
        lines.append("one source: the result is that face")
    short = _lengths(edge_vectors(session.sources.points, session.graph.edges), 1.0)
    count = int((short <= 0).any(axis=0).sum())
    if count:
        lines.append(f"{count} edges without length in some source: they stay as short as their blended vectors")
    return lines


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


def _at_points(lengths: FloatArray, edges: IntArray, count: int) -> FloatArray:
    ends = edges.ravel()
    squares = np.bincount(ends, np.repeat(lengths**2, 2), minlength=count)
    return np.sqrt(squares / np.maximum(np.bincount(ends, minlength=count), 1))


def _match(match: MatchReport, sources: Sequence[str]) -> str:
    """The weights that were found, a region a line, and how near they come to the target."""
    rows: list[list[object]] = [["found weights", *_short(sources)]]
    for name, row in match.weights.regions.items():
        lock = match.weights.locked.get(name)
        rows.append([name, *(f"{one:.3f}" for one in row), *([f"locked to {lock}"] if lock else [])])
    rows.append(["default", *(f"{one:.3f}" for one in match.weights.default or ())])
    return f"{table(rows)}\nedges differ from the target's by {match.rms_mm:.4f} mm RMS, {match.max_mm:.4f} mm at most"


def _short(paths: Sequence[str]) -> Sequence[str]:
    """File names where all differ, else the paths."""
    names = [Path(path).name for path in paths]
    return names if len(set(names)) == len(names) else paths


def _deviations(report: BlendReport) -> str:
    rows: list[list[object]] = [["edges off what was asked for, mm", "edges", "RMS", "p95", "max"]]
    for name, one in (*report.regions.items(), ("all", report.deviation)):
        numbers = (f"{value:.4f}" for value in (one.rms_mm, one.p95_mm, one.max_mm))
        rows.append([name, f"{one.edges:,}", *numbers])
    return table(rows)


def _shapes(report: BlendReport) -> list[str]:
    if not report.shapes:
        return []
    name, worst = max(report.shapes.items(), key=lambda item: item[1].border_step_mm)
    return [f"worst step at the border of a shape: {worst.border_step_mm:.4f} mm ({name})"]


def _lids(name: str, contact: LidContact) -> str:
    text = f"{name}: lids cut in by {_depth(contact.depth_mm, contact.sources_mm)}"
    if contact.worst_shape is None:
        return text
    return f"{text}; at worst {_depth(contact.worst_depth_mm, contact.worst_sources_mm)} with {contact.worst_shape}"


def _depth(depth: float, sources: Sequence[float]) -> str:
    return f"{depth:.2f} mm (sources {', '.join(f'{one:.2f}' for one in sources)})"


def _names(title: str, names: Sequence[str]) -> list[str]:
    some = ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
    return [f"{title}: {len(names)} ({some})"] if names else []
