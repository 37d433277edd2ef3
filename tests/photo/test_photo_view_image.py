"""The image of a fitted view is the one that the joint loss compared with the photo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from photo_people import Portrait, joint_loss, model, portrait
from with_torch import torch

from facepipe.photo.descent.descent import Descent, Unknowns
from facepipe.photo.descent.fit import fit_result
from facepipe.photo.descent.subject import FittedView
from facepipe.photo.descent.working_photo import view_image
from facepipe.photo.renderer.light import DARK

pytestmark = pytest.mark.needs_torch

SIZE = 128
LAMP = (-1.2, 1.0, 1.4, 0.8, 0.7, 0.6, 0.6, 3.4)
BEYOND = (-1.2, 1.0, 1.4, -0.2, 0.7, 0.6, -0.1, 3.4)  # what descent may come to, and shading takes for 0


def untinted(lamp: tuple[float, ...]) -> tuple[Portrait, Unknowns]:
    """A portrait in that lamp's light, and its truth but in the materials' own colours, as `view_image` shows them."""
    own = portrait(seed=1, size=SIZE, shadows=True, lamp=lamp)
    return own, replace(own.truth, tint=torch.zeros_like(own.truth.tint))


def view_of(own: Portrait, at: Unknowns) -> FittedView:
    """Of a fit that ended there."""
    descent = Descent(best=at.copy(), kept=0, history=({"total": 0.0},), stopped="iterations")
    return fit_result(joint_loss(own), descent).views[0]


def seen(own: Portrait, at: Unknowns, shadows: bool = True) -> np.ndarray:
    """(h, w, 4) as the loss sees it, without a border."""
    loss = joint_loss(own)
    loss.shadows = loss.shadows if shadows else [None]
    with torch.no_grad():
        return loss.image(at, 0).numpy()[1:-1, 1:-1]


def shown(own: Portrait, view: FittedView) -> np.ndarray:
    """(h, w, 4) as a fitted view shows it, in the window that the loss sees, without a border.

    At borders edges are smoothed with what is beyond.
    """
    loss = joint_loss(own)
    with torch.no_grad():
        points = model().rig(loss.sliders(own.truth.shares), loss.weights(own.truth.expressions[0])).numpy()
    image, window = view_image(model(), view, points, (SIZE, SIZE)), loss.photos[0]
    assert window.step == 1
    height, width = window.size
    return image[window.top : window.top + height, window.left : window.left + width][1:-1, 1:-1]


@pytest.mark.parametrize("lamp", [LAMP, BEYOND])
def test_it_shows_what_the_loss_saw(lamp: tuple[float, ...]) -> None:
    own, at = untinted(lamp)
    expected, image = seen(own, at), shown(own, view_of(own, at))
    np.testing.assert_allclose(image[..., 3], expected[..., 3], atol=1e-3)
    whole = expected[..., 3] == 1
    assert whole.mean() > 0.3
    off = np.abs(image - expected)[whole].max(axis=1)
    assert np.mean(off > 1e-3) < 0.01, "rounding decides at the edges of shadows alone"
    assert off.mean() < 1e-3


def test_lamp_and_shadows_are_in_it() -> None:
    own, at = untinted(LAMP)
    view = view_of(own, at)
    lit, dark = (shown(own, each) for each in (view, replace(view, key=np.array(DARK))))
    added = (lit - dark)[..., :3]
    assert added.min() > -1e-6
    assert added.max() > 0.2
    shadeless = seen(own, at, shadows=False)
    assert np.abs(dark - shadeless)[shadeless[..., 3] == 1].max() > 0.02


def test_the_lamp_of_a_result_is_as_the_shading_takes_it() -> None:
    own, at = untinted(LAMP)
    key = view_of(own, replace(at, key=torch.tensor([BEYOND]))).key
    assert key.dtype == np.float64
    length = np.linalg.norm(BEYOND[:3])
    np.testing.assert_allclose(key[:3] * length, BEYOND[:3], rtol=1e-6)
    np.testing.assert_allclose(key[3:], (0.0, 0.7, 0.6, 0.0, 3.4), rtol=1e-6)
    nowhere = view_of(own, replace(at, key=torch.tensor([(0.0,) * 3 + LAMP[3:]]))).key
    assert tuple(nowhere) == DARK
