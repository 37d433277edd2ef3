"""Sessions of onnxruntime and times of calls, on one thread."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime


def start(path: Path) -> Any:
    """A session of onnxruntime on one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])


def median(call: Callable[[], object], runs: int, before: Callable[[], object] | None = None) -> float:
    """Median milliseconds of a call, after some that are not counted."""
    samples = []
    for number in range(runs + max(3, runs // 10)):
        if before:
            before()
        began = time.perf_counter()
        call()
        samples.append(1e3 * (time.perf_counter() - began))
        if number < runs // 10:
            samples.clear()
    return float(np.median(samples))
