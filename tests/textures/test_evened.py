"""What of a photo's colours is light: shade on lids."""

from __future__ import annotations

import numpy as np
import pytest
from baked_face import person

from facepipe.rig import build
from facepipe.textures.evened import too_dark, upper_lids
from facepipe.textures.skin_surface import SkinSurface, skin_of


@pytest.fixture(scope="module")
def skin() -> SkinSurface:
    parts = person(0, 16)
    return skin_of(parts, build(parts).points, 64)


def near(skin: SkinSurface, *landmarks: int) -> np.ndarray:
    """(n,) whether points are within 3 percent of the eyes' distance of the middle of landmarks."""
    middle = skin.points[skin.landmarks[list(landmarks)]].mean(axis=0)
    return np.asarray(np.linalg.norm(skin.points - middle, axis=1) < 0.03 * skin.eye_distance(skin.points))


def test_upper_lids_are_neither_brows_nor_lower_lids(skin: SkinSurface) -> None:
    lids = upper_lids(skin)
    for side in ((37, 38), (43, 44)):
        assert lids[near(skin, *side)].max() > 0.9
    for other in ((19,), (24,), (40, 41), (46, 47), (30,), (51,)):
        assert lids[near(skin, *other)].max() < 0.1


def test_shade_on_lids_is_taken_out_down_to_what_skin_varies(skin: SkinSurface) -> None:
    lids = upper_lids(skin)
    trust = np.where(skin.outside, 1.0, 0.0)
    dark = np.repeat(-0.9 * (lids > 0)[:, None], 3, axis=1)
    found = too_dark(skin, dark, trust, lids)[:, 0]
    inside = lids > 0.95
    assert (found[inside] < -0.2).all()
    assert (found[inside] > -0.7).all()
    assert (found[lids == 0] == 0).all()
    assert (too_dark(skin, np.zeros_like(dark), trust, lids) == 0).all()
