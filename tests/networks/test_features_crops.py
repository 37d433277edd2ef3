"""Aligned crops: known similarities are found, a smooth picture is read where the matrix says, with gradients."""

from __future__ import annotations

import json

import numpy as np
import pytest
from places import SHARED
from with_torch import tensor, torch

from facepipe.core.errors import InputError
from facepipe.geometry.face_crops import ARCFACE_TEMPLATE, TEMPLATE, arcface_crop, face_crop, from_crop, to_crop
from facepipe.networks.files import sample_crop

pytestmark = pytest.mark.needs_torch

PHOTO = SHARED / "photos" / "astronaut.landmarks.json"
KNOWN = np.array([[1.2, -0.7, 31.0], [0.7, 1.2, -12.0]])  # crop pixels to image pixels: turned, 1.39 times as large


def smooth(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(..., 3) colours without detail that a pixel could miss."""
    return np.stack([np.sin(x / 30) + y / 90, np.cos(x / 40 + y / 25), x / 100 - y / 200], axis=-1)


def picture(height: int, width: int) -> torch.Tensor:
    y, x = np.mgrid[:height, :width] + 0.5
    return tensor(smooth(x, y))


def test_template_is_a_face_seen_from_the_front() -> None:
    assert TEMPLATE.shape == (68, 2)
    mirror = [*range(16, -1, -1), *range(26, 16, -1), *range(27, 31), *range(35, 30, -1), 45, 44, 43, 42, 47, 46]
    mirror += [39, 38, 37, 36, 41, 40, 54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55, 64, 63, 62, 61, 60, 67, 66, 65]
    np.testing.assert_allclose(TEMPLATE[mirror] * (-1, 1) + (1, 0), TEMPLATE, atol=1.01e-4)
    assert TEMPLATE[36, 0] < TEMPLATE[45, 0]  # the person's right is at the left of the picture
    assert (TEMPLATE[:, 1].min(), TEMPLATE[:, 1].max()) == (0.2, 0.8)


def test_known_similarity_is_found() -> None:
    np.testing.assert_allclose(face_crop(from_crop(TEMPLATE * 96, KNOWN), 96), KNOWN, atol=1e-9)


def test_known_similarity_is_found_by_five_points() -> None:
    marks = np.zeros((68, 2))
    marks[36:42], marks[42:48] = ARCFACE_TEMPLATE[0], ARCFACE_TEMPLATE[1]
    marks[[30, 48, 54]] = ARCFACE_TEMPLATE[2:]
    np.testing.assert_allclose(arcface_crop(from_crop(marks, KNOWN)), KNOWN, atol=1e-9)
    twice = arcface_crop(from_crop(marks, KNOWN), 224)
    np.testing.assert_allclose(from_crop(2 * marks[30], twice), from_crop(marks[30], KNOWN), atol=1e-9)


def test_no_other_similarity_is_nearer_to_the_template() -> None:
    rng = np.random.default_rng(0)
    marks = from_crop(TEMPLATE * 96, KNOWN) + rng.normal(size=(68, 2)) * 8
    found = face_crop(marks, 96)

    def distance(matrix: np.ndarray) -> float:
        return float(np.square(to_crop(marks, matrix) - TEMPLATE * 96).sum())

    for _ in range(50):
        turn, shift = rng.normal(size=2) * 0.01, rng.normal(size=2) * 0.5
        other = found + np.array([[turn[0], -turn[1], shift[0]], [turn[1], turn[0], shift[1]]])
        assert distance(found) < distance(other)


def test_points_go_to_the_crop_and_back() -> None:
    points = np.random.default_rng(0).normal(size=(2, 9, 2)) * 50
    np.testing.assert_allclose(from_crop(to_crop(points, KNOWN), KNOWN), points, atol=1e-12)


@pytest.mark.parametrize("scale", [0.3, 1.0, 1.4, 2.0, 3.3])
def test_crop_reads_the_picture_where_the_matrix_says(scale: float) -> None:
    size = 24
    matrix = np.array([[1.0, -0.1, 0], [0.1, 1.0, 0]]) * scale
    matrix[:, 2] = (60, 50) - matrix[:, :2] @ (size / 2, size / 2)
    y, x = np.mgrid[:size, :size] + 0.5
    expected = smooth(*np.moveaxis(from_crop(np.stack([x, y], axis=-1), matrix), -1, 0))
    found = sample_crop(picture(100, 120), matrix, size)
    assert found.shape == (1, 3, size, size)
    np.testing.assert_allclose(found[0].permute(1, 2, 0), expected, atol=2e-3 * max(scale, 1))


def test_crop_of_whole_pixels_is_the_picture() -> None:
    image = picture(20, 30)
    found = sample_crop(image, np.array([[1.0, 0, 7], [0, 1.0, 4]]), 12)
    torch.testing.assert_close(found[0], image[4:16, 7:19].permute(2, 0, 1))


def test_detail_finer_than_the_crop_is_averaged() -> None:
    y, x = np.mgrid[:128, :128]
    board = tensor(np.repeat(((x + y) % 2)[..., None], 3, axis=-1))
    found = sample_crop(board, np.array([[4.0, 0, 0], [0, 4.0, 0]]), 32)
    torch.testing.assert_close(found, torch.full_like(found, 0.5))


def test_outside_the_picture_its_border_goes_on() -> None:
    image = picture(16, 16)
    found = sample_crop(image, np.array([[1.0, 0, -20], [0, 1.0, -20]]), 8)
    torch.testing.assert_close(found, image[0, 0][None, :, None, None].expand(1, 3, 8, 8))


@pytest.mark.parametrize("scale", [0.8, 2.2])
def test_gradient_reaches_the_picture(scale: float) -> None:
    image = torch.rand(9, 8, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    matrix = KNOWN * scale / 3
    matrix[:, 2] = (1.5, -0.3)
    assert torch.autograd.gradcheck(lambda one: sample_crop(one, matrix, 4), (image,))


@pytest.mark.parametrize(
    ("marks", "what"),
    [
        (np.zeros((5, 2)), r"\(5, 2\), expected \(68, 2\)"),
        (np.full((68, 2), 7.0), "one place"),
        (np.full((68, 2), np.nan), "NaN"),
    ],
)
def test_landmarks_that_give_no_crop(marks: np.ndarray, what: str) -> None:
    for crop in (lambda: face_crop(marks, 64), lambda: arcface_crop(marks)):
        with pytest.raises(InputError, match=what):
            crop()


def test_a_real_face_lies_near_the_template() -> None:
    if not PHOTO.is_file():
        pytest.skip("../shared/data/photos is absent")
    marks = np.array(json.loads(PHOTO.read_text())["multipie68"])[:, :2]
    off = np.linalg.norm(to_crop(marks, face_crop(marks, 1)) - TEMPLATE, axis=1)
    assert off.mean() < 0.03
