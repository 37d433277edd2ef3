"""How networks of landmarks are trained."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import TypeVar

import torch
from torch import Tensor, nn

_RATE, _DECAY, _STEEPEST = 3e-3, 1e-2, 20.0

Batch = TypeVar("Batch")
Network = TypeVar("Network", bound=nn.Module)


def descend(
    network: Network,
    loss: Callable[[Batch], Tensor],
    batches: Iterator[Batch],
    steps: int,
    keep: Callable[[Network, int], None],
) -> Network:
    """The network after so many steps of Adam, its rate rising and falling once; `keep` gets it ten times."""
    optimizer = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=_DECAY, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _RATE, total_steps=steps, pct_start=0.1)
    start = time.monotonic()
    for step, batch in zip(range(steps), batches, strict=False):
        found = loss(batch)
        optimizer.zero_grad()
        found.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), _STEEPEST)
        optimizer.step()
        schedule.step()
        if step % 50 == 49:
            print(f"{step + 1} {found.item():.3f} {time.monotonic() - start:.0f} s", flush=True)
        if (step + 1) % max(1, steps // 10) == 0:
            keep(network, step + 1)
    return network.eval()
