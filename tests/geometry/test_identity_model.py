"""Principal components of faces: what they keep, and that adding faces is the same as starting over."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from facepipe.core.errors import InputError
from facepipe.geometry.identity_model import IdentityModel


def faces(count: int, seed: int = 0, *, points: int = 50, modes: int = 30) -> np.ndarray:
    """Random faces of a few modes, the first the strongest."""
    rng = np.random.default_rng(seed)
    basis = np.random.default_rng(99).normal(size=(modes, points, 3)) / (1 + np.arange(modes))[:, None, None]
    return 10 + np.tensordot(rng.normal(size=(count, modes)), basis, axes=1)


def test_every_face_that_it_was_made_of_comes_back() -> None:
    own = faces(8)
    model = IdentityModel.from_faces(own)
    assert model.components.shape == (7, 50, 3)
    found = model.coefficients(own)
    np.testing.assert_allclose(model.points(found), own, atol=1e-10)
    np.testing.assert_allclose(found.mean(axis=0), 0, atol=1e-10)
    np.testing.assert_allclose(found.var(axis=0, ddof=1), 1, rtol=1e-9)


def test_components_are_orthonormal_and_the_largest_comes_first() -> None:
    model = IdentityModel.from_faces(faces(12))
    flat = model.components.reshape(len(model.deviations), -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(len(flat)), atol=1e-10)
    assert (np.diff(model.deviations) <= 0).all()


def test_no_model_of_as_many_components_is_nearer() -> None:
    """Eckart and Young: random bases of the same size leave more."""
    own = faces(20)
    whole = IdentityModel.from_faces(own)
    model = replace(whole, components=whole.components[:5], deviations=whole.deviations[:5])
    left = np.square(model.points(model.coefficients(own)) - own).sum()
    centred = (own - own.mean(axis=0)).reshape(20, -1)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        flat = model.components.reshape(5, -1) + 0.05 * rng.normal(size=(5, 150)) / np.sqrt(150)
        basis = np.linalg.qr(flat.T)[0]
        assert np.square(centred - centred @ basis @ basis.T).sum() > left


@pytest.mark.parametrize("parts", [(6, 1), (6, 1, 1, 1), (5, 9), (9, 5), (20, 25)])
def test_adding_faces_is_starting_over(parts: tuple[int, ...]) -> None:
    own = faces(sum(parts))
    ends = np.cumsum(parts)
    model = IdentityModel.from_faces(own[: ends[0]])
    for first, last in pairwise(ends):
        model = model.with_faces(own[first:last])
    again = IdentityModel.from_faces(own)
    assert model.count == again.count == len(own)
    np.testing.assert_allclose(model.mean, again.mean, atol=1e-12)
    np.testing.assert_allclose(model.deviations, again.deviations, rtol=1e-8)
    np.testing.assert_allclose(model.points(model.coefficients(own)), own, atol=1e-9)
    np.testing.assert_allclose(model.components[:5], again.components[:5], atol=1e-7)


def test_faces_that_depend_on_each_other_give_fewer_components() -> None:
    own = faces(4)
    model = IdentityModel.from_faces(np.concatenate([own, own, own.mean(axis=0)[None]]))
    assert len(model.deviations) == 3
    assert len(model.with_faces(own[:1]).deviations) == 3


def test_adding_nobody_changes_nothing() -> None:
    model = IdentityModel.from_faces(faces(4))
    assert model.with_faces(faces(0)) is model


def test_what_gives_no_model_is_refused() -> None:
    with pytest.raises(InputError, match="1 face, expected 2"):
        IdentityModel.from_faces(faces(1))
    with pytest.raises(InputError, match="all faces are the same"):
        IdentityModel.from_faces(np.ones((3, 5, 3)))
