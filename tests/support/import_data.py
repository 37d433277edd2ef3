"""What the importer tests share: the data beside the repository, and damage done to files."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st
from places import SHARED

from facepipe.core.errors import FacepipeError


def shared(path: str) -> Path:
    """A file of ../shared/data; skips the test where it is absent."""
    file = SHARED / path
    if not file.is_file():
        pytest.skip(f"needs ../shared/data/{path}, which is not there")
    return file


@cache
def arrays(path: str) -> dict[str, Any]:
    """The arrays of an .npz of ../shared/data; skips the test where it is absent."""
    with np.load(shared(path)) as file:
        return {name: file[name] for name in file.files}


def refused(read: Callable[[], object], file: Path) -> FacepipeError | None:
    """The error of `read`, None where it reads; errors of other kinds, and ones that don't name `file`, pass."""
    try:
        read()
    except FacepipeError as error:
        if str(file) not in str(error) or "\n" in str(error):
            raise AssertionError(f"no one-line trail from {file}: {error}") from error
        return error
    return None


def packed(arrays: dict[str, Any]) -> bytes:
    """The arrays as an .npz."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


@st.composite
def damaged(draw: st.DrawFn, data: bytes) -> bytes:
    """`data` cut short, or with some bytes changed, or both."""
    result = bytearray(data)
    for _ in range(draw(st.integers(0, 4))):
        result[draw(st.integers(0, len(data) - 1))] = draw(st.integers(0, 255))
    return bytes(result[: draw(st.integers(0, len(data)))] if draw(st.booleans()) else result)


@st.composite
def wrong_array(draw: st.DrawFn, array: np.ndarray[Any, Any]) -> Any:
    """Something else in place of `array`: another type, size or content, or a pickle."""
    kind = draw(st.sampled_from(["type", "shorter", "axis", "empty", "value", "object", "big", "wide"]))
    if kind == "type":
        return array.astype("U8") if array.dtype.kind != "U" else np.zeros(array.shape)
    if kind == "value" and array.dtype.kind in "fiu":
        changed = array.copy()
        values = (
            [np.nan, np.inf, 1e30]
            if array.dtype.kind == "f"
            else [-1, np.iinfo(array.dtype).min, np.iinfo(array.dtype).max]
        )
        changed.flat[draw(st.integers(0, array.size - 1))] = draw(st.sampled_from(values))
        return changed
    if kind == "big":
        return array.astype(array.dtype.newbyteorder(">"))[::-1]
    if kind == "wide" and array.dtype.kind in "iu":
        return np.full(array.shape, draw(st.sampled_from([2**31, 2**62, -(2**62)])), dtype=np.int64)
    if kind == "object":
        return np.array([{"a": 1}], dtype=object)
    return {"shorter": array[:-1], "axis": array[None]}.get(kind, array[:0])
