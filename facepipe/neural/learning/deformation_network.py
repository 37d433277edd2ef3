"""A fully connected network from one deformation to another, trained under noise that is added and taken off again.

Source: neural-face-rig, S103 and S403-S404: white Gaussian noise of a strength on what is reconstructed, removed step
by step backwards; the network learns from what is left of it. The document names neither the strength nor what removes
the noise. Here the strength falls to nothing over the training, and noise is removed by the mean of what may have been
there (each input is spread normally, as far as its deviation), from level to level as in Song, Meng, Ermon, "Denoising
Diffusion Implicit Models" (2021).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from facepipe.core.arrays import FloatArray
from facepipe.rig.torch.one_thread import one_thread

LEVELS = 8  # from the strength to nothing
RATE = 2e-3
CHECK_EVERY, PATIENCE = 50, 500  # steps
CHECKED = 0.15  # of the frames, the last ones: when to stop


def train_deformation_network(
    inputs: FloatArray, outputs: FloatArray, deviations: FloatArray, *, width: int, steps: int, noise: float, seed: int
) -> Callable[[FloatArray], FloatArray]:
    """(..., o) of (..., i), by two hidden layers; the steps that do best on the last frames.

    Inputs go in by one scale for all: what moves little counts little, however far it stands out of the few frames.

    :param inputs: (f, i) of mean 0 over all that may come
    :param outputs: (f, o)
    :param deviations: (i,) of the inputs over all that may come, none of them 0
    :param noise: strength at first, the same for all inputs, in the root mean square of their deviations; 0: none
    """
    with one_thread():
        random = torch.Generator().manual_seed(seed)
        torch.manual_seed(seed)
        scale = float(np.max(deviations))
        x, y, spread = (
            torch.as_tensor(np.asarray(one), dtype=torch.float64)
            for one in (inputs / scale, outputs, deviations / scale)
        )
        first = noise * float(spread.square().mean().sqrt())
        last = nn.Linear(width, y.shape[1])
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        layers = [nn.Linear(x.shape[1], width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), last]
        network = nn.Sequential(*layers).double()
        size = y.square().mean().sqrt().clamp_min(1e-12)
        # The last frames are checked, not some of all: neighbours in time are nearly the same.
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
            predicted = network(denoised(x[:kept], spread, first * (1.0 - step / steps), random))
            loss = (predicted - y[:kept] / size).square().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        network.load_state_dict(weights)

    def evaluate(values: FloatArray) -> FloatArray:
        with torch.no_grad():
            return np.asarray((network(torch.as_tensor(np.asarray(values, np.float64) / scale)) * size).numpy())

    return evaluate


def denoised(inputs: Tensor, deviations: Tensor, strength: float, random: torch.Generator) -> Tensor:
    """Inputs (f, i) with noise of a strength, less as much of it as can be known: nearer to where most inputs are.

    :param deviations: (i,) of the inputs, about 0
    """
    if strength <= 0.0:
        return inputs
    noisy = inputs + strength * torch.randn(inputs.shape, generator=random, dtype=inputs.dtype)
    levels = [strength * (1.0 - level / LEVELS) for level in range(LEVELS + 1)]
    for now, then in itertools.pairwise(levels):
        mean = noisy * deviations**2 / (deviations**2 + now**2)
        noisy = mean + (then / now) * (noisy - mean)
    return noisy
