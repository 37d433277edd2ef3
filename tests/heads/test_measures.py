"""Sliders of measures, on the data that ships: each moves its own measure, and the others hardly."""

from __future__ import annotations

import head_scripts  # noqa: F401  (finds the modules of samples/head/)
import measures
import numpy as np
import pytest
from directions import REACH
from masks import masks

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.similarity import fit_similarity
from facepipe.heads import make
from facepipe.heads.assembly import directions, identity_sliders
from facepipe.heads.asset import arrays, asset
from facepipe.stage import Face

MM = 10.0  # of a centimetre


@pytest.fixture(scope="module")
def effects() -> FloatArray:
    """What the slider of each direction does to each measure, both in standard deviations of the measure."""
    head, deviations = asset(), arrays("measures")["deviations"]
    functionals = measures.functionals(measures.spots(head.points, head.landmarks))
    face = Face.from_parts(make(0))
    names = [direction.name for direction in directions()[: len(deviations)]]
    moved = np.stack([face.evaluate(sliders={name: 1.0})[: measures.SKIN] for name in names])
    moved -= face.evaluate()[: measures.SKIN]
    return np.einsum("dnc,enc->de", functionals, moved, optimize=True) / deviations[:, None] / REACH


def test_a_direction_moves_its_measure(effects: FloatArray) -> None:
    assert len(effects) >= 30
    np.testing.assert_allclose(np.diag(effects), 1.0, atol=0.05)


def test_a_direction_leaves_the_other_measures(effects: FloatArray) -> None:
    others = np.abs(effects[~np.eye(len(effects), dtype=bool)])
    assert others.max() <= 0.1
    assert np.median(others) <= 0.01


def test_no_point_moves_further_than_3_mm_per_mm() -> None:
    for one, deviation in zip(directions(), arrays("measures")["deviations"], strict=False):
        farthest = MM * np.linalg.norm(one.offsets, axis=1).max()
        assert farthest <= 3.0 * REACH * deviation, one.name


def test_directions_are_symmetric_and_their_halves_add_up() -> None:
    from scipy.spatial import cKDTree

    points = asset().points
    other = cKDTree(points[: measures.SKIN]).query(points[: measures.SKIN] * (-1, 1, 1))[1]
    for direction in directions():
        skin = direction.offsets[: measures.SKIN]
        assert np.abs(skin - skin[other] * (-1, 1, 1)).max() < 0.02, direction.name
        if direction.sided:
            left, right = direction.shapes
            assert np.abs(left.offsets + right.offsets - direction.offsets).max() < 0.0021, direction.name
            assert not left.offsets[points[:, 0] < -1.01].any()


def test_eyeballs_go_along_as_a_whole() -> None:
    face = Face.from_parts(make(0))
    rest, names = face.evaluate(), [mesh.name for mesh in face.parts().meshes]
    ends = np.cumsum([0, *(len(mesh.points) for mesh in face.parts().meshes)])
    for name in ("eyeSpacing", "eyeHeight", "eyeWidth", "headWidth"):
        moved = face.evaluate(sliders={name: 1.0})
        for side in ("Left", "Right"):
            ball = slice(*ends[names.index(f"Eyeball{side}") :][:2])
            fit = fit_similarity(rest[ball], moved[ball])
            assert np.abs(fit.apply(rest[ball]) - moved[ball]).max() < 1e-4, name
            assert np.abs(fit.rotation - np.eye(3)).max() < 1e-4, name
            margins = [one[ball].mean(axis=0) - one[: ends[1]][lids(side)].mean(axis=0) for one in (rest, moved)]
            assert np.linalg.norm(margins[1] - margins[0]) < 0.15, name  # cm


def lids(side: str) -> IntArray:
    """The landmarks around an eye."""
    return np.asarray(asset().landmarks[42:48] if side == "Left" else asset().landmarks[36:42])


def test_masks_sum_to_one() -> None:
    head = asset()
    found = masks(head.points, {name: part.points for name, part in head.parts.items()})
    np.testing.assert_allclose(found.sum(axis=(0, 1)), 1.0, atol=1e-12)


def test_sliders_have_names_of_their_own_and_mutual_mirrors() -> None:
    sliders = {slider.name: slider for slider in identity_sliders()}
    measured = set(arrays("measures")["names"].tolist())
    assert len(sliders) == len(identity_sliders())
    assert measured <= set(sliders)
    mixes = {name for name, slider in sliders.items() if slider.mirror is None} - measured
    assert len(mixes) >= 30
    for slider in sliders.values():
        reach = 1.5 if slider.name.removesuffix("Left").removesuffix("Right") in measured else 1.0
        assert (slider.minimum, slider.maximum) == (-reach, reach)
        if slider.mirror:
            assert sliders[slider.mirror].mirror == slider.name


@pytest.mark.parametrize("seed", [0, 3, pytest.param(7, marks=pytest.mark.slow)])
def test_childlike_gives_the_proportions_of_a_child(seed: int) -> None:
    """Eyes low on a high head and wide for the face; a short nose, a small low face, a narrow mouth and neck."""
    face, marks = Face.from_parts(make(seed)), asset().landmarks
    names = list(measures.MEASURES)
    functionals = measures.functionals(measures.spots(asset().points, marks))

    def proportions(value: float) -> FloatArray:
        points = face.evaluate(sliders={"childlike": value})[: measures.SKIN]
        lengths = np.einsum("dnc,nc->d", functionals, points)
        neck, head = (lengths[names.index(name)] for name in ("neckWidth", "headWidth"))
        at, crown = points[marks], points[:, 1].max()
        chin, eyes, nose = at[8, 1], at[36:48, 1].mean(), at[33, 1]
        across = {ends: np.linalg.norm(at[ends[0]] - at[ends[1]]) for ends in ((0, 16), (36, 39), (48, 54))}
        return np.array(
            [
                (eyes - chin) / (crown - chin),
                across[0, 16] / across[36, 39],
                (at[27, 1] - nose) / (crown - chin),
                (nose - chin) / (crown - chin),
                across[48, 54] / across[0, 16],
                neck / head,
            ]
        )

    child, half, adult = (proportions(value) for value in (1.0, 0.5, 0.0))
    assert (child < np.array([0.95, 0.975, 0.9, 0.92, 0.92, 0.85]) * adult).all()
    assert (half < adult).all()
