"""The analytic Jacobian against automatic differentiation of the same tree, written down a second time."""

from __future__ import annotations

import autograd.numpy as anp
import numpy as np
from autograd import jacobian as differentiated
from bone_rigs import face_joints, head, jacobian, random_pose

from facepipe.rig import Rig
from facepipe.verbs.fit_bones.skinning import Tree


def local(c: anp.ndarray) -> anp.ndarray:
    """(4, 4) T(t) Rz Rx Ry S(s) of one joint, as DESIGN section 7 has it."""
    (cx, cy, cz), (sx, sy, sz) = anp.cos(c[3:6]), anp.sin(c[3:6])
    Rz = anp.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    Rx = anp.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    Ry = anp.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    linear = anp.dot(anp.dot(anp.dot(Rz, Rx), Ry), anp.diag(c[6:9]))
    return anp.concatenate([anp.concatenate([linear, c[:3, None]], axis=1), anp.array([[0.0, 0.0, 0.0, 1.0]])])


def skinned(rig: Rig, points: np.ndarray, weights: np.ndarray, coefficients: anp.ndarray) -> anp.ndarray:
    worlds: list[anp.ndarray] = []
    for joint, parent in enumerate(rig.parents):
        above = rig.parent_world if parent < 0 else worlds[parent]
        worlds.append(anp.dot(above, anp.dot(rig.rest[joint], local(coefficients[joint]))))
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    moved = [
        anp.dot(homogeneous, anp.dot(world, bind)[:3].T) for world, bind in zip(worlds, rig.inverse_bind, strict=True)
    ]
    return sum(weights[:, [joint]] * own for joint, own in enumerate(moved))


def test_the_jacobian_agrees_with_automatic_differentiation() -> None:
    rig, rng = head(), np.random.default_rng(0)
    count = len(rig.joints)
    pose = random_pose(rng, count, np.arange(count))
    chosen = np.sort(rng.choice(len(rig.points), 12, replace=False))
    weights = rig.influences[chosen][:, :count].toarray()
    joints = face_joints(rig)[::7]

    def moved(own: anp.ndarray) -> anp.ndarray:
        rows = [own[list(joints).index(joint)] if joint in joints else pose[joint] for joint in range(count)]
        return skinned(rig, rig.points[chosen], weights, rows)

    expected = differentiated(moved)(pose[joints])  # (12, 3, joints, 9)
    columns = (joints[:, None] * 9 + np.arange(9)).ravel()
    rows = (chosen[:, None] * 3 + np.arange(3)).ravel()
    found = jacobian(Tree(rig), pose)[np.ix_(rows, columns)]
    np.testing.assert_allclose(found, expected.reshape(36, -1), atol=1e-10 * np.abs(expected).max())
