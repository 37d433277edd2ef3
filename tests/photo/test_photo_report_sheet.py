"""From a photo fit to its report sheet: what the sheet shows is what the rig and the fitted camera say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_head import make
from with_torch import tensor

from facepipe.core.errors import InputError
from facepipe.parts import FaceParts
from facepipe.photo.descent.subject import FittedCamera, FittedView, PhotoFit
from facepipe.photo.fit import Photo
from facepipe.photo.fit.report import report_sheet
from facepipe.photo.pictures import photo_page
from facepipe.photo.renderer.camera import Camera
from facepipe.photo.renderer.light import DARK
from facepipe.rig import build, slide

pytestmark = pytest.mark.needs_torch

SLIDERS = {"noseWidth": 0.8, "chinLength": -0.5, "eyeSpacing": 0.3}
SMILE = {"mouthSmileLeft": 0.9, "mouthSmileRight": 0.9, "jawOpen": 0.4}
SIZE = (160, 120)


def fitted(parts: FaceParts) -> tuple[PhotoFit, np.ndarray]:
    """A fit as the sample would look from the front, and the points of the person in its view."""
    rig = build(parts)
    coefficients, weights = slide(parts.sliders, rig.joints, SLIDERS)
    points = rig.evaluate({**weights, **SMILE}, coefficients=coefficients)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    rotation = np.array([0.05, 0.2, 0.02])
    distance = np.array([0.0, 0.0, 8 * np.ptp(points[:, 1])])
    turned = Camera(rotation=tensor(rotation), translation=tensor((0, 0, 0)), focal=tensor(1), center=tensor((0, 0)))
    move = -turned.to_camera(tensor(middle[None]))[0].numpy() - distance
    camera = FittedCamera(rotation=rotation, translation=move, focal=700.0, center=(SIZE[0] / 2 + 9, SIZE[1] / 2))
    light = np.zeros((9, 3))
    light[0] = 3.0
    marks = np.zeros((68, 2))
    view = FittedView(
        expressions=SMILE,
        camera=camera,
        light=light,
        key=np.array(DARK),
        landmarks=marks,
        targets=marks,
        landmark_error=0.5,
    )
    fit = PhotoFit(
        sliders=SLIDERS, views=(view,), tint={"M_Face": (0.5, 0.25, 1.0)}, history=({"total": 1.0},), kept=0, steps=1,
        stopped="iterations",
    )  # fmt: skip
    index = parts.meshes[0].landmarks["multipie68"].indices
    homogeneous = (turned.to_camera(tensor(points[index])).numpy() + move) * (1, -1, -1)
    marks[:] = homogeneous[:, :2] / homogeneous[:, 2:] * camera.focal + camera.center
    return fit, points


@pytest.fixture(scope="module")
def parts() -> FaceParts:
    return make(3)


def photo(pixels: tuple[int, int] = SIZE) -> Photo:
    return Photo(pixels=np.full((pixels[1], pixels[0], 3), 0.4, np.float32), path=Path("me.png"), size=pixels)


def test_sheet_shows_the_face_where_the_camera_sees_it(parts: FaceParts) -> None:
    fit, _ = fitted(parts)
    sheet = report_sheet(parts, fit, [photo()])
    one = sheet.photos[0]
    index = parts.meshes[0].landmarks["multipie68"].indices
    np.testing.assert_allclose(one.screen[index, :2], fit.views[0].landmarks, atol=1e-6)
    assert one.render.shape == (SIZE[1], SIZE[0], 4)
    covered = one.render[..., 3] > 0.5
    rows, columns = np.nonzero(covered)
    low, high = one.screen[:, :2].min(axis=0), one.screen[:, :2].max(axis=0)
    np.testing.assert_allclose((columns.min(), rows.min()), low, atol=1.5)
    np.testing.assert_allclose((columns.max() + 1, rows.max() + 1), high, atol=1.5)
    assert (one.render[~covered & (one.render[..., 3] == 0)] == 0).all()
    assert b"render on the photo" in photo_page(sheet)


def test_neutral_of_the_sheet_has_no_expression(parts: FaceParts) -> None:
    fit, points = fitted(parts)
    sheet = report_sheet(parts, fit, [photo()])
    rig = build(parts)
    coefficients, weights = slide(parts.sliders, rig.joints, SLIDERS)
    np.testing.assert_allclose(sheet.neutral, rig.evaluate(weights, coefficients=coefficients), atol=1e-9)
    assert np.abs(sheet.neutral - points).max() > 0.1


def test_tint_multiplies_the_colours(parts: FaceParts) -> None:
    fit, _ = fitted(parts)
    plain = report_sheet(parts, replace(fit, tint={}), [photo()]).photos[0].render
    tinted = report_sheet(parts, fit, [photo()]).photos[0].render
    middle = fit.views[0].landmarks[30].astype(int)  # the tip of the nose
    before, after = (each[middle[1], middle[0], :3] for each in (plain, tinted))
    np.testing.assert_allclose(after, before * (0.5, 0.25, 1.0), rtol=1e-4)


def test_large_photos_get_smaller_renders(parts: FaceParts) -> None:
    fit, _ = fitted(parts)
    view = fit.views[0]
    large = replace(view, camera=replace(view.camera, focal=view.camera.focal * 16, center=(8 * SIZE[0], 8 * SIZE[1])))
    small = replace(view, camera=replace(view.camera, center=(SIZE[0] / 2, SIZE[1] / 2)))
    wide = report_sheet(parts, replace(fit, views=(large,)), [photo((SIZE[0] * 16, SIZE[1] * 16))]).photos[0].render
    own = report_sheet(parts, replace(fit, views=(small,)), [photo()]).photos[0].render
    assert wide.shape == (768, 1024, 4)
    assert wide[..., 3].mean() == pytest.approx(own[..., 3].mean(), rel=0.01)  # the same scene


def test_unknown_sliders_are_refused(parts: FaceParts) -> None:
    fit, _ = fitted(parts)
    with pytest.raises(InputError, match="noseHue"):
        report_sheet(parts, replace(fit, sliders={"noseHue": 0.2}), [photo()])
