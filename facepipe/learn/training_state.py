"""All that a descent takes to go on after it was stopped, as named arrays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import AnyArray
from facepipe.core.errors import InputError

_MOMENTS = ("exp_avg", "exp_avg_sq")  # of Adam


def state_of(
    parameters: list[Tensor], kept: list[Tensor], optimiser: torch.optim.Optimizer, random: torch.Generator
) -> dict[str, AnyArray]:
    """Parameters, the best of them so far, Adam's moments and the draws to come.

    :param optimiser: Adam or AdamW, one step or more on its way
    """
    state: dict[str, AnyArray] = {"random": random.get_state().numpy().astype(np.int32)}
    for number, (one, best) in enumerate(zip(parameters, kept, strict=True)):
        state |= {f"now.{number}": one.detach().cpu().numpy().copy(), f"best.{number}": best.cpu().numpy()}
        own = optimiser.state[one]
        state |= {f"{name}.{number}": own[name].cpu().numpy().copy() for name in _MOMENTS}
    return state


@contextmanager
def restoring() -> Iterator[None]:
    """What a damaged state makes fail, in one line.

    :raises InputError: the state of another network
    """
    try:
        yield
    except (KeyError, RuntimeError, ValueError, TypeError, OverflowError):
        raise InputError("training state", "is damaged or of another network, expected that of this training") from None


def restore_state(
    state: Mapping[str, AnyArray],
    parameters: list[Tensor],
    optimiser: torch.optim.Optimizer,
    random: torch.Generator,
    steps: int,
) -> list[Tensor]:
    """Take over what `state_of` gave; the best parameters are returned.

    :param steps: that the optimiser had taken
    :raises KeyError, RuntimeError, ValueError: the state of another network
    """
    kept = []
    for number, parameter in enumerate(parameters):
        with torch.no_grad():
            parameter.copy_(torch.tensor(state[f"now.{number}"]).reshape(parameter.shape))
        kept.append(torch.tensor(state[f"best.{number}"]).to(parameter).reshape(parameter.shape))
        moments = {
            name: torch.tensor(state[f"{name}.{number}"]).to(parameter).reshape(parameter.shape) for name in _MOMENTS
        }
        optimiser.state[parameter] = {"step": torch.tensor(steps, dtype=torch.float32), **moments}
    random.set_state(torch.as_tensor(np.asarray(state["random"]).astype(np.uint8)))
    return kept
