"""Joints that are learnt from example faces carry faces that they were not learnt from."""

from __future__ import annotations

import numpy as np

from facepipe.rig.identity_joints import IdentityJoints
from facepipe.rig.joint_learning import LearntJoints, learn_joints

_SIDE = 24


def sheet() -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) points of a bent sheet of 115 mm, 5 mm apart, and its edges."""
    x, y = np.meshgrid(5.0 * np.arange(_SIDE), 5.0 * np.arange(_SIDE), indexing="ij")
    number = np.arange(_SIDE**2).reshape(_SIDE, _SIDE)
    edges = [(number[1:].ravel(), number[:-1].ravel()), (number[:, 1:].ravel(), number[:, :-1].ravel())]
    return np.stack([x, y, 0.01 * (x - 60) ** 2], axis=-1).reshape(-1, 3), np.hstack(edges).T


def truth(points: np.ndarray) -> IdentityJoints:
    """Nine joints with smooth weights, four a point."""
    places = np.array([(x, y, 0.0) for x in (20, 60, 100) for y in (20, 60, 100)], float)
    close = np.exp(-(((points[:, None] - places) ** 2).sum(axis=2)) / (2 * 18.0**2))
    indices = np.argsort(-close, axis=1)[:, :4]
    weights = np.take_along_axis(close, indices, axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    return IdentityJoints(rows=np.arange(len(points)), points=points, places=places, indices=indices, weights=weights)


def examples(joints: IdentityJoints, count: int, seed: int) -> np.ndarray:
    """(s, n, 3) what small coefficients do."""
    random = np.random.default_rng(seed)
    some = np.zeros((count, len(joints.places), 9))
    some[..., 6:] = 1.0
    some += random.normal(0, np.repeat([1.0, 0.05, 0.05], 3), some.shape)
    return np.array([joints.offsets(one) for one in some])


def left(found: LearntJoints, points: np.ndarray, offsets: np.ndarray) -> float:
    """Of the root mean square, what the best coefficients leave."""
    whole = IdentityJoints(rows=np.arange(len(points)), points=points, **vars(found))
    flat = offsets.reshape(len(offsets), -1).T
    ways = whole.ways.toarray()
    rest = flat - ways @ np.linalg.lstsq(ways, flat, rcond=None)[0]
    return float(np.sqrt((rest**2).mean() / (flat**2).mean()))


def test_what_joints_made_joints_are_learnt_for() -> None:
    points, edges = sheet()
    joints = truth(points)
    offsets, unseen = examples(joints, 40, 0), examples(joints, 10, 1)
    sizes = {"count": 9, "influences": 4}
    first = learn_joints(points, edges, offsets, rounds=0, **sizes)
    found = learn_joints(points, edges, offsets, rounds=25, **sizes)
    assert left(found, points, unseen) < 0.1
    assert left(found, points, unseen) < 0.4 * left(first, points, unseen)
    np.testing.assert_allclose(found.weights.sum(axis=1), 1.0)
    assert (found.weights >= 0).all()
    assert found.indices.shape == (len(points), 4)


def test_a_few_rounds_settle() -> None:
    """Each goes on beyond the last one: without that 15 leave 0.07, and 40 leave 0.02."""
    points, edges = sheet()
    joints = truth(points)
    offsets, unseen = examples(joints, 40, 0), examples(joints, 10, 1)
    found = learn_joints(points, edges, offsets, rounds=15, count=9, influences=4)
    assert left(found, points, unseen) < 0.04


def test_what_modes_do_is_not_left_to_joints() -> None:
    """Modes that are large, and joints: learnt together, joints carry what is theirs."""
    points, edges = sheet()
    joints, random = truth(points), np.random.default_rng(2)
    modes = np.array([np.sin(points / 9.0 + phase)[:, [1, 2, 0]] for phase in range(3)])
    unseen, offsets = examples(joints, 10, 1), examples(joints, 40, 0)
    mixed = offsets + np.tensordot(random.normal(0, 3, (40, 3)), modes, axes=1)
    sizes = {"count": 9, "influences": 4, "rounds": 15}
    together = learn_joints(points, edges, mixed, modes=modes, **sizes)
    alone = learn_joints(points, edges, mixed, **sizes)
    assert left(together, points, unseen) < left(alone, points, unseen)


def test_same_examples_give_the_same_joints() -> None:
    points, edges = sheet()
    offsets = examples(truth(points), 12, 0)
    one, other = (learn_joints(points, edges, offsets, count=9, influences=4, rounds=3) for _ in range(2))
    np.testing.assert_array_equal(one.weights, other.weights)
    np.testing.assert_array_equal(one.places, other.places)
