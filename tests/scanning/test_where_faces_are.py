"""Which parts of a mesh are searched for a face, in which order, and which are never looked at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solids import ball

from facepipe.core.errors import InputError
from facepipe.scanning.landmarks.where import Place, Surface, looked_at, places
from facepipe.scans import Scan, ScanHints

Ball = tuple[tuple[float, float, float], tuple[float, float, float]]  # its middle, and its radii along the axes
HEAD = np.array([0.0, 16.0, 0.0])


def mesh(*balls: Ball) -> Scan:
    """Balls, a piece each, named by number."""
    points, triangles, piece, start = [], [], [], 0
    for number, (middle, radii) in enumerate(balls):
        own, corners = ball(16)
        triangles.append(corners + start)
        points.append(own * radii + np.array(middle))
        piece += [number] * len(corners)
        start += len(own)
    return Scan(
        name="body",
        points=np.concatenate(points),
        triangles=np.concatenate(triangles).astype(np.int32),
        hints=ScanHints(pieces=tuple(f"piece{i}" for i in range(len(balls))), piece=np.array(piece, np.int32)),
    )


TORSO: Ball = ((0.0, 7.0, 0.0), (2.0, 7.0, 1.2))
SKULL: Ball = ((0.0, 16.0, 0.0), (0.8, 1.2, 1.0))
ARMS: Ball = ((0.0, 13.0, 0.0), (8.0, 0.4, 0.4))
HELMET: Ball = ((0.0, 16.0, 0.0), (2.0, 2.0, 2.0))


def body() -> Scan:
    return mesh(TORSO, SKULL, ARMS)


def turn(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    return np.asarray(q * np.sign(np.linalg.det(q)))


def tried(surface: Surface) -> list[Place]:
    return [place for level in places(surface) for place in level]


def holds_head(place: Place, surface: Surface, middle: np.ndarray) -> bool:
    """Whether most of what is searched is the head, and all of its face."""
    at = surface.look.points[place.points]
    near = np.linalg.norm(at - middle, axis=1) < 1.5
    skull = np.linalg.norm(surface.look.points - middle, axis=1) < 1.25
    return bool(near.mean() > 0.6 and place.points[skull].mean() > 0.8)


def test_the_top_of_a_body_is_searched_first_whatever_is_up() -> None:
    surface = looked_at(body())
    first = tried(surface)[0]
    assert holds_head(first, surface, HEAD)
    assert "+Y" in first.name
    eyes = [view.eye - HEAD for view in first.views]
    assert eyes[0] @ [0, 0, 1] > 0.9 * np.linalg.norm(eyes[0])  # from the front, upright
    assert all(abs(one[1]) < 0.1 * np.linalg.norm(one) for one in eyes)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_turned_body_is_searched_at_its_ends(seed: int) -> None:
    scan = body()
    moved = replace(scan, points=scan.points @ turn(seed).T * 50.0 + [1e4, 0, -3e4])
    surface = looked_at(moved)
    own = replace(surface, look=replace(surface.look, points=(surface.look.points - [1e4, 0, -3e4]) @ turn(seed) / 50))
    found = [place.name for place in tried(surface) if holds_head(place, own, HEAD)]
    assert found
    assert len(tried(surface)) < 80


def test_a_head_is_searched_as_a_whole_first() -> None:
    surface = looked_at(mesh(((0, 0, 0), (0.8, 1.2, 1.0)), ((0.3, 0.2, 0.9), (0.1, 0.1, 0.1))))
    first = tried(surface)[0]
    assert first.name == "all of it"
    assert (len(first.views), first.turns) == (6, 4)


def test_what_the_heads_joint_carries_is_searched_before_all_else() -> None:
    scan = body()
    scan = replace(scan, hints=replace(scan.hints, head=scan.hints.piece == 1))
    surface = looked_at(scan)
    first = tried(surface)[0]
    assert first.name == "what the joint of the head carries"
    assert np.linalg.norm(surface.look.points[first.points] - HEAD, axis=1).max() < 1.3
    assert first.among.all()  # what is around is seen, too


def test_pieces_are_searched_alone_without_those_that_hide_them() -> None:
    surface = looked_at(mesh(TORSO, SKULL, HELMET))
    alone = [place for place in tried(surface) if place.name.startswith("a piece of")]
    assert any((np.linalg.norm(surface.look.points[place.among] - HEAD, axis=1) < 1.3).all() for place in alone)


@pytest.mark.parametrize("name", ["helper-hair", "joint-l-eye", "UCX_Head_01", "Head-colonly"])
def test_helpers_are_left_out_by_name(name: str) -> None:
    scan = mesh(SKULL, HELMET)
    surface = looked_at(replace(scan, hints=replace(scan.hints, pieces=("head", name))))
    assert np.linalg.norm(surface.look.points - HEAD, axis=1).max() < 1.3
    assert surface.warnings == (f"1 helper pieces are not looked at, such as {name}",)
    whole = looked_at(replace(scan, hints=replace(scan.hints, pieces=(name, name))))  # nothing else is there
    assert np.linalg.norm(whole.look.points - HEAD, axis=1).max() > 1.9


def test_a_component_is_looked_at_alone_and_a_wrong_name_is_refused() -> None:
    surface = looked_at(body(), "piece1")
    assert np.linalg.norm(surface.look.points - HEAD, axis=1).max() < 1.3
    with pytest.raises(InputError, match="body: no component 'face', expected the name of one: piece0, piece1, piece2"):
        looked_at(body(), "face")


def test_large_scans_are_thinned_and_keep_their_place() -> None:
    own, corners = ball(16)
    copies = 300_000 // len(own) + 1
    points = np.concatenate([own * (40.0 + 1e-4 * number) for number in range(copies)])
    triangles = np.concatenate([corners + number * len(own) for number in range(copies)]).astype(np.int32)
    surface = looked_at(Scan(name="large", points=points, triangles=triangles))
    assert surface.thinned
    assert len(surface.look.points) < len(points) / 10
    assert np.abs(np.linalg.norm(surface.look.points, axis=1) - 40.0).max() < 0.2
    assert np.abs(surface.look.points - points[surface.source]).max() < 0.2
