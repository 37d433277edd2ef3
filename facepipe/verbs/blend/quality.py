"""How good a blend is: the report, in millimetres and as text, and how deep skin lies in what it touches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.reports import Report, table
from facepipe.geometry.gradient_system import edge_vectors
from facepipe.parts import FaceParts
from facepipe.rig import build
from facepipe.verbs.blend.contacts import LEAST_MM
from facepipe.verbs.blend.graph import point_name
from facepipe.verbs.blend.matching import MatchReport
from facepipe.verbs.blend.session import BlendSession, Solution
from facepipe.verbs.blend.topologies import Conformed

_SHOWN = 4  # names of a list
_CLOSE_MM = 30.0  # around the worst contact: what its picture shows
_EYE_MM, _MOUTH_MM = 0.1, 0.3  # deeper than in any source than this is a fault, in an eyeball and elsewhere


@dataclass(frozen=True, kw_only=True)
class Contact:
    """How deep skin lies in an eyeball, in teeth, gums or the other lip, beside the same point in every source.

    Sockets reach into the eyeballs of many faces as they come: what counts is the point that goes furthest beyond the
    deepest that it does in a source. Where none goes beyond, it is the deepest.
    """

    depth_mm: float = 0.0  # at rest
    sources_mm: tuple[float, ...] = ()
    worst_shape: str | None = (
        None  # at weight 1, the one that goes furthest beyond, where one goes further than at rest
    )
    worst_depth_mm: float = 0.0
    worst_sources_mm: tuple[float, ...] = ()
    point: str | None = None  # MESH:POINT of the worst
    beyond_mm: float = 0.0  # how much deeper it is there than in any source
    shapes: Mapping[str, float] = field(default_factory=dict)  # the same of every shape that is deeper, mm
    bound_mm: float = _MOUTH_MM  # what is a fault


def contacts(session: BlendSession, solution: Solution) -> dict[str, Contact]:
    """The contact with every body that skin lies in somewhere."""
    found: dict[str, Contact] = {}
    touches = (*solution.neutral.held.touches, *(touch for held in solution.held for touch in held.touches))
    for body in session.contacts.bodies:
        own = [touch for touch in touches if touch.body is body]
        if not own:
            continue
        none = (0.0,) * len(session.sources.points)
        contact = Contact(sources_mm=none, bound_mm=_MOUTH_MM if body.ball is None else _EYE_MM)
        for touch in own:
            if touch.shape is None:
                contact = replace(contact, depth_mm=touch.depth_mm, sources_mm=touch.sources_mm)
        shapes = {
            touch.shape: touch.beyond_mm for touch in own if touch.shape is not None and touch.beyond_mm > LEAST_MM
        }
        worst = max(own, key=lambda touch: (touch.beyond_mm, touch.shape is None))
        contact = replace(
            contact, point=point_name(session.sources, worst.point), beyond_mm=worst.beyond_mm, shapes=shapes
        )
        if worst.shape is not None and worst.beyond_mm > LEAST_MM:
            contact = replace(
                contact,
                worst_shape=worst.shape,
                worst_depth_mm=worst.depth_mm,
                worst_sources_mm=worst.sources_mm,
            )
        found[body.name] = contact
    return found


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
    flipped_triangles: int  # at weight 1, that face away from those of all sources
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
    contacts: Mapping[str, Contact] = field(default_factory=dict)  # by what skin lies in
    flipped_triangles: int = 0  # of the neutral, that face away from those of all sources
    missed: tuple[str, ...] = ()  # contacts that are deeper than any source's by more than they may be
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
        touching = []
        for name, contact in self.contacts.items():
            touching.append(f"{name}: skin lies in it by {_depth(contact.depth_mm, contact.sources_mm)}")
            if contact.worst_shape is not None:
                depth = _depth(contact.worst_depth_mm, contact.worst_sources_mm)
                touching[-1] += f"; at worst {depth} with {contact.worst_shape}"
        lines = [
            *([] if self.match is None else [self.match.found(self.sources)]),
            f"{out}: {len(self.sources)} source{'s' * (len(self.sources) != 1)}, {self.points:,} points, "
            f"{len(self.shapes)} shapes and inbetweens in {self.seconds:.2f} s",
            table(rows),
            *(f"worst step at the border of a shape: {mm:.4f} mm ({name})" for mm, name in worst),
            f"flipped triangles: {self.flipped_triangles} in the neutral, "
            f"{sum(shape.flipped_triangles for shape in self.shapes.values())} in shapes",
            f"loose parts: {self.loose_parts}; parts that keep their shape: {self.kept_parts}",
            *touching,
            *self.missed,
            *_names("shapes transferred", self.transferred),
            *_names("shapes left out, as some source lacks them", self.skipped),
            *([f"sources are laid on the first one by: {self.aligned}"] if self.aligned != "none" else []),
        ]
        return "\n".join(lines)


def posed_contact(parts: FaceParts, report: BlendReport) -> tuple[FloatArray, FloatArray]:
    """(n, 3) world points of a result in the pose of its worst contact, and (n, 3) what a picture of that frames.

    At rest and as a whole where there is no contact.
    """
    if not report.contacts:
        points = build(parts).evaluate()
        return points, points
    worst = max(report.contacts.values(), key=lambda contact: contact.beyond_mm - contact.bound_mm)
    shape, _, weight = (worst.worst_shape or "").partition("@")
    points = build(parts).evaluate({shape: float(weight or 1.0)} if shape else None)
    mesh, _, point = (worst.point or "").rpartition(":")
    names = [one.name for one in parts.meshes]
    start = sum(len(one.points) for one in parts.meshes[: names.index(mesh)])
    centre = points[start + int(point)]
    far = np.linalg.norm(points - centre, axis=1) * parts.meters_per_unit * 1000.0 > _CLOSE_MM
    return points, np.where(far[:, None], centre, points)


def measure(session: BlendSession, solution: Solution) -> tuple[BlendReport, FloatArray]:
    """The report of a solution, and the seam residual (n,): RMS deviation of the edges at each point, mm."""
    sources, graph, neutral = session.sources, session.graph, solution.neutral
    lengths = _lengths(edge_vectors(neutral.points, graph.edges) - neutral.wanted, sources.mm_per_unit)
    # an edge across regions counts in one alone, of which its ends have most: sums over regions are those of all
    region = np.argmax(graph.masks[:, graph.edges[:, 0]] + graph.masks[:, graph.edges[:, 1]], axis=0)
    names = (*graph.regions, "default")
    count, warnings = len(neutral.points), []
    if len(sources.points) == 1:
        warnings.append("one source: the result is that face")
    short = int((_lengths(edge_vectors(sources.points, graph.edges), 1.0) <= 0).any(axis=0).sum())
    if short:
        warnings.append(f"{short} edges without length in some source: they stay as short as their blended vectors")
    found = contacts(session, solution)
    report = BlendReport(
        sources=sources.names,
        points=count,
        loose_parts=len(np.unique(graph.component)) - 1,
        kept_parts=len(np.unique(session.kept.part)),
        weights={name: tuple(map(float, row)) for name, row in zip(names, neutral.table, strict=True)},
        deviation=_deviation(lengths),
        regions={name: _deviation(lengths[region == i]) for i, name in enumerate(names) if (region == i).any()},
        shapes={sculpt.name: _shape(session, solution, number) for number, sculpt in enumerate(solution.sculpts)},
        contacts=found,
        flipped_triangles=neutral.held.turned,
        missed=tuple(_too_deep(name, one) for name, one in found.items() if one.beyond_mm > one.bound_mm)
        if session.options.contacts
        else (),
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
    return ShapeQuality(
        moving=len(sculpt.points),
        static=len(offsets) - len(sculpt.points),
        deviation=_deviation(lengths),
        border_step_mm=float(lengths[border].max(initial=0.0)),
        flipped_triangles=solution.held[number].turned,
        largest_offset_mm=float(_lengths(solution.offsets[number], mm).max(initial=0.0)),
    )


def _lengths(vectors: FloatArray, mm_per_unit: float) -> FloatArray:
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.asarray(np.sqrt(x * x + y * y + z * z) * mm_per_unit)


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


def _too_deep(name: str, contact: Contact) -> str:
    shape = "at rest" if contact.worst_shape is None else f"with {contact.worst_shape}"
    what = f"skin lies {contact.beyond_mm:.2f} mm deeper in it than in any source {shape} ({contact.point})"
    return f"{name}: {what}, expected at most {contact.bound_mm:g}"


def _depth(depth: float, sources: Sequence[float]) -> str:
    return f"{depth:.2f} mm (sources {', '.join(f'{one:.2f}' for one in sources)})"


def _names(title: str, names: Sequence[str]) -> list[str]:
    some = ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
    return [f"{title}: {len(names)} ({some})"] if names else []
