"""How alike a recognition network finds photo and render: what counts, and what does not."""

from __future__ import annotations

import numpy as np
import pytest
from feature_graphs import coarse_picture, save
from scipy.ndimage import gaussian_filter

from facepipe.geometry.colors import from_srgb
from facepipe.geometry.face_crops import TEMPLATE
from facepipe.photo.features.extractor import Extractor, load_extractor, similarity

pytestmark = pytest.mark.needs_torch

SIDE = 96
LANDMARKS = 20 + TEMPLATE * 56


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Extractor:
    return load_extractor(save(coarse_picture(32), tmp_path_factory.mktemp("network") / "net.onnx"), "identity")


def photo(seed: int) -> np.ndarray:
    """(SIDE, SIDE, 3) smooth colours."""
    noise = gaussian_filter(np.random.default_rng(seed).random((SIDE, SIDE, 3)), (6, 6, 0))
    return (noise - noise.min()) / np.ptp(noise)


def disc(side: int = SIDE) -> np.ndarray:
    """(side, side, 1) 1 in the middle."""
    along = (np.arange(side) + 0.5) / side - 0.5
    return (np.hypot(*np.meshgrid(along, along)) < 0.3).astype(float)[..., None]


def render(pixels: np.ndarray) -> np.ndarray:
    """What is in the disc, on nothing."""
    return np.concatenate([from_srgb(pixels) * disc(len(pixels)), disc(len(pixels))], axis=2)


def test_a_render_like_the_photo_is_the_same_whatever_is_around_it(network: Extractor) -> None:
    own, other = photo(1), photo(2)
    elsewhere = np.where(disc() > 0, own, other)
    alike, around = (similarity(network, each, render(own), LANDMARKS) for each in (own, elsewhere))
    assert alike > 0.999
    assert around > 0.999
    assert similarity(network, own, render(other), LANDMARKS) < 0.8


def test_a_smaller_render_is_compared_at_the_same_place(network: Extractor) -> None:
    own = photo(1)
    half = own.reshape(SIDE // 2, 2, SIDE // 2, 2, 3).mean(axis=(1, 3))
    assert similarity(network, own, render(half), LANDMARKS) > 0.98
    assert similarity(network, own, render(half[::-1]), LANDMARKS) < 0.8


def test_the_landmarks_say_what_is_compared(network: Extractor) -> None:
    """A blot in a corner of the disc is not in a crop of the middle."""
    own, blotted = photo(1), photo(1)
    blotted[60:66, 60:66] = 0
    small = 42 + TEMPLATE * 12
    assert similarity(network, own, render(blotted), small) > 0.999
    assert similarity(network, own, render(blotted), LANDMARKS) < 0.999
