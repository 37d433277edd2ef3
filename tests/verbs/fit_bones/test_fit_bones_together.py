"""Fits of many targets at once against fits of each alone."""

from __future__ import annotations

import numpy as np
import pytest
from bone_rigs import MM, face_joints, head, jacobian, limits, random_pose

from facepipe.rig import rest_coefficients
from facepipe.verbs.fit_bones import bone_fit
from facepipe.verbs.fit_bones.bone_fit import BoneFit
from facepipe.verbs.fit_bones.solver import SETTLED, _Memory, fit_together


def few_joints() -> np.ndarray:
    """A third of MakeHuman's face joints: fits of all of them take ten times as long."""
    return face_joints(head())[::3]


def out_of_reach(count: int, reach: float, seed: int = 0) -> list[np.ndarray]:
    """Targets near poses of those joints, but on none."""
    rig, rng = head(), np.random.default_rng(seed)
    joints, rest = few_joints(), rest_coefficients(len(rig.joints))
    targets = []
    for number in range(count):
        pose = rest + reach * (random_pose(rng, len(rest), joints) - rest)
        targets.append(rig.evaluate(coefficients=pose) + 0.01 * np.sin((number + 3.0) * rig.points))
    return targets


def fit_of(reach: float, joints: np.ndarray, **settings: object) -> BoneFit:
    rig = head()
    lower, upper = limits(len(rig.joints), joints)
    rest = rest_coefficients(len(rig.joints))
    box = {"lower": rest + reach * (lower - rest), "upper": rest + reach * (upper - rest)}
    return BoneFit(rig, **box, threshold=1e-3 / MM, rounds=0, **settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("settings", [{}, {"regularise": 1e-2}, {"weights": np.linspace(0.0, 2.0, 5082)}])
def test_targets_fitted_at_once_end_where_each_alone_does(settings: dict[str, object]) -> None:
    targets, fit = out_of_reach(3, 0.2), fit_of(1.0, few_joints(), **settings)
    for one, target in zip(fit.fit_all(targets), targets, strict=True):
        alone = fit.fit(target)
        assert one.slope <= SETTLED
        np.testing.assert_allclose(one.coefficients, alone.coefficients, atol=1e-5)
        np.testing.assert_allclose(one.points, fit.rig.evaluate(coefficients=one.coefficients), atol=1e-12)


@pytest.mark.parametrize("reach", [1.0, 0.3, 0.05])
def test_fits_end_at_optima_inside_the_limits(reach: float) -> None:
    """By the Jacobian, where limits hold none, some and most of the coefficients."""
    targets, fit = out_of_reach(4, 0.2, seed=1), fit_of(reach, few_joints())
    for found, target in zip(fit.fit_all(targets), targets, strict=True):
        own = found.coefficients
        assert ((own >= fit.lower) & (own <= fit.upper)).all()
        columns = (fit.free[:, None] * 9 + np.arange(9)).ravel()
        J = jacobian(fit.tree, own, fit.free)
        gradient, left = J.T @ (found.points - target).ravel(), np.linalg.norm(found.points - target)
        x, low, high = (array.ravel()[columns] for array in (own, fit.lower, fit.upper))
        held = ((x <= low) & (gradient > 0)) | ((x >= high) & (gradient < 0))
        assert np.abs(gradient / (left * np.maximum(np.linalg.norm(J, axis=0), 1e-6)))[~held].max() <= 1e-6


def test_shared_steps_reach_an_optimum_by_themselves() -> None:
    fit, points = fit_of(1.0, face_joints(head()), regularise=0.1), head().points
    targets = [points + 1e-4 * np.sin((number + 3.0) * points) for number in range(4)]
    ends = fit_together(fit.problem, fit.inverse, np.stack(targets), rest_coefficients(len(fit.rig.joints)), 60, 1e-9)
    assert [end.slope <= SETTLED for end in ends] == [True] * 4
    assert max(end.steps for end in ends) <= 18  # 13; twice as many without what steps change of the gradient


def test_targets_in_reach_are_reached() -> None:
    rig, rng = head(), np.random.default_rng(2)
    poses = [random_pose(rng, len(rig.joints), face_joints(rig)) for _ in range(3)]
    fit = fit_of(1.0, face_joints(rig))
    for found in fit.fit_all([rig.evaluate(coefficients=pose) for pose in poses]):
        assert found.largest <= fit.threshold


def test_what_is_fitted_beside_a_target_changes_nothing_but_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bone_fit, "_MANY", 2)
    one, two, three = *out_of_reach(1, 0.05, seed=3), *out_of_reach(2, 0.05, seed=4)
    fit = fit_of(1.0, few_joints())
    alone = [fit.fit(target) for target in (two, one, three)]
    for found, own in zip(fit.fit_all([two, one, three]), alone, strict=True):
        np.testing.assert_allclose(found.coefficients, own.coefficients, atol=1e-5)


def test_held_unknowns_stay_and_the_others_step_as_if_they_were_not_there() -> None:
    random = np.random.default_rng(0)
    root = random.normal(size=(4, 4))
    hessian = root @ root.T + np.eye(4)
    gradient, inside = random.normal(size=(2, 4)), np.array([[True] * 4, [True, False, True, False]])
    found = _Memory(np.linalg.inv(hessian)).direction(gradient, inside)
    expected = np.zeros((2, 4))
    for row, free in enumerate(inside):
        expected[row, free] = -np.linalg.solve(hessian[np.ix_(free, free)], gradient[row, free])
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_what_a_step_changed_of_the_gradient_is_undone_by_that_step() -> None:
    """The secant equation, for the last step of each target."""
    random = np.random.default_rng(0)
    root = random.normal(size=(4, 4))
    hessian, steps = root @ root.T + np.eye(4), random.normal(size=(3, 2, 4))
    memory = _Memory(np.eye(4))
    for step in steps:
        memory.add(step, step @ hessian)
    found = memory.direction(steps[-1] @ hessian, np.ones((2, 4), dtype=bool))
    np.testing.assert_allclose(found, -steps[-1], atol=1e-12)
