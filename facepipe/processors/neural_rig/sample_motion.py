"""Examples of a face's own rig: its controls set in many ways, and where the points go."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError
from facepipe.options import check_ranges
from facepipe.parts import FaceParts
from facepipe.processors.database import Topology
from facepipe.processors.neural_rig.motion import Motion
from facepipe.processors.neural_rig.recorded_clips import RecordedClips
from facepipe.processors.same_topology import world_to_world
from facepipe.rig import Rig, build, slide
from facepipe.rig.neural_rig import Control

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

_MILLIMETRES = FaceParts(name="millimetres", meters_per_unit=0.001, up_axis="Y")


@dataclass(frozen=True, kw_only=True)
class SampleMotionOptions:
    """How many frames of which kind.

    :raises InputError: a number out of range
    """

    spread: int = field(
        default=1000,
        metadata={"help": "frames of all controls at once, spread evenly (latin hypercube)", "range": (0, 1e6)},
    )
    sweep: int = field(
        default=8, metadata={"help": "frames of each control alone, from one limit to the other", "range": (0, 1000)}
    )
    together: int = field(default=500, metadata={"help": "frames of two or three controls at once", "range": (0, 1e6)})
    seed: int = field(default=0, metadata={"help": "another number draws other frames", "range": (0, 2**31)})

    def __post_init__(self) -> None:
        check_ranges(self)

    def count(self, controls: int) -> int:
        """Frames of so many controls."""
        return self.spread + self.sweep * controls + self.together


@dataclass(frozen=True, kw_only=True)
class SampleMotion:
    """Sets the sliders of a face, and the shapes that no slider drives, and evaluates them with `facepipe.rig`.

    Each sweep is a block; what is drawn at random stands alone, a block each.
    """

    options: SampleMotionOptions = field(default_factory=SampleMotionOptions)

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
        controls = controls_of(parts)
        if not controls:
            raise InputError(where, "has neither sliders nor shapes, expected something to set")
        values: FloatArray = np.zeros((0, len(controls)))
        blocks: IntArray = np.zeros(0, dtype=int)
        if clips is None or self.options.count(len(controls)):
            values, blocks = _plan(controls, self.options)
        if clips is not None:
            values, blocks = clips.after(values, blocks)
        evaluate = _Evaluation(parts, controls)
        rest = evaluate(np.array([control.default for control in controls]))
        points = np.empty((len(values), len(rest), 3), np.float32)
        for number, row in enumerate(values):
            points[number] = evaluate(row)
            done()
        motion = Motion(
            where=where,
            topology=Topology.of(parts),
            controls=controls,
            values=values,
            points=points,
            rest=rest,
            blocks=blocks,
        )
        return motion if clips is None else replace(motion, source="rig and clips", warnings=clips.warnings)


def controls_of(parts: FaceParts) -> tuple[Control, ...]:
    """The sliders that have a range, and the shapes that none of them drives, 0 to 1, in the order of the rig."""
    sliders = [one for one in parts.sliders if one.minimum < one.maximum]
    driven = {shape for one in sliders for shape, _ in one.shapes} | {one.name for one in sliders}
    found = [Control(name=one.name, minimum=one.minimum, maximum=one.maximum, default=one.default) for one in sliders]
    shapes = dict.fromkeys(shape.name for mesh in parts.meshes for shape in mesh.blendshapes)
    return (*found, *(Control(name=shape) for shape in shapes if shape not in driven))


class _Evaluation:
    """Whole points by values of controls."""

    def __init__(self, parts: FaceParts, controls: Sequence[Control]) -> None:
        self._parts, self._rig = parts, build(parts)
        own = {one.name for one in parts.sliders}
        self._slider = [control.name in own for control in controls]
        self._names = [control.name for control in controls]
        self._to_millimetres = world_to_world(parts.meters_per_unit, parts.up_axis, _MILLIMETRES)

    def __call__(self, values: FloatArray) -> FloatArray:
        """(n, 3) of (c,)."""
        rig: Rig = self._rig
        pairs = list(zip(self._names, map(float, values), self._slider, strict=True))
        set_sliders = {name: value for name, value, slider in pairs if slider}
        others = {one.name: one.default for one in self._parts.sliders if one.name not in set_sliders}
        coefficients, weights = slide(
            self._parts.sliders, rig.joints, {**others, **set_sliders}, self._parts.slider_network
        )
        for name, value, slider in pairs:
            if not slider:
                weights[name] = weights.get(name, 0.0) + value
        points, to = rig.evaluate(weights, coefficients=coefficients), self._to_millimetres
        return np.asarray(points @ to[:3, :3].T + to[:3, 3])


def _plan(controls: Sequence[Control], options: SampleMotionOptions) -> tuple[FloatArray, IntArray]:
    """(f, c) values and (f,) blocks."""
    low, high, rest = (np.array([getattr(one, key) for one in controls]) for key in ("minimum", "maximum", "default"))
    pieces = list(_sweeps(low, high, rest, options.sweep))
    random = np.random.default_rng(options.seed)
    singles = np.concatenate(
        [
            low + (high - low) * _hypercube(options.spread, len(controls), random),
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
