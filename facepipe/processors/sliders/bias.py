"""The constant b of gamma = W^T alpha + b, carried by sliders."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

from facepipe.parts import Curve, Slider
from facepipe.processors.sliders.rules import Channels, Shapes, channel_targets, shape_targets, with_driven
from facepipe.rig.sliders import channel_entries, shape_entries

Target = TypeVar("Target")


class Bias(NamedTuple):
    """What is added to a target whatever the sliders say."""

    target: str  # pattern of "joint:channel", or of shapes
    is_channel: bool
    amount: float
    where: str


def with_bias(
    sliders: Sequence[Slider], bias: Sequence[Bias], joints: Sequence[str], shapes: Sequence[str], unit: float
) -> tuple[Slider, ...]:
    """Sliders that together stand for ``W^T alpha + b``: `sliders` are straight, their gains are W.

    A straight entry adds ``gain * (alpha - default)``, so what is carried is ``b + W^T default``: per target by the
    first slider that moves it (or the first of all), as a curve that is straight over its range.

    :param unit: what translations are multiplied by
    :raises InputError: unknown channels, or patterns that match no joint or shape
    """
    channels: list[Channels] = [
        {(joint, channel): (gain, curve) for (joint, channel, gain), curve in channel_entries(one)} for one in sliders
    ]
    driven: list[Shapes] = [{shape: (gain, curve) for (shape, gain), curve in shape_entries(one)} for one in sliders]
    for one in bias:
        if one.is_channel:
            for target in channel_targets(one.where, one.target, joints):
                _carry(sliders, channels, target, one.amount * (unit if target[1].startswith("t") else 1.0))
        else:
            for shape in shape_targets(one.where, one.target, shapes):
                _carry(sliders, driven, shape, one.amount)
    return tuple(with_driven(*each) for each in zip(sliders, channels, driven, strict=True))


def _carry(
    sliders: Sequence[Slider], driven: Sequence[dict[Target, tuple[float, Curve | None]]], target: Target, amount: float
) -> None:
    moving = [i for i, own in enumerate(driven) if own.get(target, (0.0, None))[0]]
    amount += sum(driven[i][target][0] * sliders[i].default for i in moving)
    if not amount:
        return
    first = moving[0] if moving else 0
    slider, (gain, _) = sliders[first], driven[first].get(target, (0.0, None))
    ends = (slider.minimum, slider.maximum)
    driven[first][target] = (1.0, tuple((end, gain * (end - slider.default) + amount) for end in ends))
