"""Sources are laid on the first one: a face that is turned, larger or elsewhere is the same source."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from blend_faces import changed, head, moved
from faces import replace_mesh
from scipy.spatial.transform import Rotation

from facepipe.core.errors import InputError
from facepipe.parts import FaceParts, Mesh
from facepipe.rig import build
from facepipe.stage import Face
from facepipe.verbs.blend import BlendOptions, BlendSession, Weights
from facepipe.verbs.blend.result import result_parts
from facepipe.verbs.blend.sources import stack

WEIGHTS = Weights(regions={"mouth": (0.2, 0.8), "eyes": (0.9, 0.1)}, default=(0.5, 0.5))
ABOUT_MM = 0.005


def few(number: int) -> FaceParts:
    """One of two people with a few shapes."""
    shapes = ("jawOpen", "eyeBlinkLeft", "mouthSmileLeft")

    def lean(mesh: object) -> object:
        return replace_mesh(mesh, blendshapes=tuple(one for one in mesh.blendshapes if one.name in shapes))

    return replace(changed(head("sample", number), lean), sliders=(), animations=())


def placed(parts: FaceParts, degrees: float, scale: float = 1.0, by: str = "unit") -> FaceParts:
    """The face turned, moved and larger.

    :param by: what makes it larger: the unit, its points, its root joint (at bind time and at rest, or at rest alone),
        or the transforms of what it stands in
    """
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.array([0.48, 0.6, 0.64])).as_matrix()
    matrix[:3, 3] = (3.0, -20.0, 7.0)
    if by == "unit":
        return replace(moved(parts, matrix), meters_per_unit=scale * parts.meters_per_unit)
    larger = matrix @ np.diag([scale, scale, scale, 1.0])
    skeleton, roots = parts.skeleton, parts.skeleton.parents < 0
    if by == "transforms":
        meshes = changed(parts, lambda mesh: replace_mesh(mesh, transform=larger @ mesh.transform))
        return replace(meshes, skeleton=replace(skeleton, transform=larger @ skeleton.transform))
    if by == "rest":
        rest = np.array(skeleton.rest_transforms, np.float64)
        rest[roots] = larger @ rest[roots]
        return replace(parts, skeleton=replace(skeleton, rest_transforms=rest))
    whole = moved(parts, larger)
    if by == "root":
        return whole
    bind, rest = np.array(whole.skeleton.bind_transforms), np.array(whole.skeleton.rest_transforms)
    bind[:, :3, :3] /= scale
    rest[roots, :3, :3] /= scale
    rest[~roots, :3, 3] *= scale
    return replace(whole, skeleton=replace(whole.skeleton, bind_transforms=bind, rest_transforms=rest))


def blend(*parts: FaceParts, align: str = "landmarks", weights: Weights = WEIGHTS) -> FaceParts:
    options = BlendOptions(align=align)
    session = BlendSession([Face.from_parts(one) for one in parts], options)
    return result_parts(session, session.solve(weights))


def off(found: FaceParts, expected: FaceParts) -> float:
    """The largest distance in millimetres between points, shapes and joints, at bind time and at rest."""
    one, other = build(found), build(expected)
    distances = [np.linalg.norm(one.points - other.points, axis=1).max()]
    for shape in other.shapes:
        weights = ({name: float(name == shape) for name in other.shapes},)
        shown = [rig.evaluate(*weights) for rig in (one, other)]
        distances.append(np.linalg.norm(shown[0] - shown[1], axis=1).max())
    for a, b in joints(found, expected):
        distances.append(np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1).max())
    return 1000.0 * expected.meters_per_unit * float(max(distances))


def joints(*faces: FaceParts) -> list[tuple[np.ndarray, ...]]:
    """(j, 4, 4) of every face at bind time, and those at rest."""
    skeletons = [face.skeleton for face in faces]
    return [tuple(s.bind_transforms for s in skeletons), tuple(s.rest_transforms for s in skeletons)]


@pytest.fixture(scope="module")
def plain() -> FaceParts:
    return blend(few(0), few(1))


@pytest.mark.parametrize("by", ["unit", "points", "root", "rest", "transforms"])
@pytest.mark.parametrize(("degrees", "scale"), [(8.0, 1.0), (14.0, 1.2), (30.0, 0.6)])
def test_a_source_turned_and_scaled_is_the_same_source(plain: FaceParts, degrees: float, scale: float, by: str) -> None:
    """Axes of joints too: clips would play larger on longer ones."""
    found = blend(few(0), placed(few(1), degrees, scale, by))
    assert off(found, plain) <= ABOUT_MM
    for one, other in joints(found, plain):
        np.testing.assert_allclose(one[:, :3, :3], other[:, :3, :3], rtol=0, atol=1e-5)


def test_a_joint_that_is_scaled_alone_stays_so() -> None:
    """What one joint of a source is scaled by belongs to the person; what all are scaled by does not."""
    other = few(1)
    bind = np.array(other.skeleton.bind_transforms)
    bind[5, :3, :3] *= 1.5
    found = blend(few(0), replace(other, skeleton=replace(other.skeleton, bind_transforms=bind)), weights=Weights())
    lengths = np.linalg.norm(found.skeleton.bind_transforms[:, :3, :3], axis=1)
    expected = np.ones(lengths.shape)
    expected[5] = 1.25
    np.testing.assert_allclose(lengths, expected, atol=1e-6)


def test_the_result_stands_where_the_first_source_does(plain: FaceParts) -> None:
    assert off(blend(placed(few(0), 30.0), few(1)), placed(plain, 30.0)) <= ABOUT_MM


def test_faces_taken_as_they_lie_are_bent(plain: FaceParts) -> None:
    turned = placed(few(1), 14.0)
    assert off(blend(few(0), turned, align="none"), plain) > 100.0 * ABOUT_MM


def test_a_region_holds_what_it_covers() -> None:
    usual, turned = (blend(few(0), one, align="nose") for one in (few(1), placed(few(1), 30.0, 0.6)))
    assert off(turned, usual) <= ABOUT_MM
    with pytest.raises(InputError, match="no region 'noses'"):
        blend(few(0), few(1), align="noses")


def test_without_landmarks_the_skin_outside_the_mouth_holds_and_is_named() -> None:
    first, second = (changed(few(one), lambda mesh: replace_mesh(mesh, landmarks={})) for one in (0, 1))
    session = BlendSession([Face.from_parts(one) for one in (first, second)])
    assert session.sources.aligned == "Head outside the mouth"
    assert off(blend(first, placed(second, 14.0, 1.2)), blend(first, second)) <= ABOUT_MM


def test_a_mouth_over_the_whole_skin_and_a_region_without_points_are_no_traceback() -> None:
    def masked(number: int, **masks: float) -> FaceParts:
        def change(mesh: Mesh) -> Mesh:
            full = {name: np.full(len(mesh.points), value) for name, value in masks.items()}
            return replace_mesh(mesh, landmarks={}, regions=full if mesh.regions else {})

        return changed(few(number), change)

    faces = [masked(0, mouth=1.0, nose=0.0), placed(masked(1, mouth=1.0, nose=0.0), 30.0, 0.6)]
    sources = stack([Face.from_parts(one) for one in faces], "landmarks")
    assert sources.aligned == "Head"
    assert not sources.warnings
    with pytest.raises(InputError, match="region 'nose' covers no point"):
        stack([Face.from_parts(one) for one in faces], "nose")
