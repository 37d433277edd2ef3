"""The multilinear model: what it keeps, what its vectors mean, and what they predict of unseen expressions."""

from __future__ import annotations

import numpy as np
import pytest

from facepipe.core.errors import InputError
from facepipe.geometry.expression_model import ExpressionModel, _missed, hosvd, trust
from facepipe.geometry.identity_model import IdentityModel
from facepipe.geometry.shape_basis import coefficients_in, hold, no_basis

NAMES = ("open", "smile", "blink", "frown")
POINTS, WAYS = 40, 3


def people(
    count: int, seed: int = 0, *, shown_in_neutral: float = 1.0, noise: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Neutrals (m, n, 3), deltas (m, e, n, 3) and the few numbers (m, ways) that deltas depend on.

    :param shown_in_neutral: how much of those numbers shows in the neutral
    """
    fixed, rng = np.random.default_rng(5), np.random.default_rng([seed, count])
    neutral_ways = 3.0 * fixed.standard_normal((6, POINTS, 3))
    shown = 3.0 * fixed.standard_normal((WAYS, POINTS, 3))
    mean = fixed.standard_normal((len(NAMES), POINTS, 3))
    ways = 0.3 * fixed.standard_normal((WAYS, len(NAMES), POINTS, 3))
    numbers, others = rng.standard_normal((count, WAYS)), rng.standard_normal((count, 6))
    neutrals = 50 + np.tensordot(others, neutral_ways, axes=1) + shown_in_neutral * np.tensordot(numbers, shown, axes=1)
    deltas = mean + np.tensordot(numbers, ways, axes=1)
    return neutrals, deltas + noise * rng.standard_normal(deltas.shape), numbers


def model_of(neutrals: np.ndarray, deltas: np.ndarray, tolerance: float = 1e-6) -> ExpressionModel:
    basis, rows = no_basis(POINTS), []
    for own in deltas:
        held = hold(basis, own, tolerance)
        basis = held.basis
        rows.append(held.coefficients)
    padded = np.stack([np.pad(row, ((0, 0), (0, len(basis) - row.shape[1]))) for row in rows])
    identity = IdentityModel.from_faces(neutrals)
    return ExpressionModel.from_people(NAMES, identity, identity.coefficients(neutrals), basis, padded)


def off(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.sqrt(np.square(found - expected).mean()))


def test_hosvd_gives_the_tensor_back_of_orthonormal_factors() -> None:
    tensor = np.random.default_rng(0).standard_normal((7, 4, 30))
    tensor[:, 3] = tensor[:, 0] - tensor[:, 1]
    found = hosvd(tensor)
    assert found.core.shape == (7, 3, 30)
    np.testing.assert_allclose(np.einsum("ia,jb,abd->ijd", found.first, found.second, found.core), tensor, atol=1e-12)
    np.testing.assert_allclose(found.first.T @ found.first, np.eye(7), atol=1e-12)
    np.testing.assert_allclose(found.second.T @ found.second, np.eye(3), atol=1e-12)
    for mode in (found.core.transpose(0, 1, 2), found.core.transpose(1, 0, 2)):
        flat = mode.reshape(len(mode), -1)
        products = flat @ flat.T  # all-orthogonal, the strongest first: what makes it the HOSVD
        np.testing.assert_allclose(products, np.diag(np.diag(products)), atol=1e-9)
        assert (np.diff(np.diag(products)) <= 1e-9).all()


@pytest.mark.parametrize("size", [1e-9, 1e9])
def test_hosvd_has_the_same_directions_in_any_unit(size: float) -> None:
    tensor = np.random.default_rng(1).standard_normal((5, 4, 30))
    tensor[:, 3] = tensor[:, 0] - tensor[:, 1]
    one, other = hosvd(tensor), hosvd(size * tensor)
    np.testing.assert_allclose(other.core / size, one.core, atol=1e-9)
    np.testing.assert_allclose(other.second, one.second, atol=1e-9)


def test_hosvd_of_no_numbers_has_no_directions() -> None:
    found = hosvd(np.zeros((3, 2, 0)))
    assert (found.first.shape, found.second.shape, found.core.shape) == ((3, 0), (2, 0), (0, 0, 0))


@pytest.mark.parametrize("tolerance", [1e-6, 0.05, 0.3])
def test_a_basis_holds_rows_to_its_tolerance_with_no_direction_too_many(tolerance: float) -> None:
    rng = np.random.default_rng(1)
    basis, sets = (
        no_basis(POINTS),
        [rng.standard_normal((5, POINTS, 3)) * 0.5 ** np.arange(5)[:, None, None] for _ in "ab"],
    )
    for rows in sets:
        held = hold(basis, rows, tolerance)
        np.testing.assert_array_equal(held.basis[: len(basis)], basis)
        flat = held.basis.reshape(len(held.basis), -1).astype(np.float64)
        np.testing.assert_allclose(flat @ flat.T, np.eye(len(flat)), atol=1e-6)
        found = np.tensordot(held.coefficients, held.basis, axes=1)
        np.testing.assert_allclose(np.linalg.norm(found - rows, axis=2), held.distances, atol=1e-5)
        rms = lambda one: np.sqrt(np.square(one).sum(axis=(1, 2)) / POINTS).max()  # noqa: E731
        assert rms(found - rows) <= tolerance * 1.001 + 1e-6
        if len(held.basis) > len(basis):
            assert rms(np.tensordot(held.coefficients[:, :-1], held.basis[:-1], axes=1) - rows) > tolerance
        basis = held.basis
        np.testing.assert_allclose(coefficients_in(basis, rows), held.coefficients, atol=1e-5)


def test_its_people_come_back_and_their_vectors_are_standard() -> None:
    neutrals, deltas, _ = people(8, noise=0.1)
    model = model_of(neutrals, deltas)
    np.testing.assert_allclose(model.vectors.mean(axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(model.vectors.T @ model.vectors / 7, np.eye(7), atol=1e-9)
    for vector, neutral, own in zip(model.vectors, neutrals, deltas, strict=True):
        np.testing.assert_allclose(model.neutral(vector), neutral, atol=1e-4)
        np.testing.assert_allclose(model.shapes(vector), own, atol=1e-4)
    np.testing.assert_allclose(model.shapes(np.zeros(7)), deltas.mean(axis=0), atol=1e-4)
    np.testing.assert_allclose(np.tensordot(model.deltas, model.basis, axes=1), deltas, atol=1e-4)


def test_the_neutral_row_and_the_core_give_the_neutral_as_the_document_says() -> None:
    """S14: expression row x core x vector, by hand."""
    neutrals, deltas, _ = people(6)
    model = model_of(neutrals, deltas)
    vector = np.random.default_rng(3).standard_normal(model.vectors.shape[1])
    coordinates = model.mean + np.einsum("es,r,rsd->ed", model.matrix, vector, model.core)
    size = len(model.identity.deviations)
    by_hand = model.identity.mean + np.tensordot(coordinates[0, :size], model.identity.components, axes=1)
    np.testing.assert_allclose(model.neutral(vector), by_hand, atol=1e-9)
    np.testing.assert_allclose(
        model.shape(vector, "blink"), np.tensordot(coordinates[3, size:], model.basis, axes=1), atol=1e-5
    )


def test_seen_expressions_predict_others_better_than_the_mean_and_than_the_neutral() -> None:
    neutrals, deltas, _ = people(12, shown_in_neutral=0.2, noise=0.05)
    model = model_of(neutrals, deltas)
    strangers, own, _ = people(10, seed=1, shown_in_neutral=0.2)
    errors = []
    for neutral, shapes in zip(strangers, own, strict=True):
        seen = model.identity_from({"open": neutral + shapes[0], "smile": neutral + shapes[1]}, neutral)
        vectors = (np.zeros(len(seen)), model.identity_from({}, neutral), seen)
        errors.append([off(model.shapes(vector)[2:], shapes[2:]) for vector in vectors])
    mean, alone, seen_error = np.mean(errors, axis=0)
    assert seen_error < 0.35 * mean
    assert seen_error < 0.6 * alone
    assert alone < 1.05 * mean


def test_a_neutral_that_shows_something_is_trusted_and_one_that_doesn_t_is_not() -> None:
    for shown_in_neutral, low, high in ((3.0, 0.0, 0.4), (0.0, 0.8, 1.1)):
        neutrals, deltas, _ = people(14, shown_in_neutral=shown_in_neutral)
        model = model_of(neutrals, deltas)
        strangers, own, _ = people(10, seed=1, shown_in_neutral=shown_in_neutral)
        pairs = [(model.identity_from({}, neutral), shapes) for neutral, shapes in zip(strangers, own, strict=True)]
        found = np.mean([off(model.shapes(vector), shapes) for vector, shapes in pairs])
        assert low <= found / np.mean([off(model.shapes(0 * vector), shapes) for vector, shapes in pairs]) < high


def test_a_neutral_that_says_nothing_of_expressions_changes_nothing_beside_one() -> None:
    """The neutral and the expressions are trusted apart."""
    neutrals, deltas, _ = people(14, shown_in_neutral=0.0)
    model = model_of(neutrals, deltas)
    others, own, _ = people(2, seed=9, shown_in_neutral=0.0)
    one, other = (model.identity_from({"open": neutral + own[0, 0]}, neutral) for neutral in others)
    np.testing.assert_allclose(one, other, atol=1e-9)


def test_leaving_one_out_by_formula_is_leaving_one_out() -> None:
    """Against ridge regression of each person from the others, done in full, with the mean taken anew."""
    rng = np.random.default_rng(2)
    numbers = rng.standard_normal((9, 3))
    seen, wanted = numbers @ rng.standard_normal((3, 12)), numbers @ rng.standard_normal((3, 7))
    seen += 0.3 * rng.standard_normal(seen.shape)
    seen, wanted = seen - seen.mean(axis=0), wanted - wanted.mean(axis=0)
    (weight,) = trust([seen @ seen.T], wanted @ wanted.T)

    def missed(weight: float) -> float:
        total = 0.0
        for one in range(9):
            others = [i for i in range(9) if i != one]
            x, y = seen[others] - seen[others].mean(axis=0), wanted[others] - wanted[others].mean(axis=0)
            k = x @ x.T * weight / 8
            pull = weight / 8 * (seen[one] - seen[others].mean(axis=0)) @ x.T
            guess = wanted[others].mean(axis=0) + pull @ np.linalg.solve(k + np.eye(8), y)
            total += np.square(guess - wanted[one]).sum()
        return total

    scale = 9 / np.trace(seen @ seen.T)
    tried = [0.0, *(scale * 10.0**power for power in np.arange(-2.0, 4.1, 0.5))]
    assert weight == pytest.approx(min(tried, key=missed))
    for one in tried:
        assert _missed(one * seen @ seen.T, wanted @ wanted.T) == pytest.approx(missed(one))


def test_the_mean_person_is_what_nothing_seen_gives() -> None:
    neutrals, deltas, _ = people(1)
    single = ExpressionModel.from_people(
        NAMES,
        model_of(*people(3)[:2]).identity,
        np.zeros((1, 2)),
        np.zeros((0, POINTS, 3), np.float32),
        np.zeros((1, len(NAMES), 0)),
    )
    assert single.identity_from({}, neutrals[0]).shape == (0,)
    assert single.shapes(np.zeros(0)).shape == deltas[0].shape


def test_what_does_not_fit_is_refused() -> None:
    neutrals, deltas, _ = people(4)
    model = model_of(neutrals, deltas)
    with pytest.raises(InputError, match="no expression 'wink'"):
        model.identity_from({"wink": neutrals[0]}, neutrals[0])
    with pytest.raises(InputError, match="no expression 'wink'"):
        model.shape(model.vectors[0], "wink")
