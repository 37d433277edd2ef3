"""How far expressions on a set face are from the same expressions on the face that it was made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import FaceParts
from facepipe.rig.bone_coefficients import coefficient_matrices, rest_coefficients
from facepipe.rig.on_person import NewRest
from facepipe.rig.person import Person
from facepipe.rig.rig import Rig
from facepipe.rig.sliders import slide

POSES = 50
_TURN = 0.2  # radians
_MOVE_MM = 1.0
_SHAPES = 3  # on in each pose
_SEED = 0


@dataclass(frozen=True, kw_only=True)
class SetError:
    """Distances between points in mm, over all shapes at 1 and random poses of all joints within their limits."""

    mean_mm: float  # of the points' largest distances
    max_mm: float
    shapes: int
    poses: int
    sliders_max_mm: float  # over random settings of the sliders, within their ranges; 0 without sliders


def set_error(before: Rig, after: Rig, person: Person, new: NewRest, parts: FaceParts, result: FaceParts) -> SetError:
    """Compare both rigs, each shape at 1 and each pose of joints and shapes on top of the person.

    :param parts: that `before` was built of
    :param result: that `after` was built of
    """
    largest = np.zeros(len(before.points))
    shapes = [({name: 1.0}, rest_coefficients(len(before.joints))) for name in before.shapes]
    poses = random_poses(before, parts)
    for weights, expression in [*shapes, *poses]:
        together = person.weights_under(weights)
        exact = before.evaluate(together, joint_transforms=before.rest @ person.under(expression))
        own = after.evaluate(weights, joint_transforms=after.rest @ new.carried(coefficient_matrices(expression)))
        np.maximum(largest, np.linalg.norm(own - exact, axis=1), out=largest)
    largest *= 1000 * parts.meters_per_unit
    return SetError(
        mean_mm=float(largest.mean()) if len(largest) else 0.0,
        max_mm=float(largest.max(initial=0.0)),
        shapes=len(shapes),
        poses=len(poses),
        sliders_max_mm=1000 * parts.meters_per_unit * _sliders_apart(before, after, parts, result),
    )


def _sliders_apart(before: Rig, after: Rig, parts: FaceParts, result: FaceParts) -> float:
    """Largest distance between points under the same slider values, in stage units."""
    random, farthest = np.random.default_rng(_SEED), 0.0
    for _ in range(POSES if parts.sliders else 0):
        values = {one.name: float(random.uniform(one.minimum, one.maximum)) for one in parts.sliders}
        exact, own = (
            rig.evaluate(weights, coefficients=coefficients)
            for rig, (coefficients, weights) in (
                (before, slide(parts.sliders, before.joints, values, parts.slider_network)),
                (after, slide(result.sliders, after.joints, values, result.slider_network)),
            )
        )
        farthest = max(farthest, float(np.linalg.norm(own - exact, axis=1).max(initial=0.0)))
    return farthest


def random_poses(rig: Rig, parts: FaceParts) -> list[tuple[dict[str, float], FloatArray]]:
    """Shape weights and bone coefficients (j, 9) of random poses: up to 0.2 radians and 1 mm within the limits."""
    random = np.random.default_rng(_SEED)
    reach = np.zeros(9)
    reach[:3], reach[3:6] = _MOVE_MM / (1000 * parts.meters_per_unit), _TURN
    rest = rest_coefficients(len(rig.joints))
    low, high = rest - reach, rest + reach
    if parts.bone_limits is not None:
        low, high = np.maximum(low, parts.bone_limits.lower), np.minimum(high, parts.bone_limits.upper)
        low, high = np.minimum(low, rest), np.maximum(high, rest)
    found: list[tuple[dict[str, float], FloatArray]] = []
    for _ in range(POSES):
        chosen = random.permutation(len(rig.shapes))[:_SHAPES]
        weights = {rig.shapes[i]: float(random.random()) for i in chosen}
        found.append((weights, low + random.random(rest.shape) * (high - low)))
    return found
