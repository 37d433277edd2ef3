"""Examples of a face's own rig: its controls set in many ways, and where the points go."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.parts import FaceParts
from facepipe.processors.database import Topology
from facepipe.processors.neural_rig.motion import Motion, RecordedClips
from facepipe.processors.neural_rig.options import SampleMotionOptions
from facepipe.processors.same_topology import MILLIMETRES, world_to_world
from facepipe.rig import Rig, build, slide
from facepipe.rig.neural_rig import Control, bones_in, coefficients_in


@dataclass(frozen=True, kw_only=True)
class SampleMotion:
    """Sets the sliders of a face, and the shapes that no slider drives, and evaluates them with `facepipe.rig`.

    :param also: shapes to set beside the sliders that drive them
    """

    options: SampleMotionOptions = field(default_factory=SampleMotionOptions)
    also: Collection[str] = ()

    def __call__(
        self,
        parts: FaceParts,
        where: str,
        done: Callable[[], object] = lambda: None,
        clips: RecordedClips | None = None,
    ) -> Motion:
        """Frames of whole points, float32.

        :param clips: frames of the face's controls to evaluate too
        :param done: called once for each frame
        :raises InputError: a face without controls, or no frame asked for
        """
        controls = controls_of(parts, self.also)
        if not controls:
            raise InputError(where, "has neither sliders nor shapes, expected something to set")
        values: FloatArray = np.zeros((0, len(controls)))
        blocks: IntArray = np.zeros(0, dtype=int)
        if clips is None or self.options.count(len(controls)):
            values, blocks = plan(controls, self.options)
        if clips is not None:
            values, blocks = clips.after(values, blocks)
        motion = evaluated(parts, where, controls, values, blocks, _Sliders(parts, controls), done)
        return (
            motion
            if clips is None
            else replace(motion, source="rig and clips", between=clips.between, warnings=clips.warnings)
        )


def evaluated(
    parts: FaceParts,
    where: str,
    controls: tuple[Control, ...],
    values: FloatArray,
    blocks: IntArray,
    pose: Callable[[FloatArray], tuple[FloatArray, Mapping[str, float]]],
    done: Callable[[], object] = lambda: None,
) -> Motion:
    """What the rig of a face makes of (f, c) values.

    :param pose: bone coefficients (j, 9) and shape weights of (c,) values
    :param done: called once for each frame
    """
    rig, to = build(parts), world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES)
    rest = _placed(rig, to, *pose(np.array([control.default for control in controls])))
    points = np.empty((len(values), len(rest), 3), np.float32)
    coefficients = np.empty((len(values), len(rig.joints), 9))
    for number, row in enumerate(values):
        coefficients[number], weights = pose(row)
        points[number] = _placed(rig, to, coefficients[number], weights)
        done()
    bones = bones_in(rig, to) if rig.joints else None
    return Motion(
        where=where,
        topology=Topology.of(parts),
        controls=controls,
        values=values,
        points=points,
        rest=rest,
        blocks=blocks,
        bones=bones,
        coefficients=None if bones is None else coefficients_in(coefficients, np.cbrt(np.linalg.det(to[:3, :3]))),
    )


def _placed(rig: Rig, to: FloatArray, coefficients: FloatArray, weights: Mapping[str, float]) -> FloatArray:
    points = rig.evaluate(weights, coefficients=coefficients)
    return np.asarray(points @ to[:3, :3].T + to[:3, 3])


def controls_of(parts: FaceParts, also: Collection[str] = ()) -> tuple[Control, ...]:
    """The sliders that have a range, and the shapes that none of them drives, 0 to 1, in the order of the rig.

    :param also: shapes that are controls though sliders drive them
    """
    sliders = [one for one in parts.sliders if one.minimum < one.maximum]
    driven = {shape for one in sliders for shape, _ in one.shapes} - set(also) | {one.name for one in sliders}
    found = [Control(name=one.name, minimum=one.minimum, maximum=one.maximum, default=one.default) for one in sliders]
    shapes = dict.fromkeys(shape.name for mesh in parts.meshes for shape in mesh.blendshapes)
    return (*found, *(Control(name=shape) for shape in shapes if shape not in driven))


class _Sliders:
    """Bone coefficients and shape weights of values: of sliders, and of shapes that none of them drives."""

    def __init__(self, parts: FaceParts, controls: Sequence[Control]) -> None:
        self._parts = parts
        own = {one.name for one in parts.sliders}
        self._slider = [control.name in own for control in controls]
        self._names = [control.name for control in controls]

    def __call__(self, values: FloatArray) -> tuple[FloatArray, dict[str, float]]:
        """(j, 9) and weights by name, of (c,)."""
        pairs = list(zip(self._names, map(float, values), self._slider, strict=True))
        set_sliders = {name: value for name, value, slider in pairs if slider}
        others = {one.name: one.default for one in self._parts.sliders if one.name not in set_sliders}
        joints, network = self._parts.skeleton.joints, self._parts.slider_network
        coefficients, weights = slide(self._parts.sliders, joints, {**others, **set_sliders}, network)
        for name, value, slider in pairs:
            if not slider:
                weights[name] = weights.get(name, 0.0) + value
        return coefficients, weights


def plan(controls: Sequence[Control], options: SampleMotionOptions) -> tuple[FloatArray, IntArray]:
    """(f, c) values and (f,) blocks: each sweep is a block; what is drawn at random stands alone, a block each.

    :raises InputError: no frame asked for
    """
    low, high, rest = (np.array([getattr(one, key) for one in controls]) for key in ("minimum", "maximum", "default"))
    pieces = list(_sweeps(low, high, rest, options.sweep))
    random = np.random.default_rng(options.seed)
    spread = low + (high - low) * _hypercube(options.spread, len(controls), random)
    singles = np.concatenate(
        [
            np.where(_moved(options.spread, len(controls), options.busy, random), spread, rest),
            _combinations(low, high, rest, options.together, random),
        ]
    )
    sizes = [len(piece) for piece in pieces] + [1] * len(singles)
    values = np.concatenate([*pieces, singles])
    if not len(values):
        raise InputError("motion", "no frame, expected some of spread, sweep or together")
    return values, np.repeat(np.arange(len(sizes)), sizes)


def _hypercube(count: int, controls: int, random: np.random.Generator) -> FloatArray:
    """(count, controls) in 0..1: of each control, one in each `count`-th of its range (McKay et al. 1979)."""
    if not count:
        return np.zeros((0, controls))
    order = np.stack([random.permutation(count) for _ in range(controls)], axis=1)
    return np.asarray((order + random.random((count, controls))) / count)


def _moved(count: int, controls: int, busy: float, random: np.random.Generator) -> BoolArray:
    """(count, controls) which of them a frame moves: a share of them up to `busy`, another in each frame."""
    share = np.full(count, 1.0) if busy == 1.0 else busy * random.random(count)
    moved = random.random((count, controls)) < share[:, None]
    moved[np.arange(count), random.integers(controls, size=count)] = True  # no frame stays at rest
    return np.asarray(moved)


def _sweeps(low: FloatArray, high: FloatArray, rest: FloatArray, count: int) -> Iterator[FloatArray]:
    """Each control from one limit to the other, the others at rest."""
    for control in range(len(low)) if count else ():
        frames = np.tile(rest, (count, 1))
        frames[:, control] = np.linspace(low[control], high[control], count)
        yield frames


def _combinations(
    low: FloatArray, high: FloatArray, rest: FloatArray, count: int, random: np.random.Generator
) -> FloatArray:
    """(count, c): two or three controls anywhere, the others at rest; each control as often as any other."""
    frames = np.tile(rest, (count, 1))
    turns: list[int] = []
    for row in range(count):
        wanted = min(2 + row % 2, len(low))
        while len(turns) < wanted:
            turns += [one for one in random.permutation(len(low)).tolist() if one not in turns]
        chosen, turns = turns[:wanted], turns[wanted:]
        frames[row, chosen] = random.uniform(low[chosen], high[chosen])
    return frames
