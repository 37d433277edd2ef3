"""How torch runs: on one thread where results must not depend on their number, on which device, in which floats."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from facepipe.core import threads


def best_device() -> str:
    """``cuda`` where torch has a GPU, otherwise ``cpu``."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def short_floats(enabled: bool = True) -> torch.autocast:
    """Products are in bfloat16 inside the block, where the processor has them: elsewhere they take far longer."""
    has = torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
    return torch.autocast("cpu", dtype=torch.bfloat16, enabled=enabled and has)


@contextmanager
def one_thread() -> Iterator[None]:
    """Inside the block; as before after it.

    Sums come in the same order whatever the machine's threads, and steps as small as ours gain little from more, but
    lose much where other programs use the cores.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threads.one_thread():
            yield
    finally:
        torch.set_num_threads(before)
