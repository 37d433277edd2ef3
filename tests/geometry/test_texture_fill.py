"""Texels know their place on the surface, and textures known in part are completed without steps, seams or not."""

from __future__ import annotations

import numpy as np
import pytest

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.texels import KnownOffsets, Texels, completed, membrane, spread, texels_of

SIZE = 64
CELLS = 12  # along the strip, of which each half is on a texture of its own


def strip() -> tuple[FloatArray, IntArray]:
    """A flat strip of CELLS x 3 squares of side 1, in triangles."""
    across, up = np.meshgrid(np.arange(CELLS + 1), np.arange(4))
    points = np.column_stack([across.ravel(), up.ravel(), np.zeros(across.size)]).astype(float)
    corner = (np.arange(CELLS) + (CELLS + 1) * np.arange(3)[:, None]).ravel()
    squares = np.stack([corner, corner + 1, corner + CELLS + 2, corner + CELLS + 1], axis=1)
    return points, np.concatenate([squares[:, :3], squares[:, [0, 2, 3]]])


def halves(points: FloatArray, triangles: IntArray) -> tuple[tuple[BoolArray, Texels], ...]:
    """The triangles of each half with its texture: the left as it lies, the right turned by a quarter."""
    left = points[triangles][..., 0].mean(axis=1) < CELLS / 2
    flat = points[:, :2] / (CELLS / 2)
    turned = np.column_stack([flat[:, 1], 2 - flat[:, 0]])  # in 0..1 for the right half
    return tuple(
        (chosen, texels_of(0.02 + 0.9 * uv[triangles[chosen]], triangles[chosen], SIZE))
        for chosen, uv in ((left, flat), (~left, turned))
    )


def test_a_texel_has_the_place_of_its_centre() -> None:
    points, triangles = strip()
    texels = halves(points, triangles)[0][1]
    row, column = np.divmod(texels.at, SIZE)
    uv = np.column_stack([column + 0.5, SIZE - row - 0.5]) / SIZE
    np.testing.assert_allclose(texels.carried(points)[:, :2], (uv - 0.02) / 0.9 * (CELLS / 2), atol=1e-5)
    covered = 0.9**2 * SIZE**2 / 2  # half of the square is covered
    assert len(texels.at) == pytest.approx(covered, rel=0.03)


def test_tiles_are_one_texture() -> None:
    points, triangles = strip()
    uv = np.array([0.125, 0.25]) + points[triangles][..., :2] / 16  # without rounding
    first, fourth = (texels_of(uv + tile, triangles, SIZE) for tile in ((0, 0), (3, 1)))
    np.testing.assert_array_equal(first.at, fourth.at)
    np.testing.assert_array_equal(first.corners, fourth.corners)


def test_sums_are_carrying_transposed() -> None:
    points, triangles = strip()
    texels = halves(points, triangles)[1][1]
    rng = np.random.default_rng(0)
    of_points, of_texels = rng.normal(size=(len(points), 2)), rng.normal(size=(len(texels.at), 2))
    there = (texels.carried(of_points) * of_texels).sum()
    assert there == pytest.approx((of_points * texels.summed(of_texels, len(points))).sum(), rel=1e-4)


def test_between_known_ends_offsets_are_harmonic_across_the_seam() -> None:
    points, triangles = strip()
    weights = np.where((points[:, 0] < 0.5) | (points[:, 0] > CELLS - 0.5), 1e9, 0.0)
    values = np.column_stack([points[:, 0], 5 - 2 * points[:, 0]])
    off = np.abs(membrane(points, triangles, values, weights, 1.0) - values)
    assert off.max() < 0.01 * np.ptp(values)  # diagonals of squares count a little, though their cotangents are 0


def test_known_texels_stay_and_others_continue_them_over_seams_and_textures() -> None:
    points, triangles = strip()
    known = []
    for _, texels in halves(points, triangles):
        place = texels.carried(points)
        confidence = (place[:, 0] < 4).astype(float)
        known.append(KnownOffsets(texels=texels, offsets=np.full((len(place), 3), [0.2, 0, -1]), confidence=confidence))
    assert not known[1].confidence.any()  # the seam lies between
    for result in completed(points, triangles, known, 0.5):
        np.testing.assert_allclose(result, np.tile([0.2, 0, -1], (len(result), 1)), atol=1e-6)


def test_offsets_have_no_step_where_two_textures_meet_or_knowledge_ends() -> None:
    points, triangles = strip()
    known = []
    for _, texels in halves(points, triangles):
        x = texels.carried(points)[:, 0]
        confidence = np.clip(3 - np.minimum(x, CELLS - x), 0, 1)  # both ends, and a fading border
        known.append(KnownOffsets(texels=texels, offsets=np.sin(x)[:, None], confidence=confidence))
    places = np.concatenate([one.texels.carried(points)[:, 0] for one in known])
    result = np.concatenate(completed(points, triangles, known, 0.3))[:, 0]
    order = np.argsort(places, kind="stable")
    columns = places[order].round(3)
    _, first = np.unique(columns, return_index=True)
    means = np.add.reduceat(result[order], first) / np.diff([*first, len(columns)])
    step = CELLS / 2 / 0.9 / SIZE
    assert np.abs(np.diff(means)).max() < 1.3 * step  # a sine rises by 1 at most
    sure = np.concatenate([one.confidence for one in known]) == 1
    np.testing.assert_allclose(result[sure], np.sin(places[sure]), atol=1e-6)


def test_a_part_where_nothing_is_known_keeps_its_guide() -> None:
    points, triangles = strip()
    points, triangles = (
        np.concatenate([points, points + np.array([0, 9, 0])]),
        np.concatenate([triangles, triangles + len(points)]),
    )
    weights = (np.arange(len(points)) < len(points) // 2).astype(float)
    result = membrane(points, triangles, np.ones((len(points), 1)), weights, 2.0)
    np.testing.assert_allclose(result[:, 0], weights, atol=1e-6)


def test_the_gutter_has_the_nearest_texels_value() -> None:
    points, triangles = strip()
    texels = halves(points, triangles)[0][1]
    row, column = np.divmod(texels.at, SIZE)
    picture = spread(texels, np.column_stack([row, column]))
    np.testing.assert_array_equal(picture.reshape(-1, 2)[texels.at], np.column_stack([row, column]))
    away = np.setdiff1d(np.arange(SIZE**2), texels.at)
    there = np.column_stack(np.divmod(away, SIZE))
    distance = np.linalg.norm(picture.reshape(-1, 2)[away] - there, axis=1)
    least = np.linalg.norm(there[:, None] - np.column_stack([row, column])[None], axis=2).min(axis=1)
    np.testing.assert_allclose(distance, least, atol=1e-5)
