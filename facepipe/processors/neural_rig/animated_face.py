"""A face that a SkelAnimation moves, as frames of points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.parts import Animation, FaceParts
from facepipe.rig import Rig, build, coefficient_matrices, matrix_coefficients, sample_transforms, sample_weights
from facepipe.rig.neural_rig import bones_in, coefficients_in
from facepipe.stage import open_face
from facepipe.stage.animation_source import moving_animation

_DIGITS = 9  # of time codes: what going by seconds has rounded comes back
_SHEAR = 1e-6  # stage units and shares that bone coefficients may miss a transform by


class AnimatedFace:
    """World points of a face that an animation moves, in stage units."""

    def __init__(self, parts: FaceParts, animation: Animation) -> None:
        self.parts, self.animation, self.meshes = parts, animation, parts.meshes
        self.count = 1 if animation.times is None else len(animation.times)
        self._rig = build(parts)

    @classmethod
    def of(cls, path: Path) -> AnimatedFace | None:
        """The face of a stage with what moves it; None where nothing does.

        :raises InputError: NaN, or several animations over time of which the skeleton plays none
        """
        face = open_face(path)
        animation = moving_animation(face)
        return None if animation is None else cls(face.parts(), animation)

    def codes(self, codes_per_second: float) -> npt.NDArray[np.float64]:
        """(f,) time codes of the samples; none of a pose."""
        times = self.animation.times
        return np.zeros(0) if times is None else np.round(np.asarray(times) * codes_per_second, _DIGITS)

    def sample(self, number: int) -> FloatArray:
        """(n, 3)."""
        return self._rig.evaluate(sample_weights(self.animation, number), joint_transforms=self._local(number))

    def untimed(self) -> FloatArray:
        """(n, 3) at rest."""
        return self._rig.evaluate()

    def bones(self, to: FloatArray, samples: IntArray) -> tuple[Rig | None, FloatArray | None]:
        """The joints in millimetres, and (k, j, 9) bone coefficients; None without joints, or with sheared ones.

        :param to: (4, 4) from the stage's world
        """
        if not self._rig.joints:
            return None, None
        moves = np.linalg.solve(self._rig.rest, np.stack([self._local(int(number)) for number in samples]))
        found = matrix_coefficients(moves)
        if np.abs(coefficient_matrices(found) - moves).max() > _SHEAR:
            return None, None
        return bones_in(self._rig, to), coefficients_in(found, float(np.cbrt(np.linalg.det(to[:3, :3]))))

    def _local(self, number: int) -> FloatArray:
        return sample_transforms(self.parts.skeleton, self.animation, number)
