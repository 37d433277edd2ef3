"""Weights found for a target: those of a blend are found again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from blend_faces import blended, by_region, kinds, misaligned, moved, session, two
from scipy.spatial.transform import Rotation

from facepipe.core.errors import InputError, TopologyError
from facepipe.stage import Face
from facepipe.verbs.blend import BlendOptions, BlendSession, Weights
from facepipe.verbs.blend.matching import match


def found_table(blend: BlendSession, weights: Weights) -> np.ndarray:
    return weights.shares(blend.graph.regions, len(blend.faces)).table


def regions_that_count(blend: BlendSession) -> np.ndarray:
    """Rows of regions that some point outside the kept parts is in."""
    free = np.setdiff1d(np.arange(blend.sources.points.shape[1]), blend.kept.points)
    return np.asarray(blend.graph.masks[:, free].max(axis=1) > 0)


@kinds()
@pytest.mark.parametrize("name", ["features", "whole regions"])
def test_match_finds_the_weights_of_a_blend(kind: str, name: str) -> None:
    blend = session(kind, 2, "neutral")
    target = blended(blend, by_region(name))
    report = match(blend, target)
    rows = regions_that_count(blend)
    found, expected = found_table(blend, report.weights), found_table(blend, by_region(name))
    np.testing.assert_allclose(found[rows], expected[rows], atol=1e-5)
    assert report.rms_mm < 1e-3


@kinds()
def test_match_finds_the_weights_of_three_sources_and_a_moved_target(kind: str) -> None:
    """Where the target stands makes no difference, nor does a turn by nothing."""
    blend = session(kind, 3, "neutral")
    weights = Weights(
        regions={"eyes": (0.2, 0.5, 0.3), "mouth": (0.0, 1.0, 0.0), "nose": (0.7, 0.0, 0.3)}, default=(0.4, 0.3, 0.3)
    )
    target = Face.from_parts(misaligned(blended(blend, weights).parts(), mm=25.0, degrees=0.0))
    rows = regions_that_count(blend)
    found = found_table(blend, match(blend, target).weights)
    np.testing.assert_allclose(found[rows], found_table(blend, weights)[rows], atol=1e-5)


def turned(face: Face, degrees: float, scale: float) -> Face:
    """The face turned, moved and larger."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.array([0.48, 0.6, 0.64])).as_matrix()
    matrix[:3, 3] = (3.0, -20.0, 7.0)
    parts = moved(face.parts(), matrix)
    return Face.from_parts(replace(parts, meters_per_unit=scale * parts.meters_per_unit))


@kinds("sample", "ict")
@pytest.mark.parametrize(("degrees", "scale"), [(14.0, 1.2), (150.0, 0.5)])
def test_a_blend_that_is_turned_and_scaled_is_found_as_it_is(kind: str, degrees: float, scale: float) -> None:
    blend = session(kind, 2, "neutral", BlendOptions(contacts=False))
    target = blended(blend, by_region("features"))
    plain, report = match(blend, target), match(blend, turned(target, degrees, scale))
    assert (plain.turned_degrees, plain.scaled) == (0.0, 1.0), "a blend that lies in place is taken as it lies"
    rows = regions_that_count(blend)
    same = found_table(blend, by_region("features"))[rows]
    for one in (plain, report):
        np.testing.assert_allclose(found_table(blend, one.weights)[rows], same, atol=1e-5)
        assert one.rms_mm < 1e-3
    np.testing.assert_allclose(found_table(blend, report.weights), found_table(blend, plain.weights), atol=1e-5)
    assert report.turned_degrees == pytest.approx(degrees, abs=1e-4)
    assert report.scaled == pytest.approx(1.0 / scale, rel=1e-6)
    said = report.found(("a.usda", "b.usda"))
    assert f"turned by {degrees:.1f} degrees and scaled by {1 / scale:.3f}" in said
    assert "turned" not in plain.found(("a.usda", "b.usda"))


def test_how_a_face_stands_that_no_blend_gives_makes_no_difference() -> None:
    blend = session("sample", 2, "neutral", BlendOptions(contacts=False))
    other = session("sample", 3, "neutral").faces[2]
    plain, report = match(blend, other), match(blend, turned(other, 14.0, 1.2))
    np.testing.assert_allclose(found_table(blend, report.weights), found_table(blend, plain.weights), atol=1e-4)
    assert report.rms_mm == pytest.approx(plain.rms_mm, rel=1e-4)


def test_sources_taken_as_they_lie_are_matched_so() -> None:
    blend = session("sample", 2, "neutral")
    report = match(blend, turned(blended(blend, by_region("features")), 14.0, 1.2))
    assert report.rms_mm > 0.1
    assert (report.turned_degrees, report.scaled) == (0.0, 1.0)


def test_match_keeps_locks_and_makes_the_best_of_the_rest() -> None:
    blend = session("sample", 2, "neutral")
    target = blended(blend, Weights(regions={"mouth": two(0.2), "eyes": two(0.7)}, default=two(0.5)))
    free, locked = match(blend, target), match(blend, target, {"mouth": 1})
    assert locked.weights.locked == {"mouth": 1}
    assert tuple(locked.weights.regions["mouth"]) == (1.0, 0.0)
    assert locked.weights.regions["eyes"][0] == pytest.approx(0.7, abs=0.1)
    assert locked.rms_mm > free.rms_mm
    with pytest.raises(InputError, match="no such region"):
        match(blend, target, {"nowhere": 1})
    with pytest.raises(InputError, match="source 3"):
        match(blend, target, {"mouth": 3})


def test_weights_of_a_match_are_shares() -> None:
    """Of a face that no blend gives: 0 or more, summing to 1."""
    blend = session("sample", 2, "neutral")
    report = match(blend, session("sample", 3, "neutral").faces[2])
    table = np.array([*report.weights.regions.values(), report.weights.default])
    assert (table >= 0).all()
    np.testing.assert_allclose(table.sum(axis=1), 1.0, atol=1e-12)
    assert report.max_mm >= report.rms_mm > 0.001


def test_a_target_of_another_topology_is_an_error() -> None:
    blend = session("sample", 2, "neutral")
    with pytest.raises(TopologyError):
        match(blend, session("makehuman", 2, "neutral").faces[0])
