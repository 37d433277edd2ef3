"""Pieces of a made-up head, whose kinds are known."""

from __future__ import annotations

import numpy as np
import plain_heads
import pytest
import trimesh

from facepipe.geometry.polygons import edges, point_normals
from facepipe.scanning.transfer.pieces import KINDS, Hints, Pieces, named_kind, outer_skin, pieces_of

_KINDS = {
    "skin": "skin",
    "eyeLeft": "left eyeball",
    "eyeRight": "right eyeball",
    "lashesLeft": "lashes",
    "lashesRight": "lashes",
    "browLeft": "brows",
    "browRight": "brows",
    "upper": "upper teeth",
    "lower": "lower teeth",
    "tongue": "tongue",
    "glasses": "still",
    "hat": "still",
}


def _kinds(pieces: Pieces, rows: np.ndarray) -> set[str]:
    return {KINDS[kind] for kind in np.unique(pieces.kind[rows])}


def test_pieces_without_names_are_told_by_place() -> None:
    head = plain_heads.head()
    pieces = pieces_of(head.points, head.triangles, head.landmarks)
    assert {name: _kinds(pieces, head.of(name)) for name in head.names} == {
        name: {kind} for name, kind in _KINDS.items()
    }
    for side, (x, y) in plain_heads.EYES.items():
        globe = pieces.globes[side]
        assert np.allclose(globe.centre, [x, y, -12.0], atol=0.05)
        assert np.isclose(globe.radius, plain_heads.BALL, rtol=0.01)


@pytest.mark.parametrize("scale", [0.8, 1.3])
@pytest.mark.parametrize("bite", [-5.0, 4.0])
def test_rows_of_teeth_are_told_by_their_own_gap(scale: float, bite: float) -> None:
    head = plain_heads.head(names=("upper", "lower", "tongue"), bite=bite)
    turn = trimesh.transformations.rotation_matrix(0.2, [0.3, 1.0, 0.1])[:3, :3]
    points, marks = (scale * one @ turn.T + [30.0, -8.0, 4.0] for one in (head.points, head.landmarks))
    pieces = pieces_of(points, head.triangles, marks)
    assert _kinds(pieces, head.of("upper")) == {"upper teeth"}
    assert _kinds(pieces, head.of("lower")) == {"lower teeth"}
    assert _kinds(pieces, head.of("tongue")) == {"tongue"}


def test_a_piece_that_holds_both_rows_is_parted_at_its_bite() -> None:
    head = plain_heads.head(names=("upper", "lower"))
    first, other = head.of("upper"), head.of("lower")
    # joined behind into one piece
    join = np.array([[first[0], first[40], other[0]], [first[8], first[16], first[0]]])
    chain = [[rows[8 * i], rows[8 * i + 8], rows[8 * i + 9]] for rows in (first, other) for i in range(9)]
    triangles = np.concatenate([head.triangles, join, np.array(chain)])
    pieces = pieces_of(head.points, triangles, head.landmarks)
    assert len(np.unique(pieces.piece[np.append(first, other)])) == 1
    assert _kinds(pieces, first) == {"upper teeth"}
    assert _kinds(pieces, other) == {"lower teeth"}


def test_weights_of_the_jaw_come_before_places() -> None:
    head = plain_heads.head(names=("upper", "lower"))
    jaw = np.zeros(len(head.points))
    jaw[head.of("upper")] = 1.0
    pieces = pieces_of(head.points, head.triangles, head.landmarks, Hints(jaw=jaw))
    assert _kinds(pieces, head.of("upper")) == {"lower teeth"}
    assert _kinds(pieces, head.of("lower")) == {"upper teeth"}


def test_lashes_alone_are_no_eyeballs() -> None:
    head = plain_heads.head(names=("lashesLeft", "lashesRight", "glasses"))
    pieces = pieces_of(head.points, head.triangles, head.landmarks)
    assert not pieces.globes
    assert _kinds(pieces, head.of("lashesLeft")) == {"lashes"}
    assert pieces.notes == ("no teeth",)


def test_layers_of_an_eye_go_together_and_a_glass_before_it_does_not() -> None:
    head = plain_heads.head(names=("eyeLeft",))
    x, y = plain_heads.EYES["Left"]
    cap = trimesh.creation.icosphere(subdivisions=3, radius=7.0)
    cap.update_faces((cap.vertices[cap.faces, 2] > 2.0).all(axis=1))
    cap.remove_unreferenced_vertices()
    glass = trimesh.creation.cylinder(20.0, 1.0)
    count = len(head.points)
    points = np.concatenate(
        [head.points, cap.vertices + np.array([x, y, -5.5]), glass.vertices + np.array([x, y, 22.0])]
    )
    triangles = np.concatenate([head.triangles, cap.faces + count, glass.faces + count + len(cap.vertices)])
    pieces = pieces_of(points, triangles, head.landmarks)
    own = np.arange(count, count + len(cap.vertices))
    assert _kinds(pieces, own) == {"left eyeball"}
    assert _kinds(pieces, np.arange(own[-1] + 1, len(points))) == {"still"}


@pytest.mark.parametrize("into", [0.0, -3.0])
def test_skin_that_is_there_again_is_a_layer_whatever_its_mesh(into: float) -> None:
    head = plain_heads.head(names=("eyeLeft", "glasses"))
    other, faces = plain_heads.skin(spacing=6.0)
    points = np.concatenate([head.points, other + np.array([0.0, 0.0, into])])
    pieces = pieces_of(points, np.concatenate([head.triangles, faces + len(head.points)]), head.landmarks)
    assert _kinds(pieces, np.arange(len(head.points), len(points))) == {"layer"}
    assert _kinds(pieces, head.of("skin")) == {"skin"}
    assert _kinds(pieces, head.of("glasses")) == {"still"}
    assert "other layers of the skin, which go along with it: 1" in pieces.notes


def test_of_a_shell_that_is_joined_at_its_borders_the_outer_side_is_skin() -> None:
    front, faces = plain_heads.skin(spacing=5.0)
    count, inner = len(front), faces[:, ::-1] + len(front)
    pairs, uses = edges(np.full(len(faces), 3), faces.ravel())
    a, b = pairs[uses == 1].T
    rim = np.concatenate([np.stack([a, b, b + count], axis=1), np.stack([a, b + count, a + count], axis=1)])
    points = np.concatenate([front, front - point_normals(front, faces) * 3.0])
    triangles = np.concatenate([faces, inner, rim])
    every = np.arange(len(points))
    outer = outer_skin(points, triangles, every, front, faces)
    assert np.count_nonzero((every < count) != np.isin(every, outer)) < 0.1 * count  # along the rim
    pieces = pieces_of(points, triangles, plain_heads.landmarks(), skin=outer)
    assert _kinds(pieces, outer) == {"skin"}
    assert _kinds(pieces, np.setdiff1d(every, outer)) == {"layer"}


def test_a_plain_skin_has_no_inner_side() -> None:
    front, faces = plain_heads.skin()
    every = np.arange(len(front))
    off = front + np.array([0.0, 0.0, 4.0])
    assert np.array_equal(outer_skin(front, faces, every, off, faces), every)


def test_named_pieces_of_a_second_head_are_none_of_this_one() -> None:
    head = plain_heads.head(names=("upper", "lower", "browLeft"))
    count, own = len(head.points), np.where(head.part == 0, -1, head.part - 1)
    hints = Hints(names=("teeth", "gums", "brow"), name=np.concatenate([own, own]))
    points = np.concatenate([head.points, head.points + np.array([400.0, 0.0, 0.0])])
    pieces = pieces_of(points, np.concatenate([head.triangles, head.triangles + count]), head.landmarks, hints)
    assert _kinds(pieces, head.of("upper")) == {"upper teeth"}
    assert _kinds(pieces, np.arange(count, 2 * count)) == {"still"}


def test_a_mesh_of_all_that_is_named_after_its_hair_is_skin_too() -> None:
    head = plain_heads.head(names=("hat",))
    hints = Hints(names=("Anna_hair_body",), name=np.zeros(len(head.points), np.int64))
    pieces = pieces_of(head.points, head.triangles, head.landmarks, hints, skin=head.of("skin"))
    assert _kinds(pieces, head.of("skin")) == {"skin"}
    assert _kinds(pieces, head.of("hat")) == {"still"}


def test_points_of_no_triangle_are_still() -> None:
    head = plain_heads.head(names=("eyeLeft", "eyeRight"))
    points = np.concatenate([head.points, [[0.0, -30.0, -20.0], [32.0, 35.0, -12.0]]])
    pieces = pieces_of(points, head.triangles, head.landmarks)
    assert _kinds(pieces, np.array([len(points) - 2, len(points) - 1])) == {"still"}


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("CC_Base_Eyelash", "lashes"),
        ("helper-l-eyelashes-1", "lashes"),
        ("helper-upper-teeth", "upper teeth"),
        ("LowerTeeth", "lower teeth"),
        ("Std_Eyelash_Upper", "lashes"),
        ("CC_Base_TearLine", "tear line"),
        ("eyeOcclusion_mesh", "tear line"),
        ("helper-hair", "helper"),
        ("joint-l-eye", "helper"),
        ("EyeGlasses", "still"),
        ("Wolf3D_Glasses", "still"),
        ("Hat", "still"),
        ("Chatter", None),
        ("Wolf3D_Head", None),
        ("eye_left", None),
        ("tongue_geo", "tongue"),
        ("Gums and tongue", None),
        ("eyebrows", "brows"),
        ("Brow_L", "brows"),
        ("Brown_Head", None),
        ("Student", None),
        ("camera_flash", None),
        ("Beard", "growth"),
    ],
)
def test_names_say_what_pieces_are(name: str, kind: str | None) -> None:
    number, _ = named_kind(name)
    assert (KINDS[number] if number >= 0 else None) == kind
