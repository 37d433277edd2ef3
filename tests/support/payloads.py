"""Payloads of bone coefficients."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from faces import tiny_face
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from facepipe.payload import PayloadContent, Precision, encode

REST = np.array([0.0] * 6 + [1.0] * 3)


@st.composite
def contents(draw: st.DrawFn, precision: Precision) -> PayloadContent:
    """Numbers that the precision holds, some joints at rest, with and without frames and times."""
    width, most = (32, 2.0**100) if precision == "float32" else (16, 60000.0)
    count, frames = draw(st.integers(1, 20)), draw(st.none() | st.integers(1, 4))
    numbers = st.floats(-most, most, width=width, allow_nan=False)
    values = draw(arrays.arrays(np.float64, (frames or 1, count, 9), elements=numbers, fill=st.just(0.0)))
    values[:, draw(arrays.arrays(bool, count))] = REST
    times = None
    if frames and draw(st.booleans()):
        times = np.cumsum(draw(arrays.arrays(np.float64, frames, elements=st.integers(1, 9)))) / 8
    return PayloadContent(
        joints=tuple(f"joint{i}" for i in range(count)),
        coefficients=values if frames else values[0],
        times=times,
        meters_per_unit=draw(st.sampled_from([1.0, 0.01, 0.1, 0.0254])),
        precision=precision,
    )


def tiny_payload(path: Path, frames: int | None = None, scale: float = 1.0, **more: Any) -> PayloadContent:
    """Of tiny_face(): the jaw turned, further in each frame."""
    values = np.tile(REST, (frames or 1, 3, 1))
    values[:, 1, 3] = np.arange(1, len(values) + 1) / 8
    values[:, 1, 7] = scale
    one = PayloadContent(
        joints=tiny_face().skeleton.joints,
        coefficients=values if frames else values[0],
        meters_per_unit=more.pop("meters_per_unit", 0.01),
        **more,
    )
    path.write_bytes(encode(one).data)
    return one
