"""What made-up faces bring out of a blend: odd spaces, still shapes, squashed eyes, missing anchors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faces import grid_mesh, replace_mesh, tiny_face

import facepipe
from facepipe.checks import validate
from facepipe.core.errors import InputError, TopologyError
from facepipe.parts import Blendshape, FaceParts, Inbetween, Mesh
from facepipe.stage import Face, save_parts
from facepipe.verbs.blend import Blend, BlendOptions, BlendSession, Weights
from facepipe.verbs.blend.quality import measure
from facepipe.verbs.blend.result import result_parts

HALF = Weights(default=(0.5, 0.5))


def session(*parts: FaceParts, **options: Any) -> BlendSession:
    return BlendSession([Face.from_parts(part) for part in parts], BlendOptions(**options))


def with_meshes(parts: FaceParts, *meshes: Mesh) -> FaceParts:
    return replace(parts, meshes=meshes)


def eye(squash: float = 1.0) -> Mesh:
    """A ball in front of the grid, and a shape that squashes it (1: only moves it)."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(60, 3))
    points = directions / np.linalg.norm(directions, axis=1, keepdims=True) + (0.0, 2.0, 1.5)
    faces = np.array([(i, (i + 7) % 60, (i + 19) % 60) for i in range(60)], np.int32)
    moved = (points - points.mean(axis=0)) * (1.0, squash, 1.0) - (points - points.mean(axis=0)) + (0.3, 0.0, 0.0)
    shape = Blendshape(name="look", point_indices=np.arange(60, dtype=np.int32), offsets=moved)
    return Mesh(
        name="Eyeball",
        points=points,
        face_vertex_counts=np.full(60, 3, np.int32),
        face_vertex_indices=faces.ravel(),
        blendshapes=(shape,),
    )


def test_the_skeletons_own_transform_counts() -> None:
    """A source whose skeleton stands turned, moved and scaled in its world blends like one that does not."""
    base, other = tiny_face(0), tiny_face(1)
    place = np.array([[0, 0, 2.0, 1], [2, 0, 0, 2], [0, 2, 0, 3], [0, 0, 0, 1.0]])
    back, rest = np.linalg.inv(place), other.skeleton.rest_transforms
    placed = replace(
        other,
        skeleton=replace(
            other.skeleton,
            transform=place,
            bind_transforms=back @ other.skeleton.bind_transforms,
            rest_transforms=np.concatenate([back @ rest[:1], rest[1:]]),
        ),
        meshes=tuple(
            replace_mesh(mesh, skin=replace(mesh.skin, geom_bind_transform=back)) if mesh.skin else mesh
            for mesh in other.meshes
        ),
    )
    plain = session(base, other).solve(HALF)
    turned = session(base, placed)
    np.testing.assert_allclose(turned.solve(HALF).neutral.points, plain.neutral.points, atol=1e-6)
    large = session(placed, placed)
    assert large.sources.mm_per_unit == pytest.approx(2 * session(base, base).sources.mm_per_unit)


def test_shape_normals_turn_beyond_the_moving_points() -> None:
    base = tiny_face(0)
    original = base.meshes[0].blendshapes[0]
    solved = session(base)
    shape = result_parts(solved, solved.solve(Weights())).meshes[0].blendshapes[0]
    still = ~np.isin(shape.point_indices, original.point_indices)
    assert still.any()
    assert not shape.offsets[still].any()
    assert shape.normal_offsets is not None
    assert np.abs(shape.normal_offsets[still]).max() > 0.01


def test_a_shape_that_moves_nothing_stays_on_the_face() -> None:
    base = tiny_face(0)
    still = Blendshape(name="idle", point_indices=np.array([3], np.int32), offsets=np.zeros((1, 3)))
    own = with_meshes(
        base, replace_mesh(base.meshes[0], blendshapes=(*base.meshes[0].blendshapes, still)), base.meshes[1]
    )
    face = Face.from_parts(own)
    Blend(weights=HALF)(face, [Face.from_parts(own), Face.from_parts(own)])
    assert "idle" in Face(face.stage).shapes
    np.testing.assert_array_equal(Face(face.stage).evaluate({"idle": 1.0}), Face(face.stage).evaluate())


def test_inbetweens_of_one_name_at_two_weights_both_stay() -> None:
    base, other = tiny_face(0), tiny_face(1)
    shape = other.meshes[0].blendshapes[0]
    moved = replace(shape, inbetweens=(Inbetween(name="half", weight=0.6, offsets=shape.offsets),))
    other = with_meshes(
        other, replace_mesh(other.meshes[0], blendshapes=(moved, *other.meshes[0].blendshapes[1:])), other.meshes[1]
    )
    solved = session(base, other)
    solution = solved.solve(HALF)
    result = result_parts(solved, solution).meshes[0].blendshapes[0]
    assert [(inbetween.name, round(inbetween.weight, 6)) for inbetween in result.inbetweens] == [
        ("half", 0.5),
        ("half_2", 0.6),
    ]
    assert {"jawOpen", "jawOpen@0.5", "jawOpen@0.6"} <= set(measure(solved, solution)[0].shapes)


@pytest.mark.parametrize(("squash", "kept"), [(1.0, True), (0.6, False)])
def test_only_what_moves_rigidly_in_the_sources_is_made_rigid(squash: float, kept: bool) -> None:
    base = tiny_face(0)
    own = with_meshes(base, base.meshes[0], eye(squash))
    solved = session(own)
    number = [sculpt.name for sculpt in solved.sculpts].index("look")
    assert solved.expression(number)._rigid.all() == kept
    np.testing.assert_allclose(solved.solve(Weights()).offsets[number], eye(squash).blendshapes[0].offsets, atol=1e-6)


def test_an_anchor_that_moves_in_a_shape_changes_nothing_in_it() -> None:
    """The moving part hangs at its static points, not at the anchor."""
    parts = [tiny_face(0), tiny_face(1)]
    moving = int(parts[0].meshes[0].blendshapes[0].point_indices[1])
    weights = Weights(regions={"mouth": (0.9, 0.1)}, default=(0.2, 0.8))
    still, moved = (session(*parts, anchor=f"Head:{point}") for point in (30, moving))
    number = [sculpt.name for sculpt in still.sculpts].index("jawOpen")
    np.testing.assert_allclose(still.solve(weights).offsets[number], moved.solve(weights).offsets[number], atol=1e-9)


def test_the_anchor_is_guessed_on_the_mesh_with_landmarks_and_said() -> None:
    base = tiny_face(0)
    hair = replace_mesh(grid_mesh("Hair", 12, 2.0))
    solved = session(with_meshes(base, hair, replace_mesh(base.meshes[0], anchor=None)))
    assert solved.graph.main[len(hair.points) :].all()
    assert not solved.graph.main[: len(hair.points)].any()
    report, _ = measure(solved, solved.solve(Weights()))
    assert any("no anchor authored, taken from the open border: Head:" in line for line in report.warnings)


def test_smoothing_reaches_loose_meshes_through_the_face() -> None:
    base = tiny_face(0)
    columns = base.meshes[0].points[:, 0]
    regions = {"left": (columns < 0).astype(np.float32), "right": (columns >= 0).astype(np.float32)}
    own = with_meshes(base, replace_mesh(base.meshes[0], regions=regions), replace_mesh(base.meshes[1], regions={}))
    graph = session(own, region_width_mm=30.0).graph
    assert ((graph.masks > 0.01) & (graph.masks < 0.99)).any()
    bridges = graph.bridges
    np.testing.assert_allclose(graph.masks[:, bridges.followers], graph.masks[:, bridges.leaders], atol=1e-12)
    lonely = with_meshes(base, replace_mesh(base.meshes[0], regions={"left": regions["left"]}), own.meshes[1])
    plain, smooth = (session(lonely, region_width_mm=width).graph.masks for width in (0.0, 30.0))
    assert np.abs(plain - smooth).max() > 0.1, "the border of an only region is one with the rest"


def test_masks_that_do_not_sum_to_one_are_said_and_negative_ones_named() -> None:
    base = tiny_face(0)
    head = base.meshes[0]

    def face(mask: np.ndarray) -> BlendSession:
        return session(
            with_meshes(base, replace_mesh(head, regions={"mouth": mask.astype(np.float32)}), base.meshes[1])
        )

    count = len(head.points)
    assert any("sum to more than 1" in note for note in face(np.full(count, 2.0)).graph.notes)
    assert any("sum to less than 1" in note for note in face(np.full(count, 0.5)).graph.notes)
    low = np.full(count, 0.5)
    low[7] = -0.1
    with pytest.raises(InputError, match=r"region mouth -> Head:7: mask -0\.1, expected 0 or more"):
        face(low)
    with pytest.raises(InputError, match="a region of that name"):
        session(with_meshes(base, replace_mesh(head, regions={"default": np.ones(count, np.float32)}), base.meshes[1]))


def test_singular_spaces_and_absurd_sizes_are_refused_before_any_solve() -> None:
    base = tiny_face(0)
    flat = np.diag([1.0, 0.0, 1.0, 1.0])
    skin = base.meshes[0].skin
    assert skin is not None
    singular = with_meshes(
        base, replace_mesh(base.meshes[0], skin=replace(skin, geom_bind_transform=flat)), base.meshes[1]
    )
    with pytest.raises(TopologyError, match="Head: singular transform"):
        session(base, singular)
    points = base.meshes[0].points.copy()
    points[4] = 1e30
    with pytest.raises(InputError, match="units across, expected a face of the size of"):
        session(base, with_meshes(base, replace_mesh(base.meshes[0], points=points), base.meshes[1]))
    with pytest.raises(InputError, match="units across"):
        session(with_meshes(base, *(replace_mesh(mesh, points=mesh.points * 0) for mesh in base.meshes)))


@pytest.mark.parametrize(
    "options",
    [
        {"edges": "cot"},
        {"expressions": "documnt"},
        {"missing": "trasnfer"},
        {"solver": "x"},
        {"static_mm": -1.0},
        {"region_width_mm": float("nan")},
    ],
)
def test_options_are_checked_in_python_too(options: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=f"option {next(iter(options))}"):
        session(tiny_face(0), **options)


def test_turned_and_scaled_sources_are_said() -> None:
    base = tiny_face(0)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = with_meshes(base, *(replace_mesh(mesh, points=3 * mesh.points @ turn.T) for mesh in base.meshes))
    warnings = session(base, turned, align="none").sources.warnings
    assert any("turned by 90 degrees" in line for line in warnings)
    assert any("3.00 times as large" in line for line in warnings)
    assert session(base, base).sources.warnings == ()


def test_what_only_later_sources_have_is_said() -> None:
    base = tiny_face(0)
    other = with_meshes(
        base, replace_mesh(base.meshes[0], regions={**base.meshes[0].regions, "ears": np.zeros(36)}), base.meshes[1]
    )
    bare = with_meshes(base, replace_mesh(base.meshes[0], landmarks={}), base.meshes[1])
    assert session(base, other).sources.warnings == (
        "</Tiny>: region ears: </Tiny> lacks them, and so does the result",
    )
    assert session(bare, base).sources.warnings == (
        "</Tiny>: landmarks corners: </Tiny> lacks them, and so does the result",
    )


def test_flipped_triangles_do_not_depend_on_where_the_sources_lie() -> None:
    base, other = tiny_face(0), tiny_face(3)
    far = with_meshes(
        other, *(replace_mesh(mesh, points=mesh.points + np.array([5.0, 5.0, 0.0])) for mesh in other.meshes)
    )
    weights = Weights(regions={"mouth": (0, 1)}, default=(1, 0))
    near_report, far_report = (
        measure(one, one.solve(weights))[0] for one in (session(base, other), session(base, far))
    )
    assert near_report.flipped_triangles == far_report.flipped_triangles
    for name, shape in near_report.shapes.items():
        assert shape.flipped_triangles == far_report.shapes[name].flipped_triangles


def test_a_session_that_is_not_live_solves_the_same() -> None:
    parts = [tiny_face(0), tiny_face(1)]
    faces = [Face.from_parts(part) for part in parts]
    live, once = BlendSession(faces), BlendSession(faces, live=False)
    for mine, other in zip(live.solve(HALF).offsets, once.solve(HALF).offsets, strict=True):
        np.testing.assert_array_equal(mine, other)
    assert all(once.expression(number)._prepared is None for number in range(len(once.sculpts)))


def test_the_result_of_odd_faces_validates(tmp_path: Path) -> None:
    save_parts(with_meshes(tiny_face(0), tiny_face(0).meshes[0], eye(0.6)), tmp_path / "base.usda")
    base = facepipe.open(tmp_path / "base.usda")
    with base.deriving(tmp_path / "out.usda") as face:
        Blend(weights=HALF)(face, [base, base])
    assert [one for one in validate(tmp_path / "out.usda") if one.severity == "error"] == []
