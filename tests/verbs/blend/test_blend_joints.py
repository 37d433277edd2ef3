"""Sources whose joints are called otherwise, lie elsewhere, are more, fewer or none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from blend_faces import changed, head, only_shapes, same
from faces import replace_mesh, tiny_face
from test_blend_align import ABOUT_MM, off, placed

from facepipe.core.errors import TopologyError
from facepipe.parts import FaceParts, Mesh
from facepipe.rig import build
from facepipe.rig.joint_names import joint_key
from facepipe.rig.trs import rest_worlds
from facepipe.stage import Face
from facepipe.verbs.blend import BlendSession, Weights
from facepipe.verbs.blend.result import result_parts

WEIGHTS = Weights(regions={"mouth": (0.2, 0.8)}, default=(0.5, 0.5))


def person(number: int) -> FaceParts:
    return replace(only_shapes(head("sample", number), "jawOpen"), bone_limits=None)


def rigged(parts: FaceParts, names: Sequence[str], kept: Sequence[int] | None = None) -> FaceParts:
    """The face with its joints renamed, those alone whose numbers are `kept`; weights of others go to the first."""
    kept = range(len(names)) if kept is None else kept
    skeleton, numbers = parts.skeleton, np.zeros(len(names), np.int32)
    numbers[list(kept)] = np.arange(len(kept))
    joints = tuple(names[number] for number in kept)
    worlds = rest_worlds(skeleton)[list(kept)]
    new = replace(skeleton, joints=joints, joint_names=(), bind_transforms=skeleton.bind_transforms[list(kept)])
    above = [np.eye(4) if parent < 0 else np.linalg.inv(worlds[parent]) for parent in new.parents]
    new = replace(new, rest_transforms=np.array([up @ world for up, world in zip(above, worlds, strict=True)]))

    def reskinned(mesh: Mesh) -> Mesh:
        if mesh.skin is None:
            return mesh
        return replace_mesh(mesh, skin=replace(mesh.skin, joint_indices=numbers[mesh.skin.joint_indices]))

    return replace(changed(parts, reskinned), skeleton=new)


def without_joints(parts: FaceParts) -> FaceParts:
    """The face with shapes alone."""
    none = np.zeros((0, 4, 4))
    skeleton = replace(parts.skeleton, joints=(), joint_names=(), bind_transforms=none, rest_transforms=none)
    bare = changed(parts, lambda mesh: replace_mesh(mesh, skin=None))
    return replace(bare, skeleton=skeleton, sliders=(), animations=(), bone_limits=None)


def blend(*parts: FaceParts, weights: Weights = WEIGHTS) -> tuple[FaceParts, str]:
    """The result, and all warnings."""
    session = BlendSession([Face.from_parts(one) for one in parts])
    return result_parts(session, session.solve(weights)), "\n".join(session.sources.warnings)


def alike(found: FaceParts, expected: FaceParts) -> None:
    """The same points, shapes and joints, and the same way to pose."""
    assert found.skeleton.joints == expected.skeleton.joints
    assert off(found, expected) <= ABOUT_MM
    rng = np.random.default_rng(0)
    coefficients = np.tile([0.0] * 6 + [1.0] * 3, (len(found.skeleton.joints), 1))
    coefficients[:, 3:6] = rng.uniform(-0.2, 0.2, (len(coefficients), 3))
    one, other = (build(face).evaluate(coefficients=coefficients) for face in (found, expected))
    same(one, other, 10 * ABOUT_MM / (1000.0 * expected.meters_per_unit))


@pytest.fixture(scope="module")
def plain() -> FaceParts:
    return blend(person(0), person(1))[0]


def test_names_may_have_a_namespace_another_case_and_other_paths(plain: FaceParts) -> None:
    """Without a word: nothing is guessed."""
    joints = person(1).skeleton.joints
    for names in (
        ["/".join(f"mixamorig_{part}" for part in joint.split("/")) for joint in joints],
        [joint.upper() for joint in joints],
        [joint.rpartition("/")[2] for joint in joints],
    ):
        found, warnings = blend(person(0), rigged(person(1), names))
        assert "joints" not in warnings
        alike(found, plain)


def test_another_order_is_none(plain: FaceParts) -> None:
    """To the bit: parents stay before their children."""
    joints = person(1).skeleton.joints
    order = sorted(range(len(joints)), key=lambda number: (joints[number].count("/"), -number))
    found, warnings = blend(person(0), rigged(person(1), joints, order))
    assert "joints" not in warnings
    np.testing.assert_allclose(found.skeleton.bind_transforms, plain.skeleton.bind_transforms, atol=1e-12)
    alike(found, plain)


def test_joints_of_other_names_are_found_by_their_place() -> None:
    """Also where the source lies turned and is larger; the warning names them.

    This person's jaw is more than 3 mm off its place, and all other joints are far.
    """
    other = person(3)
    joints, plain = other.skeleton.joints, blend(person(0), other)[0]
    number = next(i for i, joint in enumerate(joints) if joint.endswith("jaw"))
    names = [joint.replace(joints[number], joints[number].replace("jaw", "mandible")) for joint in joints]
    assert names != list(joints)
    for by in ("unit", "root"):
        found, warnings = blend(person(0), placed(rigged(other, names), 30.0, 1.2, by))
        assert f"joints found by their place, not by name: 1 ({names[number]} for {joints[number]})" in warnings
        alike(found, plain)


def test_joints_that_a_source_lacks_are_carried_on_its_surface() -> None:
    """A source that is the first one but for its jaw gives its very jaw back, wherever it lies."""
    one, joints = person(0), person(0).skeleton.joints
    number = next(i for i, joint in enumerate(joints) if joint.endswith("jaw"))
    kept = [i for i, joint in enumerate(joints) if not joint.startswith(joints[number])]
    found, warnings = blend(one, rigged(one, joints, kept))
    assert f"joints that it lacks keep their place on the surface of </Face>: {len(joints) - len(kept)} (" in warnings
    same(found.skeleton.bind_transforms[:, :3, 3], one.skeleton.bind_transforms[:, :3, 3], 1e-5)
    np.testing.assert_allclose(found.skeleton.bind_transforms, one.skeleton.bind_transforms, atol=1e-5)
    np.testing.assert_allclose(found.skeleton.rest_transforms, one.skeleton.rest_transforms, atol=1e-5)
    larger, _ = blend(one, placed(rigged(one, joints, kept), 14.0, 1.2, "points"))
    assert off(larger, blend(one, one)[0]) <= ABOUT_MM
    np.testing.assert_allclose(larger.skeleton.rest_transforms, one.skeleton.rest_transforms, atol=1e-4)


def test_a_source_without_joints_moves_the_joints_of_the_first_with_its_surface() -> None:
    one, other = person(0), person(1)
    still = without_joints(other)
    found, warnings = blend(one, still, weights=Weights(default=(0.0, 1.0)))
    assert f"keep their place on the surface of </Face>: {len(one.skeleton.joints)} (" in warnings
    full = blend(one, other, weights=Weights(default=(0.0, 1.0)))[0]
    mm = 1000.0 * one.meters_per_unit
    places = [face.skeleton.bind_transforms[:, :3, 3] * mm for face in (found, full, one)]
    carried, moved = (np.linalg.norm(places[number] - places[1], axis=1) for number in (0, 2))
    assert carried.mean() < 0.6 * moved.mean(), "nearer to the other's own than the first one's are"
    assert {mesh.name for mesh in found.meshes if mesh.skin} == {mesh.name for mesh in one.meshes if mesh.skin}


def test_joints_that_the_first_lacks_give_their_weights_to_those_above() -> None:
    one = person(0)
    joints = one.skeleton.joints
    number = next(i for i, joint in enumerate(joints) if joint.endswith("jaw"))
    parent = int(one.skeleton.parents[number])
    kept = [i for i, joint in enumerate(joints) if not joint.startswith(joints[number])]
    base = rigged(one, joints, kept)
    found, warnings = blend(base, one, weights=Weights(default=(0.0, 1.0)))
    said = f"their skin weights go to those above: {len(joints) - len(kept)} ({joints[number]}"
    assert said in warnings
    for mesh, before in zip(found.meshes, one.meshes, strict=True):
        if mesh.skin is None or before.skin is None:
            continue
        full = np.zeros((len(mesh.points), len(joints)))
        np.add.at(full, (np.arange(len(full))[:, None], before.skin.joint_indices), before.skin.joint_weights)
        gone = [i for i in range(len(joints)) if i not in kept]
        full[:, parent] += full[:, gone].sum(axis=1)
        own = np.zeros((len(full), len(kept)))
        np.add.at(own, (np.arange(len(full))[:, None], mesh.skin.joint_indices), mesh.skin.joint_weights)
        np.testing.assert_allclose(own, full[:, kept], atol=1e-6)


def test_a_first_source_without_joints_takes_none() -> None:
    """Meshes of the other, whose skins went, stand where they stood."""
    bare = without_joints(tiny_face(0))
    spaces = np.diag([2.0, 2, 2, 1])

    def skinned(mesh: Mesh) -> Mesh:
        skin = mesh.skin and replace(mesh.skin, geom_bind_transform=spaces)
        return replace_mesh(mesh, points=mesh.points / 2, transform=spaces, skin=skin)

    other = changed(tiny_face(1), skinned)
    weights = Weights(default=(0.0, 1.0))
    found, warnings = blend(bare, other, weights=weights)
    assert "joints that </Tiny> lacks are left out" in warnings
    assert not found.skeleton.joints
    plain, _ = blend(bare, without_joints(tiny_face(1)), weights=weights)
    same(build(found).points, build(plain).points, 1e-5)


def test_names_of_programs_are_one() -> None:
    for name in ("mixamorig:Head", "mixamorig_Head", "DEF-head", "rig|HEAD", "actor:head"):
        assert joint_key(name) == "head"
    assert joint_key("eye_L") == joint_key("LeftEye")


def test_a_joint_without_size_is_one_line() -> None:
    other = person(1)
    bind = np.array(other.skeleton.bind_transforms)
    bind[:, :3, :3] = 0.0
    flat = replace(other, skeleton=replace(other.skeleton, bind_transforms=bind))
    names = [f"x{number}" for number in range(len(bind))]
    with pytest.raises(TopologyError, match="singular"):
        blend(person(0), rigged(flat, names))
