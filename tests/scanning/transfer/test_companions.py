"""What goes with the skin of a made-up head, by motions that are known."""

from __future__ import annotations

from functools import cache

import numpy as np
import plain_heads
import pytest
from scipy.spatial.transform import Rotation

from facepipe.geometry.polygons import flipped_triangles, point_triangles
from facepipe.heads.asset import asset
from facepipe.scanning.transfer.companions import Motion, motion_of
from facepipe.scanning.transfer.finish import Finished, finished, mouth_is_sealed
from facepipe.scanning.transfer.pieces import Hints, Inside, Pieces, pieces_of

_OPEN = Rotation.from_rotvec([0.3, 0.0, 0.0])
_HINGE = np.array([0.0, 10.0, -80.0])
_FALL = np.array([0.0, -2.0, 1.0])


def _jaw(points: np.ndarray) -> np.ndarray:
    return _OPEN.apply(points - _HINGE) + _HINGE + _FALL - points


@cache
def _whole(size: float = 1.0) -> tuple[plain_heads.PlainHead, Pieces, Motion]:
    """A head that is `size` times the template; the template's inside is the head's own, scaled back."""
    head = plain_heads.head()
    pieces = pieces_of(size * head.points, head.triangles, size * head.landmarks)
    deltas = {name: np.zeros_like(head.points) for name in ("eyeBlinkLeft", "browInnerUp", "eyeLookInLeft")}
    opened = np.zeros_like(head.points)
    for name in ("lower", "tongue"):
        opened[head.of(name)] = _jaw(head.points[head.of(name)])
    out = np.zeros_like(head.points)
    out[head.of("tongue")] = [0.0, 1.0, 25.0]
    inside = Inside(
        points=size * head.points,
        balls={side: head.of(f"eye{side}") for side in plain_heads.EYES},
        upper=head.of("upper"),
        lower=head.of("lower"),
        tongue=head.of("tongue"),
    )
    return (
        head,
        pieces,
        Motion(neutral=head.points, deltas={**deltas, "jawOpen": opened, "tongueOut": out}, inside=inside),
    )


def _made(name: str, skin: np.ndarray, size: float = 1.0) -> tuple[plain_heads.PlainHead, Finished]:
    head, pieces, motion = _whole(size)
    return head, finished(size * head.points, head.triangles, size * head.landmarks, pieces, motion, {name: skin})


@pytest.mark.parametrize("size", [1.0, 1.25])
def test_lower_teeth_and_tongue_go_with_the_jaw_and_nothing_else_inside(size: float) -> None:
    head, made = _made("jawOpen", np.zeros_like(plain_heads.head().points), size)
    delta = made.deltas["jawOpen"]
    for name in ("lower", "tongue"):
        assert np.allclose(delta[head.of(name)], size * _jaw(head.points[head.of(name)]), atol=1e-6)
    for name in ("upper", "eyeLeft", "glasses", "hat", "lashesLeft", "browLeft"):
        assert np.abs(delta[head.of(name)]).max() < 1e-9


def test_the_tongue_goes_out_as_the_template_s() -> None:
    head, made = _made("tongueOut", np.zeros_like(plain_heads.head().points))
    assert np.allclose(made.deltas["tongueOut"][head.of("tongue")], [0.0, 1.0, 25.0], atol=0.5)
    assert not made.deltas["tongueOut"][head.of("lower")].any()


def test_looks_turn_an_eyeball_about_its_own_middle() -> None:
    head, made = _made("eyeLookInLeft", np.zeros_like(plain_heads.head().points))
    own, delta = head.of("eyeLeft"), made.deltas["eyeLookInLeft"]
    centre = np.append(plain_heads.EYES["Left"], -12.0)
    turned = Rotation.from_rotvec([0.0, -0.5, 0.0]).apply(head.points[own] - centre) + centre
    assert np.allclose(head.points[own] + delta[own], turned, atol=0.03)
    front = own[head.points[own, 2].argmax()]
    assert delta[front, 0] < -5.0  # towards the nose
    assert not delta[head.of("eyeRight")].any()


def test_brows_follow_the_skin_under_them() -> None:
    head = plain_heads.head()
    turn = Rotation.from_rotvec([0.2, 0.0, 0.0])
    skin = turn.apply(head.points) + np.array([0.0, 3.0, 0.0]) - head.points  # all skin in one rigid motion
    _, made = _made("browInnerUp", skin)
    for name in ("browLeft", "browRight"):
        assert np.allclose(made.deltas["browInnerUp"][head.of(name)], skin[head.of(name)], atol=0.15)
    assert not made.deltas["browInnerUp"][head.of("hat")].any()


def test_a_layer_goes_with_the_skin_that_faces_as_it_does() -> None:
    head, _, motion = _whole()
    other, faces = plain_heads.skin(spacing=6.0)
    points = np.concatenate([head.points, other - [0.0, 0.0, 2.0]])
    triangles = np.concatenate([head.triangles, faces + len(head.points)])
    pieces = pieces_of(points, triangles, head.landmarks)
    turn = Rotation.from_rotvec([0.1, 0.0, 0.05])
    skin = turn.apply(points) + np.array([0.0, 2.0, 1.0]) - points
    made = finished(points, triangles, head.landmarks, pieces, motion, {"mouthLeft": skin})
    own = np.arange(len(head.points), len(points))
    assert np.allclose(made.deltas["mouthLeft"][own], skin[own], atol=0.25)


def test_lashes_keep_to_their_lid_in_a_blink() -> None:
    head, made = _made("eyeBlinkLeft", np.zeros_like(plain_heads.head().points))
    delta, own = made.deltas["eyeBlinkLeft"], head.of("lashesLeft")
    roots, tips = own[: len(own) // 2], own[len(own) // 2 :]
    middle = np.abs(head.points[roots, 0] - plain_heads.EYES["Left"][0]).argmin()
    assert delta[roots[middle], 1] < -6.0
    before, after = (
        np.linalg.norm(points[tips] - points[roots], axis=1) for points in (head.points, head.points + delta)
    )
    assert np.allclose(before, after, rtol=0.1)  # no lash is stretched
    assert (head.points + delta)[tips[middle], 1] < (head.points + delta)[roots[middle], 1]  # they point down
    assert not delta[head.of("lashesRight")].any()
    verdict = made.verdicts[0]
    assert verdict.made
    assert verdict.lids is not None
    assert verdict.lids.gap_most <= 0.4
    skin = head.triangles[(head.part[head.triangles] == 0).all(axis=1)]
    assert not flipped_triangles(head.points, head.points + delta, skin).any()
    assert set(made.inbetweens["eyeBlinkLeft"]) == {0.25, 0.5, 0.75}


def test_what_cannot_be_is_said() -> None:
    head = plain_heads.head(names=("hat",), holes=False)
    pieces = pieces_of(head.points, head.triangles, head.landmarks, Hints(names=("Hat",)))
    nothing = np.zeros(0, np.int64)
    globe = _whole()[2].inside
    inside = Inside(points=globe.points, balls=globe.balls, upper=nothing, lower=nothing, tongue=nothing)
    motion = Motion(neutral=globe.points, deltas={}, inside=inside)
    names = ("eyeBlinkLeft", "eyeLookUpRight", "tongueOut", "jawOpen", "mouthSmileLeft")
    made = finished(
        head.points,
        head.triangles,
        head.landmarks,
        pieces,
        motion,
        {name: np.zeros_like(head.points) for name in names},
    )
    assert {one.name: one.verdict for one in made.verdicts} == {
        "eyeBlinkLeft": "not made: eyes are paint",
        "eyeLookUpRight": "not made: eyes are paint",
        "tongueOut": "not made: no tongue",
        "jawOpen": "made as carried: lips are sealed",
        "mouthSmileLeft": "made",
    }
    assert set(made.deltas) == {"jawOpen", "mouthSmileLeft"}
    assert "no teeth" in made.notes


@pytest.mark.parametrize("holes", [True, False])
def test_a_sealed_mouth_is_told_by_the_way_over_it(*, holes: bool) -> None:
    points, triangles = plain_heads.skin(holes=holes)
    assert mouth_is_sealed(points, triangles, plain_heads.landmarks()) is not holes


def test_the_inside_of_the_head_in_the_box_is_found() -> None:
    head = asset()
    triangles = point_triangles(head.counts, head.indices)
    deltas = {name: 10.0 * head.shapes[name][1.0].astype(np.float64) for name in ("jawOpen", "tongueOut")}
    points = 10.0 * head.points
    motion = motion_of(points, triangles, points[head.landmarks], deltas, 1.2 * points)
    inside, teeth = motion.inside, head.parts["Teeth"].points
    down = np.linalg.norm(deltas["jawOpen"], axis=1) > 5.0
    every = np.arange(teeth.start, teeth.stop)
    assert set(inside.lower) == set(every[down[every]])
    assert set(inside.upper) == set(every[~down[every]])
    for side in plain_heads.EYES:
        ball = head.parts[f"Eyeball{side}"].points
        assert np.array_equal(inside.balls[side], np.arange(ball.start, ball.stop))
    gums = head.parts["GumsAndTongue"].points
    assert len(inside.tongue) > 100
    assert gums.start <= inside.tongue.min() <= inside.tongue.max() < gums.stop
    assert np.isclose(motion.size, 1.2)
    opened = motion.jaw("jawOpen", inside.points[inside.lower])
    assert opened is not None
    assert np.allclose(opened, 1.2 * deltas["jawOpen"][inside.lower], atol=0.4)
    assert motion.jaw("tongueOut", inside.points[:3]) is not None  # the jaw opens for it
