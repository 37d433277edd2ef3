"""What a slider does: it adds to bone coefficients and shape weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError
from facepipe.parts import Slider
from facepipe.rig.bone_coefficients import CHANNELS, rest_coefficients

FloatArray = npt.NDArray[np.floating]


def slide(
    sliders: Sequence[Slider], joints: Sequence[str], values: Mapping[str, float] | None = None
) -> tuple[FloatArray, dict[str, float]]:
    """Bone coefficients (j, 9) and shape weights that slider values stand for.

    Each slider adds ``gain * (value - default)`` to its channels and shapes; values are clamped to the slider's
    range. Sliders that are not in `values` keep their authored value.

    :raises InputError: a value for no slider, a value that is not finite, or a slider of an unknown joint or channel
    """
    coefficients = rest_coefficients(len(joints))
    weights: dict[str, float] = {}
    joint_index = {joint: i for i, joint in enumerate(joints)}
    settings = dict(values or {})
    for slider in sliders:
        own = slider.default if slider.value is None else slider.value
        amount = _clamped(slider, settings.pop(slider.name, own)) - slider.default
        for joint, channel, gain in slider.channels:
            if joint not in joint_index or channel not in CHANNELS:
                raise InputError(f"slider {slider.name}", f"no joint '{joint}' with a channel '{channel}'")
            coefficients[joint_index[joint], CHANNELS.index(channel)] += gain * amount
        for shape, gain in slider.shapes:
            weights[shape] = weights.get(shape, 0.0) + gain * amount
    if settings:
        raise InputError("sliders", f"no slider '{next(iter(settings))}'")
    return coefficients, weights


def _clamped(slider: Slider, value: float) -> float:
    if not np.isfinite(value):
        raise InputError(f"slider {slider.name}", f"value {value}, expected a finite number")
    return min(max(value, slider.minimum), slider.maximum)
