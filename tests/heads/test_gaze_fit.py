"""Lids of drawn people before eyeballs that turn, squint and are changed by sliders."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from contacts import person
from gazes import BOUND, Pose, Poser, gaze_sheets, poses, through_lids
from shared_lids import LOOKS, with_shared_lids

from facepipe.geometry.contacts import Contact, Sheet
from facepipe.heads.assembly import blendshapes_of, make_head, with_own_lids
from facepipe.heads.asset import arrays, asset
from facepipe.heads.people import draw
from facepipe.parts import Blendshape, FaceParts

HARDEST = ("eyeWidth", "eyeSize", "roundEyes")  # sliders of eyes that need it most
FLIP = np.array([-1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def sheets() -> tuple[Sheet, ...]:
    return gaze_sheets(person(0))


@cache
def head(seed: int) -> FaceParts:
    return make_head(draw(seed).identity)


def with_shape(parts: FaceParts, name: str, offsets: dict[float, np.ndarray]) -> FaceParts:
    """The face with another sculpt of a shape of its skin, (n, 3) by weight."""
    skin, *others = parts.meshes
    (made,) = blendshapes_of(asset().parts["Head"], {name: offsets})
    return replace(
        parts,
        meshes=(
            replace(skin, blendshapes=tuple(made if one.name == name else one for one in skin.blendshapes)),
            *others,
        ),
    )


def shape(parts: FaceParts, name: str) -> Blendshape:
    return next(one for one in parts.meshes[0].blendshapes if one.name == name)


def whole(parts: FaceParts, name: str) -> np.ndarray:
    """(n, 3) offsets of the skin at 1."""
    found, one = np.zeros_like(parts.meshes[0].points), shape(parts, name)
    found[one.point_indices] = one.offsets
    return found


def over(parts: FaceParts, sheets: tuple[Sheet, ...], chosen: list[Pose]) -> dict[str, Contact]:
    """The poses with more of an eyeball through lids than a pose may have."""
    poser = Poser(parts)
    found = {pose.name: through_lids(poser.points(pose), sheets) for pose in chosen}
    return {name: one for name, one in found.items() if one.cells > BOUND[0] or one.depth > BOUND[1]}


@pytest.mark.parametrize("seed", [6, pytest.param(5, marks=pytest.mark.slow)])
def test_no_eyeball_comes_through_lids_that_follow_it(seed: int, sheets: tuple[Sheet, ...]) -> None:
    parts = head(seed)
    hard = [pose for pose in poses(parts) if not pose.sliders.keys() - {"lookLeft", "lookDown", *HARDEST}]
    assert over(parts, sheets, hard) == {}
    assert len(over(with_shared_lids(parts), sheets, hard)) >= 3


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2, 14, 23])
def test_no_slider_of_eyes_brings_an_eyeball_through_lids_at_any_look(seed: int, sheets: tuple[Sheet, ...]) -> None:
    assert over(head(seed), sheets, list(poses(head(seed)))) == {}


@pytest.mark.parametrize("seed", [0, 4])
def test_fitted_looks_move_no_eyeball_and_no_skin_but_lids(seed: int) -> None:
    others = np.setdiff1d(np.arange(len(head(seed).meshes[0].points)), arrays("lids")["lids"])
    for name in LOOKS:
        average = asset().shapes[name][1.0][: len(head(seed).meshes[0].points)]
        np.testing.assert_array_equal(whole(head(seed), name)[others], average[others])
        assert not any(one.name == name for mesh in head(seed).meshes[-2:] for one in mesh.blendshapes)


def test_both_eyes_of_the_average_head_look_alike() -> None:
    left, right = arrays("lids")["lids"]
    for name in LOOKS[::2]:
        ends = whole(head(0), name)[left], whole(head(0), name.replace("Left", "Right"))[right]
        assert np.abs(ends[0] * FLIP - ends[1]).max() < 0.02, name  # cm


def test_lids_made_anew_keep_what_somebody_changed_and_what_is_not_named() -> None:
    other, name = head(7), "eyeLookUpLeft"
    points = np.concatenate([mesh.points for mesh in other.meshes])
    forehead = int(other.meshes[0].landmarks["multipie68"].indices[19])
    changed = asset().shapes[name][1.0].astype(np.float64)
    changed[forehead] += [0.0, 0.3, 0.0]
    parts = replace(with_shape(head(0), name, {1.0: changed}), skeleton=other.skeleton)
    made = with_own_lids(parts, points)
    np.testing.assert_array_equal(whole(made, name)[forehead], changed[forehead])
    for one in LOOKS:
        if one != name:
            np.testing.assert_allclose(whole(made, one), whole(other, one), atol=1e-6)
    few = with_own_lids(parts, points, ["eyeSquintLeft"])
    assert shape(few, "eyeLookDownLeft") is shape(parts, "eyeLookDownLeft")
    assert np.abs(whole(few, "eyeSquintLeft") - whole(parts, "eyeSquintLeft")).max() > 1e-3
