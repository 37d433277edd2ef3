"""A fully connected network from one deformation to another, trained under noise that is added and taken off again.

Source: neural-face-rig, S103 and S403-S404: white Gaussian noise of a strength on what is reconstructed, removed step
by step backwards; the network learns from what is left of it. The document names neither strengths nor what removes the
noise. Here strengths fall to nothing over the training, and noise is removed by the mean of what may have been there
(inputs are spread normally), from level to level as in Song, Meng, Ermon, "Denoising Diffusion Implicit Models" (2021).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from facepipe.learn.one_thread import one_thread

FloatArray = npt.NDArray[np.floating]

LEVELS = 8  # from the strength to nothing
RATE = 2e-3
CHECK_EVERY, PATIENCE = 50, 500  # steps
CHECKED = 0.15  # of the frames, the last ones: when to stop


def train_deformation_network(
    inputs: FloatArray, outputs: FloatArray, *, width: int, steps: int, noise: float, seed: int
) -> Callable[[FloatArray], FloatArray]:
    """(..., o) of (..., i), by two hidden layers; the steps that do best on the last frames.

    :param inputs: (f, i) of mean 0 and variance 1 over all that may come
    :param outputs: (f, o)
    :param noise: strength at first, in deviations of the inputs; 0: none
    """
    with one_thread():
        random = torch.Generator().manual_seed(seed)
        torch.manual_seed(seed)
        x, y = (torch.as_tensor(np.asarray(one), dtype=torch.float64) for one in (inputs, outputs))
        network = _layers(x.shape[1], width, y.shape[1])
        size = y.square().mean().sqrt().clamp_min(1e-12)
        kept = max(1, len(x) - max(1, round(CHECKED * len(x))))
        optimiser = torch.optim.Adam(network.parameters(), lr=RATE)
        best, best_step, weights = np.inf, 0, {}
        for step in range(steps):
            if step % CHECK_EVERY == 0:
                with torch.no_grad():
                    error = float((network(x[kept:]) - y[kept:] / size).square().mean())
                if error < best:
                    best, best_step = error, step
                    weights = {name: one.detach().clone() for name, one in network.state_dict().items()}
                elif step - best_step >= PATIENCE:
                    break
            told = network(denoised(x[:kept], noise * (1.0 - step / steps), random))
            loss = (told - y[:kept] / size).square().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        network.load_state_dict(weights)

    def evaluate(values: FloatArray) -> FloatArray:
        with torch.no_grad():
            return np.asarray((network(torch.as_tensor(np.asarray(values, np.float64))) * size).numpy())

    return evaluate


def denoised(inputs: Tensor, strength: float, random: torch.Generator) -> Tensor:
    """Inputs (f, i) with noise of a strength, less as much of it as can be told: nearer to where most inputs are."""
    if strength <= 0.0:
        return inputs
    found = inputs + strength * torch.randn(inputs.shape, generator=random, dtype=inputs.dtype)
    levels = [strength * (1.0 - level / LEVELS) for level in range(LEVELS + 1)]
    for now, then in itertools.pairwise(levels):
        mean = found / (1.0 + now**2)
        found = mean + (then / now) * (found - mean)
    return found


def _layers(inputs: int, width: int, outputs: int) -> nn.Sequential:
    last = nn.Linear(width, outputs)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    layers = [nn.Linear(inputs, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), last]
    return nn.Sequential(*layers).double()
