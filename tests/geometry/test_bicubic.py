"""Pictures at other sizes against Pillow's."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from facepipe.geometry.bicubic import Enlarged, strips


@pytest.mark.parametrize(("side", "size"), [(64, 256), (50, 333), (100, 37), (512, 100), (64, 64), (1, 16), (3, 40)])
def test_it_is_pillows_filter(side: int, size: int) -> None:
    """Larger, smaller, as large, by no whole number, and of fewer texels than the filter reaches."""
    picture = np.random.default_rng(0).standard_normal((side, side)).astype(np.float32)
    given = picture.copy()
    expected = np.asarray(Image.fromarray(picture).resize((size, size), Image.Resampling.BICUBIC))
    made = Enlarged(picture, size)
    found = made.whole()
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=0, atol=4e-6)
    np.testing.assert_array_equal(np.concatenate([made[rows] for rows in strips(size)]), found)
    found[:] = 0.0
    np.testing.assert_array_equal(picture, given)
