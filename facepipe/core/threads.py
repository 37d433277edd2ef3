"""Threads that don't change results: dense algebra on one, and independent pieces of work on several.

Sums in the same order give the same bytes, however many threads BLAS has; on matrices of some hundred rows, more of
them only cost.
"""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

_A = TypeVar("_A")
_B = TypeVar("_B")

THREADS = "FACEPIPE_THREADS"  # variable: 1 for one thread a process
_MOST = 8  # threads; numpy holds Python's lock too often for more to help


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """BLAS runs on one thread inside the block, in all threads of the process, and as before after it."""
    with _controller().limit(limits=1, user_api="blas"):
        yield


def mapped(function: Callable[[_A], _B], items: Iterable[_A]) -> list[_B]:
    """What a function that spends its time in numpy makes of each item, in order; several at once."""
    if os.environ.get(THREADS) == "1":  # other processes have the other cores
        return list(map(function, items))
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(max(1, min(os.cpu_count() or 1, _MOST))) as pool:
        return list(pool.map(function, items))


@functools.cache
def _controller() -> Any:
    import scipy.linalg  # noqa: F401  (the controller knows the libraries that are loaded when it is made)
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
