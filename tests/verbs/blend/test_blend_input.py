"""What a blend does with bad and odd input: weights, topologies, missing shapes, degenerate meshes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from blend_faces import changed, head, kinds, livelier, misaligned, only_shapes, same, without_shapes
from faces import grid_mesh, replace_mesh, tiny_face

import facepipe
from facepipe.core.errors import FacepipeError, InputError, TopologyError
from facepipe.parts import FaceParts, Mesh
from facepipe.rig import build
from facepipe.stage import Face, save_parts
from facepipe.verbs.blend import Blend, BlendOptions, BlendSession, Weights
from facepipe.verbs.blend.session import _default
from facepipe.verbs.blend.weights import Shares

REGIONS = ("mouth", "neck")
FROM_ANOTHER = {"sample": 0.2, "ict": 0.15}  # RMS a shape's own; the sample's blinks are fitted to each person's lids


def faces(*parts: FaceParts) -> list[Face]:
    return [Face.from_parts(part) for part in parts]


def blend_of(*parts: FaceParts, weights: Weights | None = None, **options: object) -> Face:
    """The blended face."""
    session = BlendSession(faces(*parts), BlendOptions(**options))  # type: ignore[arg-type]
    face = Face.from_parts(parts[0])
    Blend(weights=weights or Weights())(face, session)
    return Face(face.stage)


def test_weights_are_normalised_and_it_is_noted() -> None:
    shares: Shares = Weights(regions={"mouth": (3, 1)}, default=(2, 2)).shares(REGIONS, 2)
    np.testing.assert_allclose(shares.table, [[0.75, 0.25], [0.5, 0.5], [0.5, 0.5]])
    assert sorted(shares.notes) == [
        "weights of default sum to 4, normalised to 1",
        "weights of mouth sum to 4, normalised to 1",
    ]
    assert Weights(regions={"mouth": (0.25, 0.75)}).shares(REGIONS, 2).notes == ()
    huge = Weights(default=(1e308, 1e308)).shares(REGIONS, 2)
    np.testing.assert_allclose(huge.table, 0.5)


def test_unnormalised_weights_blend_as_their_shares_do() -> None:
    session = BlendSession(faces(tiny_face(0), misaligned(tiny_face(1))))
    three, one = (session.solve(Weights(regions={"mouth": row})) for row in ((3, 9), (0.25, 0.75)))
    np.testing.assert_array_equal(three.neutral.points, one.neutral.points)
    assert three.neutral.notes


def test_gains_scale_a_source_everywhere_and_locks_win() -> None:
    weights = Weights(regions={"mouth": (0.5, 0.5)}, gains=(1, 3), locked={"neck": 1})
    np.testing.assert_allclose(weights.shares(REGIONS, 2).table, [[0.25, 0.75], [1, 0], [0.25, 0.75]])


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (Weights(regions={"mouth": (3, -1)}, gains=(0.5, 1)), "weights -> mouth -> source 1: 3 where weights sum to 1"),
        (Weights(regions={"mouth": (0.5, float("nan"))}), "weights -> mouth -> source 2: weight nan, expected"),
        (Weights(default=(float("inf"), 1)), "weights -> default -> source 1: weight inf, expected"),
        (Weights(regions={"mouth": (0, 0)}), "weights -> mouth: no weight above 0"),
        (Weights(default=(1, 0), gains=(0, 1)), "weights -> mouth: the gains leave all weights at 0"),
        (Weights(regions={"mouth": 1}), "weights -> mouth: 1, expected 2, one per source"),  # type: ignore[dict-item]
        (Weights(gains=(0, 0)), "weights -> gains: no weight above 0"),
        (Weights(regions={"mouth": (1, 2, 3)}), "weights -> mouth: 3 weights, expected 2, one per source"),
        (Weights(gains=(1,)), "weights -> gains: 1 weights, expected 2"),
        (Weights(regions={"nose": (1, 0)}), "weights -> nose: no such region, expected one of mouth, neck"),
        (Weights(locked={"nose": 1}), "weights -> nose: no such region"),
        (Weights(locked={"mouth": 3}), "lock -> mouth: source 3, expected a number from 1 to 2"),
        (Weights(locked={"mouth": 0}), "lock -> mouth: source 0, expected a number from 1 to 2"),
    ],
)
def test_weights_that_can_not_be_used_say_which_and_author_nothing(weights: Weights, message: str) -> None:
    base = tiny_face(0)
    face = Face.from_parts(base)
    before = face.stage.GetRootLayer().ExportToString()
    with pytest.raises(InputError) as error:
        Blend(weights=weights)(face, faces(base, tiny_face(1)))
    assert message in str(error.value)
    assert face.stage.GetRootLayer().ExportToString() == before


def with_head(change: Callable[[Mesh], Mesh]) -> FaceParts:
    return changed(tiny_face(1), lambda mesh: change(mesh) if mesh.name == "Head" else mesh)


def one_more_point(mesh: Mesh) -> Mesh:
    return replace_mesh(grid_mesh(size=7), name="Head", skin=None)


def one_face_less(mesh: Mesh) -> Mesh:
    return replace_mesh(
        mesh, face_vertex_counts=mesh.face_vertex_counts[:-1], face_vertex_indices=mesh.face_vertex_indices[:-4]
    )


def other_corners(mesh: Mesh) -> Mesh:
    counts = mesh.face_vertex_counts.copy()
    counts[3:5] = 3, 5
    return replace_mesh(mesh, face_vertex_counts=counts)


def other_point(mesh: Mesh) -> Mesh:
    indices = mesh.face_vertex_indices.copy()
    indices[4 * 7 + 1] = 30
    return replace_mesh(mesh, face_vertex_indices=indices)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (with_head(one_more_point), "Head: 49 points, expected 36 as in a.usda"),
        (with_head(one_face_less), "Head: 24 faces, expected 25 as in a.usda"),
        (with_head(other_corners), "Head: face 3 has 3 corners, expected 4 as in a.usda"),
        (with_head(other_point), "Head: face 7 uses point 30, expected point 9 as in a.usda"),
        (replace(tiny_face(1), meshes=tiny_face(1).meshes[:1]), "no mesh 'Teeth', expected the meshes of a.usda"),
    ],
)
def test_the_first_difference_of_topology_is_named(tmp_path: Path, other: FaceParts, message: str) -> None:
    save_parts(tiny_face(0), tmp_path / "a.usda")
    save_parts(other, tmp_path / "b.usda")
    with pytest.raises(TopologyError) as error:
        BlendSession([facepipe.open(tmp_path / name) for name in ("a.usda", "b.usda")])
    assert str(error.value).startswith("b.usda")
    assert message in str(error.value)


def test_meshes_that_the_base_lacks_are_left_out_with_a_warning() -> None:
    base = replace(tiny_face(0), meshes=tiny_face(0).meshes[:1])
    face = Face.from_parts(base)
    report = Blend()(face, faces(base, tiny_face(1)))
    assert report.warnings == ("</Tiny>: meshes that </Tiny> lacks are left out: Teeth",)


def test_the_order_of_meshes_and_joints_does_not_matter() -> None:
    def forked(parts: FaceParts, order: list[int]) -> FaceParts:
        own, places = parts.skeleton, np.argsort(order)
        joints = [("root", "root/jaw", "root/lip")[i] for i in order]
        skeleton = replace(
            own,
            joints=tuple(joints),
            bind_transforms=own.bind_transforms[order],
            rest_transforms=own.rest_transforms[order],
        )

        def reskinned(mesh: Mesh) -> Mesh:
            if mesh.skin is None:
                return mesh
            indices = places[mesh.skin.joint_indices].astype(np.int32)
            return replace_mesh(mesh, skin=replace(mesh.skin, joint_indices=indices))

        return replace(changed(parts, reskinned), skeleton=skeleton)

    one, two = forked(tiny_face(0), [0, 1, 2]), misaligned(tiny_face(1))
    plain = blend_of(one, forked(two, [0, 1, 2]))
    other = forked(two, [0, 2, 1])
    swapped = blend_of(one, replace(other, meshes=other.meshes[::-1]))
    np.testing.assert_array_equal(swapped.evaluate({"jawOpen": 1.0}), plain.evaluate({"jawOpen": 1.0}))
    np.testing.assert_array_equal(swapped.skeleton.bind_transforms, plain.skeleton.bind_transforms)
    coefficients = np.tile([0.1, 0.2, -0.1, 0.3, 0.2, 0.1, 1.1, 1.0, 0.9], (3, 1))
    same(swapped.evaluate(coefficients=coefficients), plain.evaluate(coefficients=coefficients), 1e-12)


def test_a_missing_shape_names_shape_and_file(tmp_path: Path) -> None:
    save_parts(tiny_face(0), tmp_path / "a.usda")
    save_parts(without_shapes(tiny_face(1), "mouthSmileLeft"), tmp_path / "b.usda")
    with pytest.raises(InputError, match=r"^b\.usda: no shape 'mouthSmileLeft'"):
        BlendSession([facepipe.open(tmp_path / name) for name in ("a.usda", "b.usda")])


def test_skipped_shapes_leave_shapes_sliders_and_clips() -> None:
    clip_shapes = {name for clip in head("sample", 0).animations for name in clip.shapes}
    everything = {blendshape.name for mesh in head("sample", 0).meshes for blendshape in mesh.blendshapes}
    one, two = (without_shapes(head("sample", i), *(everything - clip_shapes)) for i in range(2))
    one = replace(one, sliders=tuple(s for s in one.sliders if {name for name, _ in s.shapes} <= clip_shapes))
    two = without_shapes(two, "mouthSmileLeft")
    assert any(slider.shapes for slider in one.sliders)
    session, face = BlendSession(faces(one, two), BlendOptions(missing="skip")), Face.from_parts(one)
    assert Blend()(face, session).skipped == ("mouthSmileLeft",)
    result = Face(face.stage)
    assert set(result.shapes) == set(Face.from_parts(one).shapes) - {"mouthSmileLeft"}
    assert not any(name == "mouthSmileLeft" for slider in result.sliders for name, _ in slider.shapes)
    clips = {clip.name: clip for clip in result.animations}
    for clip in one.animations:
        kept = [i for i, name in enumerate(clip.shapes) if name != "mouthSmileLeft"]
        assert clips[clip.name].shapes == tuple(clip.shapes[i] for i in kept)
        if clip.shape_weights is not None and kept:
            np.testing.assert_array_equal(clips[clip.name].shape_weights, np.float32(clip.shape_weights)[:, kept])


@kinds("sample", "ict")
@pytest.mark.parametrize("shape", ["jawOpen", "eyeBlinkLeft", "mouthSmileLeft"])
def test_transferred_shapes_are_near_the_ones_that_were_lost(kind: str, shape: str) -> None:
    """Both identities have the shape; one is made to lack it, and what it gets is near what it had."""
    one, two = (only_shapes(head(kind, number), shape) for number in range(2))
    with_it = BlendSession(faces(one, two)).solve(Weights(default=(0.5, 0.5)))
    session = BlendSession(faces(one, without_shapes(two, shape)), BlendOptions(missing="transfer"))
    got = session.solve(Weights(default=(0.5, 0.5)))
    assert [name for name, _ in session.transferred] == [shape]
    for a, b, sculpt in zip(with_it.offsets, got.offsets, with_it.sculpts, strict=True):
        size = np.sqrt((sculpt.offsets**2).sum(axis=2).mean())
        full = np.zeros((2, with_it.neutral.points.shape[0], 3))
        full[0, sculpt.points] = a
        full[1, next(s.points for s in got.sculpts if s.name == sculpt.name)] = b
        error = np.sqrt(((full[0] - full[1]) ** 2).sum(axis=1)[sculpt.points].mean())
        assert error < FROM_ANOTHER[kind] * size  # without it, half
    report = Blend(weights=Weights())(Face.from_parts(one), session)
    assert len(report.transferred) == 1
    assert report.transferred[0].startswith(f"{shape}: ")


def test_transfer_from_several_sources_lies_between_them() -> None:
    """Three heads on one neutral; those that have the shape move 1.0 and 1.3 times as far."""
    own = only_shapes(head("sample", 0), "jawOpen")
    session = BlendSession(
        faces(own, livelier(own, 1.3, 0.0), without_shapes(own, "jawOpen")), BlendOptions(missing="transfer")
    )
    sculpt = next(one for one in session.sculpts if one.inbetween is None)
    same(sculpt.offsets[2], 1.15 * sculpt.offsets[0], 0.02 * float(np.abs(sculpt.offsets[0]).max()))


def closed() -> Mesh:
    """A cube: no border."""
    points = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float64)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return Mesh(
        name="Cube",
        points=points,
        face_vertex_counts=np.full(6, 4, np.int32),
        face_vertex_indices=np.array(quads, np.int32).ravel(),
    )


def test_a_mesh_without_border_needs_an_anchor() -> None:
    cube = FaceParts(name="Cube", meshes=(closed(),))
    wide = changed(cube, lambda mesh: replace_mesh(mesh, points=mesh.points * (3.0, 1, 1)))
    with pytest.raises(InputError, match=r"Cube: no anchor and no open border .* expected an anchor"):
        BlendSession(faces(cube, wide))
    result = blend_of(cube, wide, anchor="Cube:0", align="none")
    same(result.evaluate(), closed().points * (2.0, 1, 1), 1e-6)
    for text in ("Cube:8", "Cube:-1", "Cube", "Ball:0", "Cube:x"):
        with pytest.raises(InputError, match="option anchor"):
            BlendSession(faces(cube, wide), BlendOptions(anchor=text))


def test_an_anchor_lies_on_the_face_and_not_on_a_loose_part() -> None:
    """All else would follow the loose part."""
    with pytest.raises(InputError, match="loose part"):
        BlendSession(faces(tiny_face(0), tiny_face(1)), BlendOptions(anchor="Teeth:4"))


def test_edges_without_length_and_points_without_faces_stay_in_place() -> None:
    """Two points fall together in one source, two in both; one point belongs to no face."""

    def broken(mesh: Mesh, both: bool) -> Mesh:
        points = np.vstack([mesh.points, [[9.0, 9.0, 9.0]]])
        points[8] = points[7]
        points[20] = points[21] if both else points[20]
        return replace_mesh(mesh, points=points, uv_sets=())

    one, two = (FaceParts(name="Grid", meshes=(broken(grid_mesh(), both),)) for both in (True, False))
    two = changed(two, lambda mesh: replace_mesh(mesh, points=mesh.points * (1.0, 2.0, 1.0)))
    session = BlendSession(faces(one, two))
    weights = Weights(default=(0.25, 0.75))
    face = Face.from_parts(one)
    report = Blend(weights=weights)(face, session)
    expected = 0.25 * session.sources.points[0] + 0.75 * session.sources.points[1]
    off = Face(face.stage).evaluate() - expected
    same(off, np.broadcast_to(off[0], off.shape), 1e-6)
    assert any("edges without length" in line for line in report.warnings)


def test_a_face_without_regions_takes_the_default_weights() -> None:
    one, two = (changed(tiny_face(i), lambda mesh: replace_mesh(mesh, regions={}, point_subsets={})) for i in (0, 1))
    two = changed(two, lambda mesh: replace_mesh(mesh, points=mesh.points * (2.0, 1.0, 1.0)))
    session = BlendSession(faces(one, two), BlendOptions(align="none"))
    neutral = session.neutral(Weights(default=(0.25, 0.75)))
    expected = 0.25 * build(one).points + 0.75 * build(two).points
    off = (neutral.points - expected)[:36]
    same(off, np.broadcast_to(off[0], off.shape), 1e-6)
    with pytest.raises(InputError, match="no such region, expected one of none"):
        session.neutral(Weights(regions={"mouth": (1, 0)}))


def test_nothing_to_blend_is_an_error() -> None:
    with pytest.raises(InputError, match="none given"):
        BlendSession([])
    empty = FaceParts(name="Empty")
    with pytest.raises(FacepipeError, match="no points"):
        BlendSession(faces(empty))


def test_not_a_number_never_gets_in() -> None:
    broken = changed(tiny_face(1), lambda mesh: replace_mesh(mesh, points=mesh.points * np.nan))
    with pytest.raises(FacepipeError, match="NaN"):
        BlendSession(faces(tiny_face(0), broken))


def test_one_source_gives_itself_back_with_a_warning() -> None:
    parts = tiny_face(0)
    face = Face.from_parts(parts)
    report = Blend(weights=Weights(regions={"mouth": (0.3,)}))(face, faces(parts))
    result = Face(face.stage)
    for pose in ({}, {"jawOpen": 1.0}, {"jawOpen": 0.5, "mouthSmileLeft": 1.0}):
        same(result.evaluate(pose), Face.from_parts(parts).evaluate(pose), 1e-6)
    assert "one source: the result is that face" in report.warnings


def test_eyeballs_and_teeth_are_known_by_their_names() -> None:
    names = ("Head", "EyeLeft", "EyeRight", "TeethUpper", "Tooth_1", "myEyeballs", "Eyelashes", "EyeLeftWet")
    assert _default(names) == ("EyeLeft", "EyeRight", "TeethUpper", "Tooth_1", "myEyeballs")
