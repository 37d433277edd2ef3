"""A face in the camera and light of a photo: as the fit sees it, with the cards that the fit leaves out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from baked_face import camera_at, light, person, small_person, view_of, with_cards

from facepipe.geometry.vectors import transformed
from facepipe.parts import FaceParts, PhotoView
from facepipe.photo.pictures import photo_render
from facepipe.pictures.lighting import PhotoLights, Samples
from facepipe.rig import build

SIZE = 520  # pixels
FACE = (slice(195, 325), slice(195, 325))
SMALL = 160  # pixels: such pictures are drawn six times as large and made small, which takes four times as long
SMALL_FACE = (slice(60, 100), slice(60, 100))


@pytest.fixture(scope="module")
def parts() -> FaceParts:
    return small_person(0, 64)


@pytest.fixture(scope="module")
def view(parts: FaceParts) -> PhotoView:
    return view_of(camera_at(build(parts).points, 0.2, SIZE), "photo", SIZE)


@pytest.mark.needs_torch
def test_it_is_what_the_fit_sees(parts: FaceParts) -> None:
    """Another renderer: edges, textures and shadows are sampled otherwise."""
    from scipy.spatial.transform import Rotation

    from facepipe.photo.descent.subject import FittedCamera, FittedView
    from facepipe.photo.descent.working_photo import view_image
    from facepipe.photo.renderer.face_model import FaceModel

    view = view_of(camera_at(build(parts).points, 0.2, SMALL), "photo", SMALL)
    assert view.key is not None
    inverse = np.linalg.inv(view.transform)
    camera = FittedCamera(
        rotation=Rotation.from_matrix(inverse[:3, :3]).as_rotvec(),
        translation=inverse[:3, 3],
        focal=view.focal,
        center=view.center,
    )
    lamp = (*view.key.direction, *view.key.color, view.key.shine, np.log(view.key.exponent))
    points = build(parts).points
    none = np.zeros((68, 2))
    fitted = FittedView(
        expressions={},
        camera=camera,
        light=np.asarray(view.light),
        key=np.array(lamp),
        landmarks=none,
        targets=none,
        landmark_error=0.0,
    )
    expected = view_image(FaceModel(parts), fitted, points, (SMALL, SMALL))
    image = photo_render(parts, view, points)
    assert image.shape == expected.shape
    assert np.abs(image[..., 3] - expected[..., 3]).mean() < 0.01
    assert np.abs(image - expected)[SMALL_FACE].mean() < 0.03
    assert np.corrcoef(image[SMALL_FACE].ravel(), expected[SMALL_FACE].ravel())[0, 1] > 0.97


def test_tints_multiply_colours(parts: FaceParts, view: PhotoView) -> None:
    points, dim = build(parts).points, replace(view, key=None, light=0.5 * light())
    plain, tinted = (photo_render(parts, replace(dim, tint=tint), points) for tint in ({}, {"M_Face": (1.0, 0.5, 1.0)}))
    factor = tinted[FACE][..., :3].mean(axis=(0, 1)) / plain[FACE][..., :3].mean(axis=(0, 1))
    np.testing.assert_allclose(factor, (1.0, 0.5, 1.0), atol=0.05)


def test_cards_are_in_it(view: PhotoView) -> None:
    parts = person(0, 64)
    haired = with_cards(parts, "Hair")
    bald, image = (photo_render(each, view, build(each).points) for each in (parts, haired))
    assert image[..., 3].sum() > 1.01 * bald[..., 3].sum()
    np.testing.assert_allclose(image[360:, FACE[1]], bald[360:, FACE[1]], atol=0.05)


def test_a_stage_whose_z_is_up_looks_the_same(parts: FaceParts, view: PhotoView) -> None:
    turn = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    points = build(parts).points
    up = replace(view, transform=turn @ view.transform)
    image = photo_render(replace(parts, up_axis="Z"), up, transformed(points, turn))
    assert np.abs(image - photo_render(parts, view, points)).mean() < 1e-3


def test_walls_of_a_crease_send_light_back(view: PhotoView) -> None:
    """Half of an even sky is hidden by walls as light as the surface: the sum of all bounces."""
    albedo, count = np.array([0.0, 0.4, 0.9]), 3
    even = np.zeros((9, 3))
    even[0] = 1.0
    none, hidden = np.zeros(count), np.zeros((count, 9))
    hidden[:, 0] = -0.5 * 0.282095
    ahead = np.tile([0.0, 0.0, 1.0], (count, 1))
    samples = Samples(
        normals=ahead,
        towards_eye=ahead,
        up=np.array([0.0, 1.0, 0.0]),
        base=np.tile(albedo[:, None], (1, 3)),
        roughness=np.ones(count),
        carried=np.column_stack([np.ones(count), 1 + hidden]),
        mirror=np.zeros((count, 3)),
        coat=none,
        coat_roughness=none,
        inside=np.ones(count),
    )
    lit = PhotoLights(view=replace(view, key=None, light=even)).light(samples)
    bounces = sum((0.9 * 0.5 * albedo) ** number for number in range(60))
    np.testing.assert_allclose(lit.diffuse[:, 0], 0.5 * 0.282095 * bounces, rtol=1e-5)
