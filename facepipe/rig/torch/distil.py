"""Sliders without curves, and a small network for what curves and a larger network do: learnt from samples of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from facepipe.core.arrays import FloatArray
from facepipe.parts import Slider, SliderNetwork
from facepipe.rig import CHANNELS
from facepipe.rig.sliders import channel_entries, shape_entries, with_entries
from facepipe.rig.torch.network_fit import Samples, Trained, train
from facepipe.rig.torch.sliders import DifferentiableSliders

SAMPLES, CHECKED = 8192, 2048
LEAST_MM = 1e-6  # straight entries that move no point further over their slider's range are left out


@dataclass(frozen=True, kw_only=True)
class Driven:
    """Something that sliders add to."""

    channel: tuple[str, str] | None  # (joint path, channel)
    shape: str | None
    mm: float  # what a unit of it moves the face, for its share in the error


def bent_sliders(sliders: Sequence[Slider], network: SliderNetwork | None) -> tuple[Slider, ...]:
    """The sliders whose effect is no straight line: with curves, or in the network."""
    names = set() if network is None else set(network.sliders)
    return tuple(
        slider
        for slider in sliders
        if slider.minimum < slider.maximum
        and (slider.name in names or any((*slider.channel_curves, *slider.shape_curves)))
    )


def distil(
    sliders: Sequence[Slider],
    network: SliderNetwork | None,
    joints: Sequence[str],
    shapes: Sequence[str],
    driven: Sequence[Driven],
    *,
    width: int,
    activation: Literal["tanh", "relu"],
    seed: int,
    steps: int,
) -> tuple[tuple[Slider, ...], SliderNetwork, int]:
    """Sliders and a network that do nearly what others do, and the steps of training.

    Straight entries stay exactly as they are.

    :param driven: everything that curves and network of `bent_sliders`, of which there are some, add to
    :raises InputError: sliders or a network of joints, channels or shapes that are not there
    """
    bent = bent_sliders(sliders, network)
    taken = () if network is None else network.sliders
    fixed = tuple(slider for slider in sliders if slider.name in taken and slider.minimum == slider.maximum)
    teacher = _Teacher(bent, fixed, network, joints, shapes, driven)
    random = np.random.default_rng(seed)
    trained = train(
        teacher.samples(SAMPLES, random),
        teacher.samples(CHECKED, random),
        width=width,
        activation=activation,
        seed=seed,
        steps=steps,
        patience=steps // 4,
    )
    # Learnt in millimetres, so that radians, lengths and weights count by what they move; / scales undoes it.
    scales = np.array([one.mm for one in driven])
    straight, offset = _straight(bent, trained, driven)
    by_name = {one.name: one for one in straight}
    learnt = SliderNetwork(
        sliders=tuple(one.name for one in bent),
        channels=tuple(one.channel for one in driven if one.channel is not None),
        shapes=tuple(one.shape for one in driven if one.shape is not None),
        weights=(_over_values(bent, trained), trained.last / scales[:, None]),
        biases=(_bias_over_values(bent, trained), trained.last_bias / scales + offset),
        activation=activation,
    )
    return tuple(by_name.get(slider.name, slider) for slider in sliders), learnt, trained.steps


class _Teacher:
    """Samples of what curves and network add, in millimetres."""

    def __init__(
        self,
        bent: Sequence[Slider],
        fixed: Sequence[Slider],
        network: SliderNetwork | None,
        joints: Sequence[str],
        shapes: Sequence[str],
        driven: Sequence[Driven],
    ) -> None:
        """:param fixed: sliders of a single value that the network takes"""
        # Entries with a curve alone: straight ones stay in the sliders, where they are exact.
        curved = [
            with_entries(
                one,
                [entry for entry in channel_entries(one) if entry[1] is not None],
                [entry for entry in shape_entries(one) if entry[1] is not None],
            )
            for one in bent
        ]
        still = [with_entries(one, [], []) for one in fixed]
        self._fixed = np.array([one.minimum for one in fixed])
        self._sliders = DifferentiableSliders([*curved, *still], joints, shapes, torch.float64, "cpu", network)
        self._columns = [_column(one, joints, shapes) for one in driven]
        self._scales = np.array([one.mm for one in driven])
        self._rest = np.concatenate([np.tile([0.0] * 6 + [1.0] * 3, len(joints)), np.zeros(len(shapes))])
        self._lower, self._reach = _ranges(bent)
        self._default = 2 * (np.array([one.default for one in bent]) - self._lower) / self._reach - 1

    def samples(self, count: int, random: np.random.Generator) -> Samples:
        """Half of them vectors all over the ranges, a quarter sweeps of one slider, a quarter of two."""
        inputs = random.uniform(-1, 1, (count, len(self._reach)))
        inputs[random.random(inputs.shape) < 0.05] = 1.0  # ends are visited often
        inputs[random.random(inputs.shape) < 0.05] = -1.0
        for start, moved in ((count // 2, 1), (3 * count // 4, 2)):
            rows = np.arange(start, start + count // 4)
            kept = np.zeros((len(rows), len(self._reach)), dtype=bool)
            for _ in range(moved):
                kept[np.arange(len(rows)), random.integers(len(self._reach), size=len(rows))] = True
            inputs[rows] = np.where(kept, inputs[rows], self._default)
        values = self._lower + (inputs + 1) / 2 * self._reach
        whole_values = np.concatenate([values, np.tile(self._fixed, (count, 1))], axis=1)
        coefficients, weights = self._sliders(torch.as_tensor(whole_values))
        whole = torch.cat([coefficients.flatten(-2), weights], dim=-1).numpy() - self._rest
        return Samples(inputs=inputs, outputs=whole[:, self._columns] * self._scales)


def _column(one: Driven, joints: Sequence[str], shapes: Sequence[str]) -> int:
    if one.channel is None:
        return 9 * len(joints) + list(shapes).index(str(one.shape))
    joint, channel = one.channel
    return 9 * list(joints).index(joint) + CHANNELS.index(channel)


def _ranges(sliders: Sequence[Slider]) -> tuple[FloatArray, FloatArray]:
    """(i,) minima and lengths."""
    lower = np.array([slider.minimum for slider in sliders])
    return lower, np.array([slider.maximum for slider in sliders]) - lower


def _over_values(bent: Sequence[Slider], trained: Trained) -> FloatArray:
    """(h, i) hidden weights for slider values instead of -1..1."""
    return np.asarray(trained.hidden * (2 / _ranges(bent)[1]))


def _bias_over_values(bent: Sequence[Slider], trained: Trained) -> FloatArray:
    lower, reach = _ranges(bent)
    return np.asarray(trained.hidden_bias - trained.hidden @ (1 + 2 * lower / reach))


def _straight(
    bent: Sequence[Slider], trained: Trained, driven: Sequence[Driven]
) -> tuple[tuple[Slider, ...], FloatArray]:
    """The sliders with the linear map in place of their curves, and (o,) what it adds at their defaults."""
    lower, reach = _ranges(bent)
    scales = np.array([one.mm for one in driven])
    gains = 2 / reach[:, None] * trained.linear / scales
    gains[np.abs(gains * reach[:, None] * scales) < LEAST_MM] = 0.0
    default = np.array([one.default for one in bent])
    offset = (gains * (default - lower - reach / 2)[:, None]).sum(axis=0)
    return tuple(_with_gains(one, driven, row) for one, row in zip(bent, gains, strict=True)), offset


def _with_gains(slider: Slider, driven: Sequence[Driven], gains: FloatArray) -> Slider:
    """The slider with its straight entries and the further `gains`, each channel and shape once."""
    channels = [(joint, channel, gain) for (joint, channel, gain), curve in channel_entries(slider) if curve is None]
    shapes = [(shape, gain) for (shape, gain), curve in shape_entries(slider) if curve is None]
    for target, gain in zip(driven, gains.tolist(), strict=True):
        if gain and target.channel is not None:
            channels.append((*target.channel, gain))
        elif gain and target.shape is not None:
            shapes.append((target.shape, gain))
    by_channel: dict[tuple[str, str], float] = {}
    for joint, channel, gain in channels:
        by_channel[joint, channel] = by_channel.get((joint, channel), 0.0) + gain
    by_shape: dict[str, float] = {}
    for shape, gain in shapes:
        by_shape[shape] = by_shape.get(shape, 0.0) + gain
    return replace(
        slider,
        channels=tuple((*key, gain) for key, gain in by_channel.items()),
        shapes=tuple(by_shape.items()),
        channel_curves=(),
        shape_curves=(),
    )
