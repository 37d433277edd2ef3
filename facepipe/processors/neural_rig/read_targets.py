"""Frames that the controls of a neural rig are to be found for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.parts import FaceParts
from facepipe.processors.cached_points import cached_points
from facepipe.processors.database import Topology
from facepipe.processors.neural_rig.animated_face import AnimatedFace
from facepipe.processors.same_topology import MILLIMETRES, world_to_world
from facepipe.rig.neural_rig import NeuralRig
from facepipe.stage.point_cache import read_point_cache

_GAP = 2.0  # steps without a frame: more, and another clip begins


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
        animated = AnimatedFace.of(path)
        codes = codes if animated is None else animated.codes(cache.codes_per_second)
    placed = animated or cached_points(cache, path)
    _check(path, Topology.of(FaceParts(meshes=placed.meshes)), rig)
    to = world_to_world(cache.meters_per_unit, cache.up_axis, MILLIMETRES)
    points = np.empty((placed.count, len(rig.rest), 3), np.float32)
    for number, own in enumerate(points):
        own[:] = placed.sample(number) @ to[:3, :3].T + to[:3, 3]
    return Targets(points=points, codes=codes, codes_per_second=cache.codes_per_second)


def _check(path: Path, topology: Topology, rig: NeuralRig) -> None:
    """:raises TopologyError: another one than the rig's"""
    if topology.digest != rig.topology:
        what = f"meshes {', '.join(topology.names[:4])} of {topology.point_count:,} points"
        expected = f"expected those that the neural rig was learned on, of {len(rig.rest):,} points, with their faces"
        raise TopologyError(path, f"{what}, {expected}")
