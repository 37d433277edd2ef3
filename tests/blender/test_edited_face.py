"""Faces after a host: what the host changed is changed, all else stays to the bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from facepipe_blender.write_mesh import expressions, key_name, read_key_name
from faces import replace_mesh, tiny_face

from facepipe.hosting.edited_face import edited_face
from facepipe.parts import Blendshape, FaceParts, Inbetween, Recipe, Slider
from facepipe.rig.rig import curves
from facepipe.stage.values import same


def before() -> FaceParts:
    """A face with sliders, in the numbers of a file."""
    parts = tiny_face()
    meshes = tuple(replace_mesh(mesh, points=mesh.points.astype(np.float32)) for mesh in parts.meshes)
    sliders = (Slider(name="open", shapes=(("jawOpen", 1.0),), channels=(("root/jaw", "rx", 0.2),)),)
    return replace(parts, meshes=meshes, sliders=sliders, recipe=Recipe(verb="sample"))


def hosted(parts: FaceParts) -> FaceParts:
    """What a host that stores points of shapes in float32 makes of a face, other joints first."""
    order = (2, 0, 1)
    place = np.argsort(order)

    def through(points: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        return (points + offsets).astype(np.float32) - points

    def shape(one: Blendshape, points: np.ndarray) -> Blendshape:
        own = points[one.point_indices]
        between = tuple(
            Inbetween(name=i.name, weight=i.weight, offsets=through(own, i.offsets)) for i in one.inbetweens
        )
        offsets = through(own, one.offsets)
        return Blendshape(name=one.name, point_indices=one.point_indices, offsets=offsets, inbetweens=between)

    meshes = []
    for mesh in parts.meshes:
        skin = mesh.skin and replace(mesh.skin, joint_indices=place[mesh.skin.joint_indices])
        meshes.append(
            replace_mesh(
                mesh,
                skin=skin,
                blendshapes=tuple(shape(blendshape, mesh.points) for blendshape in mesh.blendshapes),
                landmarks={},
                anchor=None,
            )
        )
    skeleton = parts.skeleton
    joints = tuple(skeleton.joints[i] for i in order)
    turned = replace(skeleton, joints=joints, bind_transforms=skeleton.bind_transforms[list(order)])
    return FaceParts(name="Other", meshes=tuple(meshes), skeleton=turned)


def bones(parts: FaceParts) -> dict[str, np.ndarray]:
    return dict(zip(parts.skeleton.joints, parts.skeleton.bind_transforms, strict=True))


def test_a_face_that_was_not_edited_is_what_it_was() -> None:
    face = before()
    found, warnings = edited_face(face, hosted(face), bones(face))
    assert same(found, face)
    assert warnings == ()


def test_a_sculpted_point_changes_its_shape_alone() -> None:
    face, made = before(), hosted(before())
    head = made.meshes[0]
    shape = head.blendshapes[0]
    offsets = shape.offsets.copy()
    offsets[2] += (0, 0, 0.25)
    moved = replace_mesh(head, blendshapes=(replace(shape, offsets=offsets), *head.blendshapes[1:]))
    found, warnings = edited_face(face, replace(made, meshes=(moved, *made.meshes[1:])), bones(face))
    old, new = face.meshes[0].blendshapes[0], found.meshes[0].blendshapes[0]
    np.testing.assert_allclose(new.offsets - old.offsets, [[0, 0, 0], [0, 0, 0], [0, 0, 0.25], [0, 0, 0]], atol=1e-6)
    assert same(old.inbetweens[0].offsets, new.inbetweens[0].offsets)
    assert same(face.meshes[0].blendshapes[1:], found.meshes[0].blendshapes[1:])
    assert same(face.meshes[0].landmarks, found.meshes[0].landmarks)
    assert warnings == ("recipe of 'sample' left out: the face was edited",)
    assert found.recipe is None


def test_a_bone_that_was_moved_takes_only_itself_along() -> None:
    face, made = before(), hosted(before())
    shift = np.eye(4)
    shift[:3, 3] = (0.1, -0.2, 0.3)
    now = made.skeleton.bind_transforms.copy()
    now[made.skeleton.joints.index("root/jaw")] = shift @ now[made.skeleton.joints.index("root/jaw")]
    found = edited_face(face, replace(made, skeleton=replace(made.skeleton, bind_transforms=now)), bones(face))[0]
    wanted = face.skeleton.bind_transforms.copy()
    wanted[1] = shift @ wanted[1]
    np.testing.assert_allclose(found.skeleton.bind_transforms, wanted, atol=1e-12)
    rest = found.skeleton.rest_transforms
    np.testing.assert_allclose(rest[0] @ rest[1] @ rest[2], wanted[2], atol=1e-12)
    assert same(face.meshes, found.meshes)


def test_joints_that_are_new_leave_the_face_where_it_is() -> None:
    face, place = before(), np.diag([1.0, -1.0, -1.0, 1.0])
    place[:3, 3] = (3, 5, -2)
    then = bones(face)  # what the host shows, before the whole face was bound elsewhere
    meshes = tuple(
        replace_mesh(
            mesh,
            transform=place @ mesh.transform,
            skin=mesh.skin and replace(mesh.skin, geom_bind_transform=place @ mesh.skin.geom_bind_transform),
        )
        for mesh in face.meshes
    )
    skeleton = replace(face.skeleton, bind_transforms=place @ face.skeleton.bind_transforms, transform=place)
    face = replace(face, meshes=meshes, skeleton=skeleton)
    joints = (*skeleton.joints, "root/extra")
    now = np.array([*then.values(), then["root"]])
    made = replace(hosted(face), skeleton=replace(skeleton, joints=joints, bind_transforms=now, rest_transforms=now))
    heads = [replace_mesh(one, skin=old.skin) for one, old in zip(made.meshes, face.meshes, strict=True)]
    found = edited_face(face, replace(made, meshes=tuple(heads)), then)[0]
    np.testing.assert_allclose(found.skeleton.bind_transforms[:-1], skeleton.bind_transforms, atol=1e-12)
    np.testing.assert_allclose(found.skeleton.rest_transforms[:-1], skeleton.rest_transforms, atol=1e-12)
    np.testing.assert_allclose(found.skeleton.bind_transforms[-1], skeleton.bind_transforms[0], atol=1e-12)
    turned = np.roll(heads[0].face_vertex_indices.reshape(-1, 4), 1, axis=1).ravel()
    assert face.meshes[0].skin is not None
    bare = replace(face.meshes[0].skin, geom_bind_transform=np.eye(4))
    other = replace(made, meshes=(replace_mesh(heads[0], face_vertex_indices=turned, skin=bare),))
    (mesh,) = edited_face(face, other, then)[0].meshes
    assert mesh.skin is not None
    np.testing.assert_array_equal(mesh.skin.geom_bind_transform, face.meshes[0].skin.geom_bind_transform)


def test_other_faces_take_landmarks_away_and_say_so() -> None:
    face, made = before(), hosted(before())
    head = made.meshes[0]
    turned = np.roll(head.face_vertex_indices.reshape(-1, 4), 1, axis=1).ravel()
    changed = replace(made, meshes=(replace_mesh(head, face_vertex_indices=turned), *made.meshes[1:]))
    found, warnings = edited_face(face, changed, bones(face))
    assert not found.meshes[0].landmarks
    assert warnings[0] == "Head: topology changed, corners, the anchor left out"
    assert all(shape.normal_offsets is not None for shape in found.meshes[0].blendshapes)


def test_sliders_keep_what_is_still_there() -> None:
    face, made = before(), hosted(before())
    meshes = tuple(replace_mesh(mesh, blendshapes=mesh.blendshapes[1:]) for mesh in made.meshes)
    found, warnings = edited_face(face, replace(made, meshes=meshes), bones(face))
    assert found.sliders == (replace(face.sliders[0], shapes=()),)
    assert any("shapes jawOpen (1 in all)" in line for line in warnings)


@pytest.mark.parametrize("weights", [(0.5,), (0.25, 0.75), (-0.5, 0.5, 1.5)])
def test_drivers_of_inbetween_keys_give_the_sum_that_usd_means(weights: tuple[float, ...]) -> None:
    sculpts = dict(zip((*weights, 1.0), np.random.default_rng(1).normal(size=(len(weights) + 1, 3)), strict=True))
    for value in np.linspace(-1, 2, 25).tolist():
        wanted = sum(float(curve(value)) * sculpts[weight] for weight, curve in curves(weights).items())
        shown = value * sculpts[1.0]
        for weight, formula in expressions(weights, "value").items():
            activation = eval(formula, {"__builtins__": {}, "max": max}, {"value": value})
            shown = shown + activation * (sculpts[weight] - weight * sculpts[1.0])
        np.testing.assert_allclose(shown, wanted, atol=1e-7)


def test_key_names_say_what_they_hold() -> None:
    assert read_key_name(key_name("jawOpen", 0.5, "half")) == ("jawOpen", 0.5, "half")
    assert read_key_name("jawOpen@0.25") == ("jawOpen", 0.25, "at_0_25")
    for plain in ("jawOpen", "a@b", "@0.5", "key@1", "key@nan"):
        assert read_key_name(plain) == (plain, None, "")
