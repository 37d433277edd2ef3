"""Frames of points on a stage: of a face that a SkelAnimation moves, and those that controls are to be found for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.geometry.vectors import transformed
from facepipe.parts import Animation, FaceParts
from facepipe.rig import Rig, build, coefficient_matrices, matrix_coefficients, sample_transforms, sample_weights
from facepipe.rig.neural_rig import NeuralRig, bones_in, coefficients_in
from facepipe.stage import open_face
from facepipe.stage.animation_source import moving_animation
from facepipe.stage.point_cache import read_point_cache
from facepipe.verbs.cached_points import cached_points
from facepipe.verbs.same_topology import MILLIMETRES, world_to_world
from facepipe.verbs.whole_faces import Topology

_DIGITS = 9  # of time codes: what going by seconds has rounded comes back
_SHEAR = 1e-6  # stage units and shares that bone coefficients may miss a transform by
_GAP = 2.0  # steps without a frame: more, and another clip begins


class AnimatedFace:
    """World points of a face that an animation moves, in stage units."""

    def __init__(self, parts: FaceParts, animation: Animation) -> None:
        self.parts, self.animation, self.meshes = parts, animation, parts.meshes
        self.count = animation.samples
        self._rig = build(parts)

    @classmethod
    def read(cls, path: Path) -> AnimatedFace | None:
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
        coefficients = matrix_coefficients(moves)
        if np.abs(coefficient_matrices(coefficients) - moves).max() > _SHEAR:
            return None, None
        return bones_in(self._rig, to), coefficients_in(coefficients, float(np.cbrt(np.linalg.det(to[:3, :3]))))

    def _local(self, number: int) -> FloatArray:
        return sample_transforms(self.parts.skeleton, self.animation, number)


@dataclass(frozen=True, kw_only=True)
class Targets:
    """Whole points over time."""

    points: FloatArray  # (f, n, 3) millimetres, float32
    codes: FloatArray  # (f,) time codes; none of a pose, f = 1
    codes_per_second: float

    @property
    def blocks(self) -> IntArray:
        """(f,) clips, which end where more than two steps pass without a frame; a step is the shortest time."""
        if len(self.codes) < 2:
            return np.zeros(len(self.points), np.int64)
        apart = np.diff(self.codes)
        return np.concatenate([[0], np.cumsum(apart > _GAP * apart.min())])


def read_targets(path: Path, rig: NeuralRig) -> Targets:
    """The meshes of a stage at their time samples. Without these a face is what its rig makes of the animation that
    moves it, and any other stage what its points are without time; then skins and blendshapes are left out.

    :raises InputError: no readable USD, no mesh, NaN, or several animations of which the skeleton plays none
    :raises TopologyError: other meshes than the rig was learned on
    """
    cache = read_point_cache(path)
    if not cache.meshes:
        raise InputError(path, "no mesh, expected those that the neural rig was learned on")
    codes: FloatArray = cache.codes
    animated = None
    if cache.has_face and not len(codes):
        animated = AnimatedFace.read(path)
        codes = codes if animated is None else animated.codes(cache.codes_per_second)
    placed = animated or cached_points(cache, path)
    _check(path, Topology.of(FaceParts(meshes=placed.meshes)), rig)
    to = world_to_world(cache.meters_per_unit, cache.up_axis, MILLIMETRES)
    points = np.empty((placed.count, len(rig.rest), 3), np.float32)
    for number, own in enumerate(points):
        own[:] = transformed(placed.sample(number), to)
    return Targets(points=points, codes=codes, codes_per_second=cache.codes_per_second)


def _check(path: Path, topology: Topology, rig: NeuralRig) -> None:
    """:raises TopologyError: another one than the rig's"""
    if topology.digest != rig.topology:
        what = f"meshes {', '.join(topology.names[:4])} of {topology.point_count:,} points"
        expected = f"expected those that the neural rig was learned on, of {len(rig.rest):,} points, with their faces"
        raise TopologyError(path, f"{what}, {expected}")
