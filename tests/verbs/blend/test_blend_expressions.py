"""Blended expressions: weighted means, what stays static, the step at the border of the moving set, inbetweens."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from blend_faces import (
    REGION_WEIGHTS,
    by_region,
    changed,
    head,
    head_height,
    kinds,
    livelier,
    mesh_points,
    misaligned,
    moved,
    only_shapes,
    rolling_eyes,
    same,
    session,
    snapped,
    weighted,
)
from faces import replace_mesh, tiny_face

from facepipe.geometry.balls import fit_ball
from facepipe.geometry.similarity import fit_similarity
from facepipe.parts import Blendshape, FaceParts, Inbetween
from facepipe.stage import Face
from facepipe.verbs.blend import Blend, BlendOptions, BlendReport, BlendSession, Weights
from facepipe.verbs.blend.quality import measure
from facepipe.verbs.blend.session import Solution

SHAPES = ("jawOpen", "eyeBlinkLeft", "eyeLookInLeft", "mouthSmileLeft")
STEP_MM = {"sample": 0.15, "ict": 0.1}  # the sample's edges are longer


@functools.cache
def few(kind: str, count: int, expressions: str = "static") -> BlendSession:
    """Misaligned heads with a few shapes, which differ."""
    parts = [only_shapes(head(kind, number), *SHAPES) for number in range(count)]
    others = [misaligned(livelier(one, 1.0 + 0.3 * k), seed=k) for k, one in enumerate(parts[1:], 1)]
    options = BlendOptions(expressions=expressions, align="none", contacts=False)  # type: ignore[arg-type]
    return BlendSession([Face.from_parts(one) for one in (parts[0], *others)], options)


@functools.cache
def solved(kind: str, expressions: str = "static") -> tuple[BlendSession, Solution, BlendReport]:
    """Misaligned heads whose shapes differ, blended by region: all shapes, or a few as the document has it."""
    blend = session(kind, 2, "misaligned") if expressions == "static" else few(kind, 2, expressions)
    solution = blend.solve(by_region("features"))
    return blend, solution, measure(blend, solution)[0]


@kinds("sample", "ict")
@pytest.mark.parametrize("expressions", ["static", "document"])
@pytest.mark.parametrize("weights", [(0.3, 0.7), (0.2, 0.3, 0.5)], ids=str)
def test_global_weights_give_the_weighted_mean_offsets(kind: str, weights: tuple[float, ...], expressions: str) -> None:
    """Eyeballs and teeth, which keep their shape, by their centroids."""
    blend = few(kind, len(weights), expressions)
    solution, kept = blend.solve(Weights(default=weights)), blend.kept
    part = np.full(len(solution.neutral.points), -1)
    part[kept.points] = kept.part
    for sculpt, offsets in zip(solution.sculpts, solution.offsets, strict=True):
        off = offsets - weighted(np.array(weights), sculpt.offsets)
        own = part[sculpt.points]
        means = [off[own == one].mean(axis=0) for one in np.unique(own[own >= 0])]
        off = np.concatenate([off[own < 0], np.reshape(means, (-1, 3))])
        assert np.linalg.norm(off, axis=1).max() <= 1e-6 * head_height(blend), sculpt.name


@kinds("sample", "ict")
@pytest.mark.parametrize("expressions", ["static", "document"])
def test_translating_and_re_anchoring_sources_leaves_offsets_alone(kind: str, expressions: str) -> None:
    """The document's free solve ties what moves to the anchor: there another one moves it as a whole."""
    parts = [snapped(only_shapes(head(kind, number), *SHAPES[:2])) for number in range(2)]
    parts[1] = livelier(parts[1])
    there = np.eye(4)
    there[:3, 3] = (-90.0, 8.5, 1.25)
    options = BlendOptions(expressions=expressions, align="none", contacts=False)  # type: ignore[arg-type]
    face = Face.from_parts(parts[0])
    static = {f"Head:{point}" for point in still_border(parts[0])}
    blends = [BlendSession([face, Face.from_parts(moved(parts[1], there))], options)]
    blends += [
        BlendSession([face, Face.from_parts(parts[1])], replace(options, anchor=anchor)) for anchor in (None, *static)
    ]
    first, *others = (blend.solve(by_region("features")).offsets for blend in blends)
    for other in others:
        for one, two in zip(first, other, strict=True):
            off = two - one if expressions == "static" else two - one - (two - one).mean(axis=0)
            same(off, np.zeros_like(off), 1e-9 * head_height(blends[0]))


def still_border(parts: FaceParts) -> tuple[int, int]:
    """Two points of the head's open border near its anchor, which no shape moves."""
    mesh = next(mesh for mesh in parts.meshes if mesh.name == "Head")
    assert mesh.anchor is not None
    still = np.setdiff1d(
        np.arange(len(mesh.points)), np.concatenate([blendshape.point_indices for blendshape in mesh.blendshapes])
    )
    near = np.argsort(np.linalg.norm(mesh.points[still] - mesh.points[mesh.anchor], axis=1))
    return int(still[near[1]]), int(still[near[-1]])


def border_steps_mm(blend: BlendSession, solution: Solution) -> dict[str, float]:
    """The largest error of an offset difference along an edge between a static and a moving point, shape by shape."""
    edges, count = blend.graph.edges, len(solution.neutral.points)
    shares = solution.neutral.shares[edges].mean(axis=1)
    steps = {}
    for sculpt, offsets in zip(solution.sculpts, solution.offsets, strict=True):
        full = np.zeros((1 + len(sculpt.offsets), count, 3))
        full[:, sculpt.points] = np.concatenate([offsets[None], sculpt.offsets])
        border = np.isin(edges, sculpt.points).sum(axis=1) == 1
        own, *sources = full[:, edges[border, 1]] - full[:, edges[border, 0]]
        error = own - weighted(shares[border], np.stack(sources))
        steps[sculpt.name] = float(np.linalg.norm(error, axis=1).max(initial=0.0)) * blend.sources.mm_per_unit
    return steps


@kinds("sample", "ict")
def test_the_border_of_the_moving_set_has_no_step(kind: str) -> None:
    """In every shape; without static points in the solve, jawOpen has one many times as high."""
    steps = border_steps_mm(*solved(kind)[:2])
    assert {"jawOpen", "eyeBlinkLeft"} < set(steps)
    assert max(steps.values()) <= STEP_MM[kind]
    document = border_steps_mm(*solved(kind, "document")[:2])
    assert document["jawOpen"] > 5 * steps["jawOpen"]
    for expressions, own in (("static", steps), ("document", document)):
        report = solved(kind, expressions)[2]
        for name, step in own.items():
            assert report.shapes[name].border_step_mm == pytest.approx(step, rel=1e-6, abs=1e-9)


@kinds("sample", "ict")
@pytest.mark.parametrize("expressions", ["static", "document"])
def test_static_points_are_the_blended_neutral_to_the_bit(kind: str, expressions: str) -> None:
    """On the authored stage: every shape moves only points that it moves in some source."""
    blend, _, _ = solved(kind, expressions)
    face = Face.from_parts(blend.sources.base)
    Blend(weights=by_region("features"))(face, blend)
    result = Face(face.stage)
    neutral = result.evaluate()
    for shape in result.shapes:
        may_move = np.zeros(len(neutral), bool)
        for parts in blend.sources.parts:
            for mesh, start in zip(parts.meshes, blend.sources.mesh_offsets[:-1], strict=True):
                for blendshape in mesh.blendshapes:
                    if blendshape.name == shape:
                        may_move[start + blendshape.point_indices] = True
        posed = result.evaluate({shape: 1.0})
        np.testing.assert_array_equal(posed[~may_move], neutral[~may_move])
        assert (posed[may_move] != neutral[may_move]).any(), shape


def test_points_that_move_less_than_the_threshold_are_static() -> None:
    parts = [only_shapes(head("sample", number), "jawForward") for number in range(2)]
    blend = BlendSession([Face.from_parts(part) for part in parts], BlendOptions(static_mm=0.5, contacts=False))
    (sculpt,) = blend.sculpts
    full = np.zeros((2, blend.sources.points.shape[1], 3))
    for one, own in zip(full, parts, strict=True):
        for mesh, start in zip(own.meshes, blend.sources.mesh_offsets[:-1], strict=True):
            for shape in mesh.blendshapes:
                one[start + shape.point_indices] = shape.offsets
    far = np.flatnonzero((np.linalg.norm(full, axis=2) * 10 > 0.5).any(axis=0))
    np.testing.assert_array_equal(sculpt.points, far)


@kinds("sample", "ict")
@pytest.mark.parametrize("name", REGION_WEIGHTS)
def test_parts_that_move_as_a_whole_keep_their_shape(kind: str, name: str) -> None:
    """The lower teeth in jawOpen: similarity images of themselves at rest."""
    blend = few(kind, 2)
    solution, kept = blend.solve(by_region(name)), blend.kept
    whole = 0
    for sculpt, offsets in zip(solution.sculpts, solution.offsets, strict=True):
        for part in np.unique(kept.part):
            points = kept.points[kept.part == part]
            if np.isin(points, sculpt.points).all():
                rest = solution.neutral.points[points]
                there = rest + offsets[np.searchsorted(sculpt.points, points)]
                same(fit_similarity(rest, there).apply(rest), there, 1e-9 * head_height(blend))
                whole += int(np.linalg.norm(there - rest, axis=1).max() > 1e-3 * head_height(blend))
    assert whole >= {"sample": 1, "ict": 10}[kind]


@pytest.mark.parametrize("name", REGION_WEIGHTS)
def test_eyeballs_stay_round_in_looks(name: str) -> None:
    """Though points on the axis that an eyeball turns about are static."""
    parts = [only_shapes(rolling_eyes(head("sample", number)), "eyeLookInLeft", "eyeLookUpLeft") for number in range(2)]
    blend = BlendSession([Face.from_parts(parts[0]), Face.from_parts(misaligned(parts[1]))])
    solution, eye = blend.solve(by_region(name)), mesh_points(blend)["EyeballLeft"]
    for sculpt, offsets in zip(solution.sculpts, solution.offsets, strict=True):
        posed = solution.neutral.points.copy()
        posed[sculpt.points] += offsets
        rest, looking = fit_ball(solution.neutral.points[eye]), fit_ball(posed[eye])
        assert looking.rms <= 0.0005 * looking.radius
        assert looking.radius == pytest.approx(rest.radius, rel=0.002)


def with_inbetween(parts: FaceParts, name: str, weight: float, factor: float) -> FaceParts:
    """Every shape with one inbetween: its own offsets times a factor."""

    def one(shape: Blendshape) -> Blendshape:
        inbetween = Inbetween(name=name, weight=weight, offsets=factor * np.asarray(shape.offsets))
        return replace(shape, inbetweens=(inbetween,))

    return changed(parts, lambda mesh: replace_mesh(mesh, blendshapes=tuple(map(one, mesh.blendshapes))))


def test_inbetweens_are_blended_by_weight() -> None:
    """A source without one gives the point that its shape passes there: on the line, or between its own inbetweens."""
    sources = [with_inbetween(tiny_face(0), "half", 0.5, 0.2), with_inbetween(tiny_face(1), "late", 0.75, 0.9)]
    blend = BlendSession([Face.from_parts(source) for source in sources], BlendOptions(keep_shape="", contacts=False))
    shares = np.array([0.4, 0.6])
    solution = blend.solve(Weights(default=(0.4, 0.6)))
    whole = {one.shape: one.offsets for one in solution.sculpts if one.inbetween is None}
    factors = {None: (1.0, 1.0), "half": (0.2, 0.6), "late": (0.6, 0.9)}  # at 1, 0.5 and 0.75 of the way
    found = set()
    for sculpt, offsets in zip(solution.sculpts, solution.offsets, strict=True):
        expected = sum(
            share * factor * one
            for share, factor, one in zip(shares, factors[sculpt.inbetween], whole[sculpt.shape], strict=True)
        )
        same(offsets, np.asarray(expected), 1e-6)
        found.add((sculpt.shape, sculpt.inbetween, sculpt.weight))
    assert found == {
        (shape, name, weight)
        for shape in ("jawOpen", "mouthSmileLeft")
        for name, weight in ((None, 1.0), ("half", 0.5), ("late", 0.75))
    }


def test_inbetweens_reach_the_result() -> None:
    """Half way through a blink the authored face stands where the sources' mean does."""
    blend = few("sample", 2)
    face = Face.from_parts(blend.sources.base)
    Blend(weights=Weights(default=(0.3, 0.7)))(face, blend)
    result = Face(face.stage)
    halves = {shape.name for mesh in result.meshes for shape in mesh.blendshapes if shape.inbetweens}
    assert halves == {"eyeBlinkLeft", "jawOpen"}
    for weight in (0.25, 0.5, 0.75, 1.0):
        own, *sources = (one.evaluate({"eyeBlinkLeft": weight}) - one.evaluate() for one in (result, *blend.faces))
        same(own, 0.3 * sources[0] + 0.7 * sources[1], 1e-6 * head_height(blend))
