"""The blended neutral: weighted means, translations, regions, parts that keep their shape, distances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from blend_faces import (
    EYES,
    REGION_WEIGHTS,
    TEETH,
    by_region,
    changed,
    head,
    head_height,
    kinds,
    mesh_points,
    moved,
    only_shapes,
    same,
    session,
    snapped,
    sources,
    steady,
    weighted,
)
from faces import replace_mesh
from scipy.spatial.transform import Rotation

from facepipe.geometry.balls import fit_ball
from facepipe.geometry.gradient_system import edge_vectors
from facepipe.geometry.similarity import fit_similarity
from facepipe.parts import FaceParts
from facepipe.stage import Face
from facepipe.verbs.blend import BlendOptions, BlendSession, Weights

GLOBAL = ((0.3, 0.7), (1.0, 0.0), (0.25, 0.35, 0.4), (0.0, 0.5, 0.5))


def neutral_session(kind: str, count: int = 2, options: BlendOptions | None = None) -> BlendSession:
    return session(kind, count, "neutral", options)


def means_of(blend: BlendSession, points: np.ndarray) -> np.ndarray:
    """(parts, 3) centroids of the parts that keep their shape."""
    kept = blend.kept
    return np.stack([points[kept.points[kept.part == part]].mean(axis=0) for part in np.unique(kept.part)])


@kinds()
@pytest.mark.parametrize("edges", ["uniform", "cotangent"])
@pytest.mark.parametrize("weights", GLOBAL, ids=str)
def test_global_weights_give_the_weighted_mean_up_to_one_translation(
    kind: str, weights: tuple[float, ...], edges: str
) -> None:
    blend = neutral_session(kind, len(weights), BlendOptions(edges=edges, align="none", contacts=False))  # type: ignore[arg-type]
    expected = weighted(np.array(weights), blend.sources.points)
    found = blend.neutral(Weights(default=weights)).points
    off = found - expected
    free = np.setdiff1d(np.arange(len(off)), blend.kept.points)
    about = 1e-6 * head_height(blend)
    assert len(np.unique(blend.graph.component[free])) > 1, "loose parts count too"
    steady(np.concatenate([off[free], means_of(blend, found) - means_of(blend, expected)]), about)
    anchor = blend.graph.anchor
    np.testing.assert_array_equal(found[anchor], blend.sources.points[0, anchor])


@kinds()
def test_translating_sources_translates_the_whole_result(kind: str) -> None:
    """By multiples of the grid that the points lie on: float32 files hold both."""
    parts = [snapped(only_shapes(head(kind, number))) for number in range(2)]
    as_they_lie = BlendOptions(align="none", contacts=False)
    first = BlendSession([Face.from_parts(part) for part in parts], as_they_lie)
    shifts = [(0.0, 0.0, 0.0), (10.5, -3.25, 7.0)], [(-4.0, 21.0, 0.5), (0.0, 0.0, 0.0)], [(1.5, 2.0, 3.0), (-90, 8, 1)]
    for vectors in shifts:
        others = [moved(one, translation(vector)) for one, vector in zip(parts, vectors, strict=True)]
        other = BlendSession([Face.from_parts(one) for one in others], as_they_lie)
        for name in REGION_WEIGHTS:
            one, two = (blend.neutral(by_region(name)) for blend in (first, other))
            off = np.concatenate([two.points - one.points, two.joints - one.joints])
            steady(off, 1e-9 * head_height(first))
            same(off[0], np.array(vectors[0]), 1e-9)


def translation(vector: tuple[float, float, float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = vector
    return matrix


@kinds()
def test_another_anchor_translates_the_whole_result(kind: str) -> None:
    first = session(kind, 2, "misaligned neutral")
    count = len(first.sources.base.meshes[0].points)
    for point in (0, count // 2, count - 1):
        other = session(
            kind, 2, "misaligned neutral", BlendOptions(anchor=f"Head:{point}", align="none", contacts=False)
        )
        for name in REGION_WEIGHTS:
            one, two = (blend.neutral(by_region(name)) for blend in (first, other))
            steady(np.concatenate([two.points - one.points, two.joints - one.joints]), 1e-9 * head_height(first))
            np.testing.assert_array_equal(two.points[point], first.sources.points[0, point])


@kinds()
@pytest.mark.parametrize("name", REGION_WEIGHTS)
def test_regions_of_misaligned_sources_keep_their_edges(kind: str, name: str) -> None:
    """Deviations from the blended edge vectors are at most 1/3 of those of averaged vertices: RMS and 99th percentile.

    Where one region alone differs, its border takes so few edges that the percentile of all says nothing of it; there
    it is that of the edges whose weights vary.
    """
    blend = session(kind, 2, "misaligned neutral")
    neutral, edges = blend.neutral(by_region(name)), blend.graph.edges
    averaged = weighted(neutral.shares, blend.sources.points)
    own, other = (
        np.linalg.norm(edge_vectors(points, edges) - neutral.wanted, axis=1) for points in (neutral.points, averaged)
    )
    assert np.sqrt((own**2).mean()) <= np.sqrt((other**2).mean()) / 3
    border = np.ptp(neutral.shares[edges], axis=1).max(axis=1) > 0.01 if name == "one region" else np.ones(len(edges))
    own, other = own[border > 0], other[border > 0]
    assert np.percentile(own, 99) <= np.percentile(other, 99) / 3


@kinds()
def test_one_face_comes_back(kind: str) -> None:
    (face,) = sources(kind, 1, "neutral")
    for faces in ([face], [face, face, face]):
        blend = BlendSession(faces)
        weights = Weights(regions={"eyes": [0.5, 0.25, 0.25][: len(faces)], "mouth": [1.0, 2.0, 3.0][: len(faces)]})
        neutral = blend.neutral(weights)
        same(neutral.points, blend.sources.points[0], 1e-9 * head_height(blend))
        same(neutral.joints, blend.joint_worlds[0, :, :3, 3], 1e-9 * head_height(blend))


def in_other_terms(parts: FaceParts) -> FaceParts:
    """The same face in metres (or 256ths of its unit, which float32 scales exactly), Z up."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("x", 90, degrees=True).as_matrix().round()
    turned = moved(parts, turn)
    skeleton = turned.skeleton
    bind, rest = np.array(skeleton.bind_transforms), np.array(skeleton.rest_transforms)
    bind[:, :3, 3] *= 256
    rest[:, :3, 3] *= 256
    scaled = changed(turned, lambda mesh: replace_mesh(mesh, points=mesh.points * 256))
    return replace(
        scaled,
        up_axis="Z",
        meters_per_unit=parts.meters_per_unit / 256,
        skeleton=replace(skeleton, bind_transforms=bind, rest_transforms=rest),
    )


@kinds()
def test_units_and_up_axis_of_sources_make_no_difference(kind: str) -> None:
    parts = [only_shapes(head(kind, number)) for number in range(2)]
    alike = BlendSession([Face.from_parts(part) for part in parts])
    other = BlendSession([Face.from_parts(parts[0]), Face.from_parts(in_other_terms(parts[1]))])
    reverse = BlendSession([Face.from_parts(in_other_terms(parts[0])), Face.from_parts(parts[1])])
    one, two, three = (blend.neutral(by_region("features")) for blend in (alike, other, reverse))
    about = 1e-9 * head_height(alike)
    same(two.points, one.points, about)
    same(two.joints, one.joints, about)
    turned = np.stack([three.points[:, 0], three.points[:, 2], -three.points[:, 1]], axis=1) / 256
    same(turned, one.points, about)


@kinds()
@pytest.mark.parametrize("name", REGION_WEIGHTS)
def test_eyeballs_and_teeth_are_the_mean_shape_of_their_sources_moved_turned_and_scaled(kind: str, name: str) -> None:
    blend = session(kind, 2, "misaligned neutral")
    neutral, kept = blend.neutral(by_region(name)), blend.kept
    meshes = mesh_points(blend)
    np.testing.assert_array_equal(
        kept.points, np.sort(np.concatenate([meshes[name] for name in (*EYES[kind], *TEETH[kind])]))
    )
    for part in np.unique(kept.part):
        points = kept.points[kept.part == part]
        own = blend.sources.points[:, points]
        aligned = np.stack([fit_similarity(one, own[0]).apply(one) for one in own])
        mean = weighted(neutral.shares[points].mean(axis=0), aligned)
        fitted = fit_similarity(mean, neutral.points[points])
        same(fitted.apply(mean), neutral.points[points], 1e-9 * head_height(blend))


@kinds()
@pytest.mark.parametrize("name", REGION_WEIGHTS)
def test_eyeballs_stay_as_round_as_those_of_their_sources(kind: str, name: str) -> None:
    blend = session(kind, 2, "misaligned neutral")
    found = blend.neutral(by_region(name)).points
    for eye in EYES[kind]:
        balls = [fit_ball(points[mesh_points(blend)[eye]]) for points in (found, *blend.sources.points)]
        rounds = [ball.rms / ball.radius for ball in balls]
        assert rounds[0] <= max(rounds[1:]) * 1.01
        assert min(b.radius for b in balls[1:]) * 0.97 <= balls[0].radius <= max(b.radius for b in balls[1:]) * 1.03
