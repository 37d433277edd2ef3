"""The shipped network of masks: heads that training never saw, with their hair and with things in front."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from baked_face import camera_at
from with_torch import torch

from facepipe import heads
from facepipe.geometry.face_crops import TEMPLATE, face_crop, plain_crop, turned_crop
from facepipe.networks.files import FaceMask, face_mask, sample_crop
from facepipe.pictures import PictureOptions, picture
from facepipe.pictures.lighting import Light, Studio
from facepipe.rig import build

pytestmark = pytest.mark.needs_torch

SIZE, LONG_HAIR = 320, 41  # pixels, and a seed
LAMP = Light(direction=(0.5, 0.4, 0.75), color=(0.7, 0.68, 0.6))
STUDIO = Studio(lights=(LAMP,), sky=(0.5, 0.5, 0.55), ground=(0.25, 0.25, 0.22), compress=False)


@cache
def photo() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(h, w, 3) sRGB of a head before magenta; its landmarks; (h, w) where there is nothing of the head."""
    parts = heads.make(LONG_HAIR, textures=256)
    points = build(parts).evaluate()
    camera = camera_at(points[: len(parts.meshes[0].points)], 0.1, SIZE)
    options = PictureOptions(size=SIZE, samples=2, camera=camera, studio=STUDIO, background=(1.0, 0.0, 1.0))
    image = np.asarray(picture(parts, points, options), np.float32)[..., :3] / 255
    screen = camera.project(points[parts.meshes[0].landmarks["multipie68"].indices])
    empty = (image - (1.0, 0.0, 1.0) == 0).all(axis=2)
    return image, screen[:, :2] / screen[:, 3:], empty


@cache
def mask() -> FaceMask:
    image, marks, _ = photo()
    return face_mask(image, marks)


def inside(marks: np.ndarray) -> tuple[slice, slice]:
    """The box of eyes, nose and mouth, in rows and columns."""
    (left, top), (right, bottom) = marks[31:].min(axis=0).astype(int), marks[31:].max(axis=0).astype(int)
    return slice(top, bottom), slice(left, right)


def test_a_face_is_face_and_what_is_behind_is_not() -> None:
    _, marks, empty = photo()
    assert mask().face[inside(marks)].mean() > 0.97
    assert mask().face[empty].mean() < 0.02
    assert mask().hair[empty].mean() < 0.02


def test_hair_is_hair() -> None:
    """Above the forehead, where hair hangs to both sides of the face, and nowhere on the face."""
    _, marks, empty = photo()
    tall = marks[8, 1] - marks[27, 1]
    rows = slice(int(marks[27, 1] - 0.9 * tall), int(marks[27, 1] - 0.75 * tall))
    column = int(marks[27, 0])
    top = mask().hair[rows, column - 10 : column + 10]
    assert top[~empty[rows, column - 10 : column + 10]].mean() > 0.5
    assert mask().hair[inside(marks)].mean() < 0.02
    assert (mask().face + mask().hair).max() < 1.001


@pytest.mark.parametrize("color", [(0.1, 0.1, 0.1), (0.2, 0.5, 0.9)])
def test_what_is_before_a_face_is_no_face(color: tuple[float, float, float]) -> None:
    """Dark glasses, and a blue thing."""
    image, marks, _ = photo()
    covered, wide = image.copy(), np.linalg.norm(marks[45] - marks[36])
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    hidden = np.zeros((SIZE, SIZE), bool)
    for eye in (marks[36:42].mean(axis=0), marks[42:48].mean(axis=0)):
        hidden |= np.hypot((x - eye[0]) / 0.27, (y - eye[1]) / 0.22) < wide
    covered[hidden] = color
    found = face_mask(covered, marks).face
    assert found[hidden].mean() < 0.25
    assert mask().face[hidden].mean() > 0.95


def test_a_photo_turned_by_a_quarter_has_the_same_mask() -> None:
    image, marks, _ = photo()
    turned = np.ascontiguousarray(np.rot90(image))
    found = face_mask(turned, np.stack([marks[:, 1], SIZE - marks[:, 0]], axis=1))
    np.testing.assert_allclose(np.rot90(found.face, -1), mask().face, atol=0.02)


def test_faces_unlike_any_that_the_network_knows_are_face_throughout() -> None:
    _, marks, _ = photo()
    drawn = np.full((SIZE, SIZE, 3), 0.9, np.float32)
    found = face_mask(drawn, marks)
    assert found.face.min() == 1
    assert found.hair.max() == 0


def test_crops_without_torch_are_those_of_torch() -> None:
    image = np.random.default_rng(0).random((90, 70, 3)).astype(np.float32)
    for side in (30.0, 150.0, 900.0):  # enlarged, reduced with what is outside, and reduced to averages
        for turn in (0.2, 0.0, np.pi / 2, np.pi, -np.pi / 2):  # aslant, and with rows that stay rows or columns
            matrix = turned_crop(face_crop(TEMPLATE * side + 5.0, 40), turn, 1.1, 40)
            expected = sample_crop(torch.as_tensor(image, dtype=torch.float64), matrix, 40)[0].permute(1, 2, 0).numpy()
            np.testing.assert_allclose(plain_crop(image, matrix, 40), expected, atol=1e-6)
