"""Sliders without curves, and a small network for what curves and a larger network do: learnt from samples of them."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import AnyArray, FloatArray
from facepipe.parts import Slider, SliderNetwork
from facepipe.rig import CHANNELS
from facepipe.rig.sliders import channel_entries, shape_entries, with_entries
from facepipe.rig.torch.descent import Descent
from facepipe.rig.torch.one_thread import one_thread
from facepipe.rig.torch.sliders import ACTIVATIONS, DifferentiableSliders

BATCH = 256
FIRST_RATE, LAST_RATE = 1e-2, 1e-5

RIDGE = 1e-9  # of the mean square of the features
SAMPLES, CHECKED = 8192, 2048
LEAST_MM = 1e-6  # straight entries that move no point further over their slider's range are left out


class Network:
    """(n, i) -> (n, o), one hidden layer; what it gives at first is 0."""

    def __init__(self, inputs: int, outputs: int, width: int, activation: str, seed: int, device: str) -> None:
        random = torch.Generator().manual_seed(seed)
        hidden = torch.randn(width, inputs, generator=random, dtype=torch.float64) / math.sqrt(inputs)
        # every other unit starts at one input: most of what sliders do is a function of one of them
        alone = torch.arange(0, width, 2)
        hidden[alone] = 0.0
        hidden[alone, torch.arange(len(alone)) % inputs] = 2.0
        bias = torch.rand(width, generator=random, dtype=torch.float64) * 2 - 1
        last = torch.zeros(outputs, width, dtype=torch.float64)
        last_bias = torch.zeros(outputs, dtype=torch.float64)
        self.parameters = [one.to(device).requires_grad_() for one in (hidden, bias, last, last_bias)]
        self._activation = ACTIVATIONS[activation]

    def units(self, x: Tensor) -> Tensor:
        """(n, h) values of the hidden layer."""
        hidden, bias, _, _ = self.parameters
        return self._activation(x @ hidden.T + bias)

    def __call__(self, x: Tensor) -> Tensor:
        """(n, o)."""
        _, _, last, last_bias = self.parameters
        return self.units(x) @ last.T + last_bias

    def shrink(self, amount: float) -> None:
        """Draw the weights of the hidden layer to 0."""
        if amount > 0.0:
            with torch.no_grad():
                self.parameters[0].copy_(torch.nn.functional.softshrink(self.parameters[0], amount))


class NetworkDescent(Descent):
    """Adam on a network; errors count by their squares, in shares of the outputs' own."""

    check_every, keep_every = 100, 500

    def __init__(
        self,
        network: Network,
        samples: tuple[Tensor, Tensor],
        checked: tuple[Tensor, Tensor],
        *,
        steps: int,
        patience: int,
        seed: int,
        sparsity: float,
    ) -> None:
        """:param checked: other samples; the network that is best there is kept
        :param sparsity: of the rate of Adam, drawn off the hidden layer's weights (proximal L1)
        """
        self._network, self._samples, self._checked, self._sparsity = network, samples, checked, sparsity
        self._size = samples[1].square().mean().sqrt().clamp_min(1e-30)
        self._curve: list[list[float]] = []
        optimiser = torch.optim.Adam(network.parameters, lr=FIRST_RATE)
        random = torch.Generator().manual_seed(seed)
        super().__init__(network.parameters, optimiser, random, steps=steps, patience=patience)

    @property
    def curve(self) -> AnyArray:
        """(checks, 3): step, then what is left of the learned and of the checked samples, RMS in shares of all."""
        return np.array(self._curve, dtype=np.float64).reshape(-1, 3)

    def rate(self, step: int) -> float:
        """Half a cosine from the first to the last."""
        turned = math.cos(math.pi * (step - 1) / self._most)
        return LAST_RATE + 0.5 * (FIRST_RATE - LAST_RATE) * (1.0 + turned)

    def loss(self) -> Tensor:
        """Of the next batch."""
        x, y = self._samples
        rows = torch.randint(len(x), (BATCH,), generator=self._random).to(x.device)
        return ((self._network(x[rows]) - y[rows]) / self._size).square().mean()

    def error(self) -> float:
        """Of the samples that are checked."""
        x, y = self._checked
        with torch.no_grad():
            return float(((self._network(x) - y) / self._size).square().mean())

    def state(self) -> dict[str, AnyArray]:
        """With the curve."""
        return super().state() | {"curve": self.curve}

    def _stale(self) -> bool:
        return self.steps - self._best_step >= self._patience and bool(self._curve)

    def _step(self) -> None:
        super()._step()
        self._network.shrink(self._sparsity * self.rate(self.steps))

    def _check(self) -> float:
        error = super()._check()
        since = self.steps - (int(self._curve[-1][0]) if self._curve else 0)
        self._curve.append([float(self.steps), math.sqrt(self._summed / since), math.sqrt(error)])
        self._summed = 0.0
        return error

    def _take_over(self, state: Mapping[str, AnyArray]) -> None:
        super()._take_over(state)
        self._curve = np.asarray(state["curve"]).reshape(-1, 3).tolist()


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Rows of inputs, -1..1, and of what they give."""

    inputs: FloatArray  # (n, i)
    outputs: FloatArray  # (n, o)


@dataclass(frozen=True, kw_only=True)
class Trained:
    """``inputs @ linear + activation(inputs @ hidden.T + hidden_bias) @ last.T + last_bias``."""

    linear: FloatArray  # (i, o)
    hidden: FloatArray  # (h, i)
    hidden_bias: FloatArray  # (h,)
    last: FloatArray  # (o, h)
    last_bias: FloatArray  # (o,)
    steps: int
    curve: FloatArray  # (checks, 3): step, what is left of the learned and of the checked samples, RMS in shares of all


def train(
    samples: Samples,
    checked: Samples,
    *,
    width: int,
    activation: Literal["tanh", "relu", "silu"],
    seed: int,
    steps: int,
    patience: int,
    sparsity: float = 0.0,
    device: str = "cpu",
    done: Callable[[], object] = lambda: None,
    state: Mapping[str, AnyArray] | None = None,
    keep: Callable[[Mapping[str, AnyArray]], object] = lambda _: None,
) -> Trained:
    """A network of `width` hidden units for `samples`, of least squared error: linear parts by least squares.

    Adam on the hidden layer and the last, from a seed, on one thread: the same samples give the same network. After it
    the linear map and the last layer are solved for once more, since they are the least squares of given units.

    :param checked: other samples; training stops where their error has not fallen for `patience` steps, and the best is
        taken
    :param sparsity: how strongly weights of the hidden layer are drawn to 0, so that a unit takes few inputs and what
        few of them do together is not mistaken for the others' doing; of the rate of Adam (proximal L1)
    :param device: torch's, that the steps are taken on
    :param done: called once for each step
    :param state: what `keep` was given in a training that was ended: it goes on from there
    :param keep: called with the state now and then
    :raises InputError: a state of another training
    """
    with one_thread():
        linear, offset = _least_squares(_tensor(samples.inputs), _tensor(samples.outputs))
        parts = [(_tensor(one.inputs), _tensor(one.outputs)) for one in (samples, checked)]
        # The network starts at 0 and learns what the straight map leaves alone.
        left = [(x.to(device), (y - x @ linear - offset).to(device)) for x, y in parts]
        network = Network(samples.inputs.shape[1], left[0][1].shape[1], width, activation, seed, device)
        descent = NetworkDescent(
            network, left[0], left[1], steps=steps, patience=patience, seed=seed, sparsity=sparsity
        )
        if state is not None:
            descent.go_on(state)
        descent.run(done, keep)
        x, y = parts[0]
        hidden, hidden_bias, _, _ = (parameter.detach().cpu() for parameter in network.parameters)
        units = network.units(x.to(network.parameters[0].device)).detach().cpu()
        solved, last_bias = _least_squares(torch.cat([x, units], dim=1), y)
        return Trained(
            linear=solved[: x.shape[1]].numpy(),
            hidden=hidden.numpy(),
            hidden_bias=hidden_bias.numpy(),
            last=solved[x.shape[1] :].T.numpy(),
            last_bias=last_bias.numpy(),
            steps=descent.steps,
            curve=descent.curve,
        )


def _least_squares(features: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """(f, o) and (o,): the map and offset of least squared error."""
    whole = torch.cat([features, torch.ones_like(features[:, :1])], dim=1)
    normal = whole.T @ whole
    normal += RIDGE * normal.diagonal().mean() * torch.eye(len(normal), dtype=normal.dtype)
    solved = torch.linalg.solve(normal, whole.T @ targets)
    return solved[:-1], solved[-1]


def _tensor(values: FloatArray) -> Tensor:
    return torch.as_tensor(np.asarray(values, dtype=np.float64))


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
    lower, reach = _ranges(bent)
    gains = 2 / reach[:, None] * trained.linear / scales
    gains[np.abs(gains * reach[:, None] * scales) < LEAST_MM] = 0.0
    default = np.array([one.default for one in bent])
    offset = (gains * (default - lower - reach / 2)[:, None]).sum(axis=0)  # what the linear map adds at the defaults
    by_name = {one.name: _with_gains(one, driven, row) for one, row in zip(bent, gains, strict=True)}
    learnt = SliderNetwork(
        sliders=tuple(one.name for one in bent),
        channels=tuple(one.channel for one in driven if one.channel is not None),
        shapes=tuple(one.shape for one in driven if one.shape is not None),
        weights=(np.asarray(trained.hidden * (2 / reach)), trained.last / scales[:, None]),
        biases=(
            np.asarray(trained.hidden_bias - trained.hidden @ (1 + 2 * lower / reach)),
            trained.last_bias / scales + offset,
        ),
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
        self._columns = [
            9 * len(joints) + list(shapes).index(str(one.shape))
            if one.channel is None
            else 9 * list(joints).index(one.channel[0]) + CHANNELS.index(one.channel[1])
            for one in driven
        ]
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


def _ranges(sliders: Sequence[Slider]) -> tuple[FloatArray, FloatArray]:
    """(i,) minima and lengths."""
    lower = np.array([slider.minimum for slider in sliders])
    return lower, np.array([slider.maximum for slider in sliders]) - lower


def _with_gains(slider: Slider, driven: Sequence[Driven], gains: FloatArray) -> Slider:
    """The slider with its straight entries and the further `gains`, each channel and shape once."""
    # the slider's own gain and the learnt one of a channel are one number in the end
    by_channel: dict[tuple[str, str], float] = defaultdict(float)
    by_shape: dict[str, float] = defaultdict(float)
    for (joint, channel, gain), curve in channel_entries(slider):
        if curve is None:
            by_channel[joint, channel] += gain
    for (shape, gain), curve in shape_entries(slider):
        if curve is None:
            by_shape[shape] += gain
    for target, gain in zip(driven, gains.tolist(), strict=True):
        if gain and target.channel is not None:
            by_channel[target.channel] += gain
        elif gain and target.shape is not None:
            by_shape[target.shape] += gain
    return replace(
        slider,
        channels=tuple((*key, gain) for key, gain in by_channel.items()),
        shapes=tuple(by_shape.items()),
        channel_curves=(),
        shape_curves=(),
    )
