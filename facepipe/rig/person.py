"""The person of a face: what is set on it before any expression (DESIGN section 10).

Bone coefficients that were applied, else the values of the sliders. Expressions play on top: of joint j the local
transform is ``rest_j M_j(person) M_j(expression)``, shape weights add.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.parts import Animation, FaceParts
from facepipe.rig.animation import places, sample_transforms, sample_weights
from facepipe.rig.bone_coefficients import coefficient_matrices, matrix_coefficients, rest_coefficients
from facepipe.rig.sliders import slide

POSES = ("set", "set-joints", "rest")  # what `--pose` takes beside the names of animations

_SLIDERS_NAMED = 3  # sliders of a description
_SAME_POSE = 1e-6


@dataclass(frozen=True, kw_only=True)
class Person:
    """Bone coefficients and shape weights that move the template to the person."""

    description: str  # "rest", or what it was set by
    coefficients: FloatArray  # (j, 9) relative to the template's rest
    weights: Mapping[str, float]  # of shapes

    @property
    def is_rest(self) -> bool:
        """Whether it is the template itself."""
        at_rest = (self.coefficients == rest_coefficients(len(self.coefficients))).all()
        return bool(at_rest) and not any(self.weights.values())

    @property
    def matrices(self) -> FloatArray:
        """(j, 4, 4) M_j(person)."""
        return coefficient_matrices(self.coefficients)

    def under(self, expression: FloatArray) -> FloatArray:
        """(..., j, 4, 4) matrices M(person) M(expression) of (..., j, 9) bone coefficients."""
        return np.asarray(self.matrices @ coefficient_matrices(expression))

    def weights_under(self, expression: Mapping[str, float]) -> dict[str, float]:
        """Shape weights of the person and of an expression together."""
        names = {*self.weights, *expression}
        return {name: self.weights.get(name, 0.0) + expression.get(name, 0.0) for name in names}


def person_of(parts: FaceParts, pose: str = "set") -> Person:
    """Who the face is.

    :param pose: ``set`` (or ``set-joints``): what is set on the face; ``rest``: the template; else an animation of the
        face, whose first sample it is
    :raises InputError: no such animation, or one that doesn't fit the face
    """
    if pose == "rest":
        return Person(description="rest", coefficients=rest_coefficients(len(parts.skeleton.joints)), weights={})
    if pose not in POSES:
        return _posed(parts, pose, f"pose {pose}")
    if parts.person is not None:
        return _posed(parts, parts.person, f"set by pose {parts.person}")
    moved = [slider for slider in parts.sliders if slider.value is not None and slider.value != slider.default]
    if not moved:
        return person_of(parts, "rest")
    coefficients, weights = slide(parts.sliders, parts.skeleton.joints, network=parts.slider_network)
    some = ", ".join(f"{slider.name}={slider.value:g}" for slider in moved[:_SLIDERS_NAMED])
    more = f" and {len(moved) - _SLIDERS_NAMED} more" if len(moved) > _SLIDERS_NAMED else ""
    return Person(description=f"set by sliders {some}{more}", coefficients=coefficients, weights=weights)


def is_person(parts: FaceParts, animation: Animation, person: Person) -> bool:
    """Whether an animation is a pose of the person without expression."""
    if animation.times is not None or not set(animation.joints) <= set(parts.skeleton.joints):
        return False
    weights, expected = sample_weights(animation), person.weights
    apart = [abs(weights.get(name, 0.0) - expected.get(name, 0.0)) for name in {*weights, *expected}]
    local = sample_transforms(parts.skeleton, animation)
    at = np.asarray(parts.skeleton.rest_transforms, dtype=np.float64) @ person.matrices
    tolerance = _SAME_POSE * max(1.0, float(np.abs(at).max(initial=0.0)))
    return max(apart, default=0.0) <= _SAME_POSE and bool((np.abs(local - at) <= tolerance).all())


def _posed(parts: FaceParts, name: str, description: str) -> Person:
    animation = next((candidate for candidate in parts.animations if candidate.name == name), None)
    if animation is None:
        raise InputError(
            parts.name, unknown(name, [*POSES, *(candidate.name for candidate in parts.animations)], "pose")
        )
    skeleton = parts.skeleton
    if animation.coefficients is not None:
        coefficients = rest_coefficients(len(skeleton.joints))
        coefficients[places(skeleton, animation)] = np.asarray(animation.coefficients)[0]
    else:
        rest = np.asarray(skeleton.rest_transforms, dtype=np.float64)
        try:
            change = np.linalg.solve(rest, sample_transforms(skeleton, animation))
        except np.linalg.LinAlgError:
            raise InputError(f"{parts.name} -> {skeleton.name}", "joints scaled to nothing at rest") from None
        coefficients = matrix_coefficients(change)
    return Person(description=description, coefficients=coefficients, weights=sample_weights(animation))
