"""What the sliders of a blend are set to: the mean of what they are set to in the sources, where they add nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import FaceParts, Slider
from facepipe.rig.joint_names import joint_key
from facepipe.rig.sliders import clamped_value, network_resting_at, resting_at
from facepipe.verbs.blend.session import Solution
from facepipe.verbs.blend.sources import Sources

_DECIMALS = 6  # of a value: the last bits of shares differ with the threads of BLAS


def with_settings(sources: Sources, solution: Solution) -> FaceParts:
    """The base with its sliders set as the person of the blend.

    A source's setting is in its neutral already, and its slider rests there (`set_face`); so does that of a blend, at
    the mean of the sources' values under the shares of the points, else joints, that it moves. Set beside a default of
    0, it would move the blended neutral a second time. Sources without the slider, or in which it drives others or
    has another range, leave their share to the rest.
    """
    base = sources.base
    values = {slider.name: _value(slider, sources, solution) for slider in base.sliders}
    if all(values[slider.name] == clamped_value(slider) for slider in base.sliders):
        return base
    network = base.slider_network
    return replace(
        base,
        sliders=tuple(resting_at(slider, values[slider.name]) for slider in base.sliders),
        slider_network=network and network_resting_at(network, values),
    )


def _value(slider: Slider, sources: Sources, solution: Solution) -> float:
    settings = []
    for parts in sources.parts:
        twin = next((one for one in parts.sliders if one.name == slider.name and _drive(one) == _drive(slider)), None)
        settings.append(None if twin is None else clamped_value(twin))
    known = [k for k, value in enumerate(settings) if value is not None]
    given = np.array([settings[k] for k in known], dtype=np.float64)
    if (given == given[0]).all():
        return clamped_value(slider)
    shares = _shares(slider, sources, solution)[known]
    if not shares.sum() > 0:
        return clamped_value(slider)
    mean = round(float(shares @ given / shares.sum()), _DECIMALS)
    return min(max(mean, slider.minimum), slider.maximum)


def _drive(slider: Slider) -> tuple[float, float, frozenset[str], frozenset[str]]:
    """Its range, and the names of what it moves; not by how much, which is each person's own."""
    joints = frozenset(joint_key(joint.rpartition("/")[2]) for joint, _, _ in slider.channels)
    return slider.minimum, slider.maximum, frozenset(shape for shape, _ in slider.shapes), joints


def _shares(slider: Slider, sources: Sources, solution: Solution) -> FloatArray:
    """(K,) shares of what it moves: the mean over points of its shapes, else over its joints, else the default's.

    Points count by the square of how far they move: of noseWidth of the built-in head, which moves all teeth a little,
    the nose then has 56 %, by the distances 29 %.
    """
    neutral, gains = solution.neutral, dict(slider.shapes)
    moved = np.zeros(len(neutral.points))
    for sculpt in solution.sculpts:
        if sculpt.inbetween is None and sculpt.shape in gains:
            moved[sculpt.points] += gains[sculpt.shape] ** 2 * (sculpt.offsets**2).sum(axis=2).mean(axis=0)
    if moved.any():
        return np.asarray(moved @ neutral.shares / moved.sum())
    joints = sources.base.skeleton.joints
    rows = [joints.index(joint) for joint in dict.fromkeys(joint for joint, _, _ in slider.channels) if joint in joints]
    return np.asarray(neutral.joint_shares[rows].mean(axis=0) if rows else neutral.table[-1])
