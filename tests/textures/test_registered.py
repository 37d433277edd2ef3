"""Photos that show the same features in different places of a texture."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, shift

from facepipe.geometry.texels import Texels
from facepipe.textures.bake import registered
from facepipe.textures.seen_skin import GREY, Observed

SIZE = 192
TEXEL = 1 / 100  # of the eyes' distance
FLAT = np.full((SIZE**2, 3), 0.4)
TEXELS = Texels(
    size=SIZE,
    at=np.arange(SIZE**2),
    corners=np.zeros((SIZE**2, 3), np.int64),
    weights=np.full((SIZE**2, 3), 1 / 3, np.float32),
)


def features() -> np.ndarray:
    """(SIZE, SIZE) logarithms: spots as wide and dark as brows and lips, and grain."""
    rng = np.random.default_rng(4)
    spots, grain = (gaussian_filter(rng.standard_normal((SIZE, SIZE)), width) for width in (4.0, 1.5))
    return np.asarray(0.5 * spots / spots.std() + 0.03 * grain / grain.std())


def shown(bright: np.ndarray, trust: np.ndarray | None = None) -> Observed:
    """What a photo of such brightness shows where it has confidence, everywhere if none is given."""
    weights = np.ones(SIZE**2, np.float32) if trust is None else trust.ravel().astype(np.float32)
    place = np.flatnonzero(weights > 0)
    ratio = np.repeat(bright.ravel()[place, None], 3, axis=1).astype(np.float32)
    return Observed(place=place, ratio=ratio, trust=weights[place])


def picture(one: Observed) -> np.ndarray:
    """(SIZE, SIZE) brightness, NaN where there is none."""
    values = np.full(SIZE**2, np.nan)
    values[one.place] = one.ratio @ GREY
    return values.reshape(SIZE, SIZE)


def test_features_are_moved_to_where_the_first_photo_shows_them() -> None:
    here = features()
    there = shift(here, (2.0, -1.5), order=3, mode="nearest")
    found = picture(registered(TEXELS, shown(here), shown(there), FLAT, TEXEL))
    inner = (slice(20, -20),) * 2
    before, after = (np.sqrt(np.nanmean((each - here)[inner] ** 2)) for each in (there, found))
    assert after < 0.5 * before


def test_light_that_differs_widely_moves_nothing() -> None:
    here = features()
    rows, columns = np.indices(here.shape) / SIZE
    found = picture(registered(TEXELS, shown(here), shown(here + 0.6 * rows - 0.4 * columns), FLAT, TEXEL))
    inner = (slice(20, -20),) * 2
    off = (found - here - 0.6 * rows + 0.4 * columns)[inner]
    assert np.sqrt(np.nanmean(off**2)) < 0.15 * here.std()


def test_skin_without_features_stays_where_it_is() -> None:
    plain, faint = np.zeros((SIZE, SIZE)), 0.01 * features()
    found = picture(registered(TEXELS, shown(plain), shown(faint), FLAT, TEXEL))
    assert np.nanmax(np.abs(found - faint)) < 1e-3


def test_what_either_photo_does_not_show_has_no_say() -> None:
    here, rng = features(), np.random.default_rng(5)
    left = np.zeros((SIZE, SIZE))
    left[:, : SIZE // 2] = 1
    noise = np.where(left > 0, here, rng.standard_normal(here.shape))
    found = registered(TEXELS, shown(here), shown(noise, left), FLAT, TEXEL)
    shares = picture(found)
    assert not np.isfinite(shares[:, SIZE // 2 + 8 :]).any()
    assert np.nanmax(np.abs(shares - here)[20:-20, 20 : SIZE // 2 - 20]) < 0.05
