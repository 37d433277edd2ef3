"""Dense algebra on one thread: the same sums in the same order, so the same bytes, however many threads BLAS has.

On matrices of some hundred rows, more of them only cost.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """BLAS runs on one thread inside the block, in all threads of the process, and as before after it."""
    with _controller().limit(limits=1, user_api="blas"):
        yield


@functools.cache
def _controller() -> Any:
    import scipy.linalg  # noqa: F401  (the controller knows the libraries that are loaded when it is made)
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
