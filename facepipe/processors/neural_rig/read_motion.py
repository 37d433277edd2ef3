"""Examples of any rig from a stage: controls over time, and the point cache of what they moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError
from facepipe.parts import FaceParts
from facepipe.processors.cached_points import CachedPoints, cached_points
from facepipe.processors.database import Topology
from facepipe.processors.neural_rig.frame_blocks import FrameBlocksOptions, frame_blocks
from facepipe.processors.neural_rig.motion import Motion
from facepipe.processors.same_topology import MILLIMETRES, world_to_world
from facepipe.rig.neural_rig import Control
from facepipe.stage.control_track import ControlTrack
from facepipe.stage.point_cache import PointCache, read_point_cache
from facepipe.stage.read_controls import read_controls

FloatArray = npt.NDArray[np.floating]


@dataclass(frozen=True, kw_only=True)
class ReadMotion:
    """Reads what another program baked of its own rig; docs/neural_rig.md tells the convention.

    :param prims: paths of prims whose own numbers are the controls; none for what the convention says
    """

    options: FrameBlocksOptions = field(default_factory=FrameBlocksOptions)
    prims: Sequence[str] = ()

    def __call__(self, path: Path) -> Motion:
        """The frames of a stage, float32.

        Frames are the times at which controls or points have samples; what has none at a time must be held there. Rest
        is the first frame with all controls at their defaults, else the points authored without time.

        :raises InputError: no readable USD, no controls, no point cache, a single frame, NaN, values beyond limits, no
            rest, or a time at which controls or points are not known
        :raises TopologyError: a mesh whose number of points changes
        """
        tracks = read_controls(path, self.prims)
        sampled = sorted({float(code) for track in tracks for code in track.codes})
        if not sampled:
            what = "no control with time samples, expected facepipe:control:<name>, sliders or shape weights"
            raise InputError(path, what)
        cache = read_point_cache(path, also=sampled)
        if not cache.moving.any():
            raise InputError(path, "no point cache, expected meshes whose points have time samples")
        if len(cache.codes) < 2:
            raise InputError(path, "one frame, expected several")
        _check_times(path, tracks, np.array(sampled), cache)
        return self._motion(path, tracks, cache)

    def _motion(self, path: Path, tracks: Sequence[ControlTrack], cache: PointCache) -> Motion:
        controls = tuple(_control(path, track) for track in tracks)
        values = np.stack([track.at(cache.codes) for track in tracks], axis=1)
        chosen, blocks = frame_blocks(cache.codes, values, self.options)
        placed, to = cached_points(cache, path), world_to_world(cache.meters_per_unit, cache.up_axis, MILLIMETRES)
        rest = _rest(path, controls, values, placed) @ to[:3, :3].T + to[:3, 3]
        points = np.empty((len(chosen), *rest.shape), np.float32)
        for own, number in zip(points, chosen, strict=True):
            own[:] = placed.sample(int(number)) @ to[:3, :3].T + to[:3, 3]
        return Motion(
            where=str(path),
            topology=Topology.of(FaceParts(meshes=placed.meshes)),
            controls=controls,
            values=values[chosen],
            points=points,
            rest=rest,
            blocks=blocks,
            source="samples",
            between=len(values) - len(chosen),
        )


def _check_times(path: Path, tracks: Sequence[ControlTrack], sampled: FloatArray, cache: PointCache) -> None:
    """:raises InputError: the first time at which controls or points are not known"""
    moving = cache.codes[cache.moving]
    faults: list[tuple[float, str, str]] = []
    for what, codes, ends in (("points", sampled, moving), ("controls", moving, sampled)):
        beyond = codes[(codes < ends[0]) | (codes > ends[-1])]
        if len(beyond):
            faults.append((float(beyond[0]), what, f"sampled from {ends[0]:g} to {ends[-1]:g} only"))
    between = "no sample, between two that differ"
    for name, guessed in (
        *((track.where, track.guessed(cache.codes)) for track in tracks),
        *((one.mesh.name, one.guessed) for one in cache.meshes),
    ):
        faults += [(float(code), name, between) for code in cache.codes[guessed][:1]]
    if faults:
        code, name, what = min(faults)
        expected = "expected controls and points sampled at the same times"
        raise InputError(f"{path} -> {name} -> time code {code:g}", f"{what}, {expected}")


def _control(path: Path, track: ControlTrack) -> Control:
    """Its limits, where they are not authored, are how far it goes; of one that never moves, any."""
    default = float(track.values[0]) if track.default is None else track.default
    low = min(default, float(track.values.min())) if track.minimum is None else track.minimum
    high = max(default, float(track.values.max())) if track.maximum is None else track.maximum
    if not low <= default <= high:
        raise InputError(f"{path} -> {track.where}", f"default {default:g}, expected {low:g} to {high:g}")
    return Control(name=track.name, minimum=low, maximum=high if low < high else low + 1.0, default=default)


def _rest(path: Path, controls: Sequence[Control], values: FloatArray, placed: CachedPoints) -> FloatArray:
    """(n, 3) world points in stage units."""
    at_rest = np.flatnonzero((values == [control.default for control in controls]).all(axis=1))
    if len(at_rest):
        return placed.sample(int(at_rest[0]))
    if placed.untimed is None:
        what = "no frame with all controls at their defaults, and no points without time, expected one of them"
        raise InputError(path, what)
    return placed.untimed()
