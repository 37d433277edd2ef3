"""Median seconds of calls in this process."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

WARM_UP = 3


def measured(call: Callable[[], object], runs: int) -> dict[str, float]:
    """Median wall and processor seconds of a call, after `WARM_UP` that are not counted."""
    wall, processor = [], []
    for number in range(WARM_UP + runs):
        began = time.perf_counter(), time.process_time()
        call()
        if number >= WARM_UP:
            wall.append(time.perf_counter() - began[0])
            processor.append(time.process_time() - began[1])
    return {"wall_s": statistics.median(wall), "processor_s": statistics.median(processor), "best_wall_s": min(wall)}
