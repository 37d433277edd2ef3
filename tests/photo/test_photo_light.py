"""The light of photos: harmonics and colours in closed form, lamps that are found, less joint loss by descent."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from photo_people import joint_loss, model, portrait
from with_torch import torch

from facepipe.photo.descent.descent import descend
from facepipe.photo.descent.joint_loss import single
from facepipe.photo.descent.lighting import SeenSurface, in_better_light, lit, relight, renew_shadows
from facepipe.photo.descent.shadows import Shadows
from facepipe.photo.descent.working_photo import WorkingPhoto, to_srgb
from facepipe.photo.options import PhotoFitOptions
from facepipe.photo.renderer.camera import Camera
from facepipe.photo.renderer.face_model import Look
from facepipe.photo.renderer.light import DARK, ambient, basis, shade

pytestmark = pytest.mark.needs_torch

LAMP = (-0.6, 0.5, 0.7, 0.8, 0.7, 0.6, 0.6, 3.4)


def shading_error(found: torch.Tensor, true: torch.Tensor) -> float:
    """Of white surfaces that are turned less than 75 degrees from the viewer, as a share of their mean colour."""
    normals = torch.nn.functional.normalize(torch.randn((2000, 3), generator=torch.Generator().manual_seed(0)), dim=1)
    seen = normals[normals[:, 2] > 0.26]
    one, other = shade(seen, found), shade(seen, true)
    return ((one - other).abs().mean() / other.mean()).item()


def relit(
    points: torch.Tensor, camera: Camera, photo: WorkingPhoto, shadows: Shadows | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Light (9, 3) and tints of the photo of a face."""
    surface = SeenSurface.from_camera(model(), points, camera, photo.face)
    shape = basis(surface.normals)
    if shadows is not None:
        shape = shape + surface.at_pixels(shadows.transfer)
    seen = photo.linear.reshape(-1, 3)[surface.raster.pixels]
    return relight(surface, seen, shape, len(model().colors.names))


@pytest.mark.parametrize("shadows", [False, True])
def test_light_and_colors_of_a_picture_of_its_own_are_found_again(shadows: bool) -> None:
    own = portrait(seed=2, size=128, shadows=shadows)
    loss = joint_loss(own)
    photo, face = loss.photos[0], model()
    look = loss.look(own.truth, 0)
    with torch.no_grad():
        points = face.rig(loss.sliders(own.truth.shares), loss.weights(own.truth.expressions[0]))
        light, tint = relit(points, look.camera, photo, own.shadows[0])
        height, width = photo.size
        again = replace(look, light=light, tint=tint)
        image = face.image(points, again, height=height, width=width)
    off = (to_srgb(image[..., :3]) - photo.pixels).abs()[image[..., 3] > 0.99]
    assert off.mean() < 0.012
    true = own.truth.tint.detach().exp()
    skin = face.colors.names.index("M_Face")
    np.testing.assert_allclose(tint[skin], torch.ones(3), atol=1e-6)
    assert shading_error(light, own.truth.light[0].detach() * true[skin]) < 0.05
    behind = face.colors.names.index("M_BackHead")
    np.testing.assert_allclose(tint[behind], true[behind] / true[skin], rtol=0.1)  # some of it is overexposed


def test_light_bears_with_a_dark_blot() -> None:
    own = portrait(seed=1, size=128)
    loss = joint_loss(own)
    face, look = model(), loss.look(own.truth, 0)
    image = own.images[0].copy()
    middle = own.landmarks[0][33].astype(int)
    image[middle[1] : middle[1] + 14, middle[0] : middle[0] + 14] = 0.02
    blotted = WorkingPhoto.from_photo(image, own.landmarks[0], 128)
    with torch.no_grad():
        points = face.rig(loss.sliders(own.truth.shares), loss.weights(own.truth.expressions[0]))
        light, _ = relit(points, look.camera, loss.photos[0])
        other, _ = relit(points, look.camera, blotted)
    assert shading_error(other, light) < 0.05


def test_a_face_out_of_the_picture_is_lit_somehow() -> None:
    own = portrait()
    loss = joint_loss(own)
    look: Look = loss.look(own.truth, 0)
    away = replace(single(look.camera), center=look.camera.center + 1e4)
    with torch.no_grad():
        points = model().rig()
    light, tint = relit(points, away, loss.photos[0])
    assert light.isfinite().all()
    assert light.norm() > 0
    assert (tint == 1).all()


# Lamps


def angle(one: torch.Tensor, other: object) -> float:
    """Between two directions, degrees."""
    first, second = (torch.nn.functional.normalize(torch.as_tensor(v).detach()[:3], dim=0) for v in (one, other))
    return float(torch.rad2deg(torch.acos((first @ second).clamp(-1, 1))))


@pytest.mark.parametrize("seed", [0, 2])  # 1 is overexposed
def test_a_lamp_is_found_where_it_stands(seed: int) -> None:
    own = portrait(seed=seed, size=160, lamp=LAMP)
    loss = joint_loss(own, content=0.0, identity=0.0)
    with torch.no_grad():
        black = loss(replace(own.truth, key=torch.tensor([DARK])))["color"]
    begin = lit(loss, own.state)
    assert angle(begin.key[0].detach(), LAMP) < 12
    found = in_better_light(loss, begin)
    with torch.no_grad():
        start, end = (float(loss(one)["color"]) for one in (begin, found))
    assert end < start < 0.4 * float(black)
    assert angle(found.key[0], LAMP) < 10


def test_light_from_all_around_needs_hardly_a_lamp() -> None:
    own = portrait(seed=1, size=128, shadows=True)
    found = lit(joint_loss(own), own.state)
    own_light, lamp = (float(one.detach().norm()) for one in (found.light, found.key[0, 3:6]))
    assert lamp < 0.15 * own_light


def test_a_face_out_of_the_picture_has_no_lamp() -> None:
    own = portrait()
    poses = own.state.poses.copy()
    poses[:, 3:5] += 40.0
    assert lit(joint_loss(own), replace(own.state, poses=poses)).key[0].tolist() == pytest.approx(DARK)


def test_a_covered_face_has_no_lamp_and_gets_none() -> None:
    """Directions that explain noise a little better are no lamp, before a descent and after."""
    own = portrait(seed=1, lamp=LAMP)
    noise = np.random.default_rng(0).uniform(0, 1, own.images[0].shape).astype(np.float32)
    loss = joint_loss(replace(own, images=(noise,)), content=0.0, identity=0.0)
    begin = in_better_light(loss, lit(loss, own.state))
    assert begin.key[0].tolist() == pytest.approx(DARK)
    descent = descend(loss, begin, PhotoFitOptions(iterations=12), renew=partial(renew_shadows, loss))
    assert descent.best.key[0].tolist() == pytest.approx(DARK)


def test_shadows_are_renewed_for_the_face_as_it_is() -> None:
    own = portrait(lamp=LAMP)
    loss = joint_loss(own)
    true = loss.shadows[0]
    assert true is not None
    turned = replace(own.truth, poses=own.truth.poses + torch.tensor([0.0, 0.6, 0.0, 0.0, 0.0, 0.0, 0.0]))
    renew_shadows(loss, turned)
    other = loss.shadows[0]
    assert other is not None
    assert (other.arriving - true.arriving).abs().mean() > 0.02
    renew_shadows(loss, own.truth)
    again = loss.shadows[0]
    assert again is not None
    assert (again.arriving - true.arriving).abs().mean() < 1e-3  # rounding decides at the edges of shadows
    assert (again.transfer - true.transfer).abs().mean() < 1e-3


# Descent


def test_light_is_found_again() -> None:
    """A face that stands where it stood, in grey light: most of what the colours are off goes, nothing moves."""
    person = portrait(0)
    loss = joint_loss(person, content=0.0, identity=0.0, attributes=0.0)
    grey = ambient(torch.full((3,), 0.4))[None]
    start = replace(person.truth, light=grey, tint=torch.zeros_like(person.truth.tint))
    found = in_better_light(loss, start, steps=300)
    with torch.no_grad():
        before, after = (float(loss(one)["color"]) for one in (start, found))
    assert after < 0.2 * before
    assert torch.equal(found.poses, start.poses)
    assert torch.equal(found.shares, start.shares)
