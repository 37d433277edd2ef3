"""Files of arrays whose sums are sound and whose places are not."""

from __future__ import annotations

import hashlib
import json
import struct
from pathlib import Path

import numpy as np
import pytest

from facepipe.core.errors import InputError
from facepipe.verbs.array_file import read_arrays

KIND = "facepipe test 1"
NO_SUM = "0" * 64
DATA = np.arange(6, dtype="<f4").tobytes()


def put(path: Path, places: dict[str, list[int]], shape: list[int], data: bytes = DATA) -> Path:
    """A file of float32 arrays of one shape at `places`, its sum over what it holds."""
    head = {name: {"data_offsets": place, "dtype": "F32", "shape": shape} for name, place in places.items()}
    text = json.dumps({"__metadata__": {"content": "{}", "format": KIND, "sha256": NO_SUM}, **head}).encode()
    whole = struct.pack("<Q", len(text)) + text + data
    path.write_bytes(whole.replace(NO_SUM.encode(), hashlib.sha256(whole).hexdigest().encode(), 1))
    return path


def test_arrays_one_after_another_are_read(tmp_path: Path) -> None:
    arrays = read_arrays(put(tmp_path / "a", {"x": [0, 12], "y": [12, 24]}, [3]), KIND).arrays
    assert [array.tolist() for array in arrays.values()] == [[0, 1, 2], [3, 4, 5]]


@pytest.mark.parametrize(
    ("places", "shape"),
    [
        ({"x": [0, 24], "y": [0, 24]}, [6]),  # twice the same bytes
        ({"x": [0, 16], "y": [8, 24]}, [4]),
        ({"x": [0, 8], "y": [16, 24]}, [2]),  # bytes of no array
        ({"x": [12, 24], "y": [0, 12]}, [3]),
        ({"x": [0, 12], "y": [12, 24]}, [2]),
        ({"x": [0, 24], "y": [24, 48]}, [6]),  # beyond the file
        ({"x": [0, 12]}, [3]),  # bytes after it
    ],
)
def test_arrays_that_overlap_or_leave_bytes_are_refused(
    tmp_path: Path, places: dict[str, list[int]], shape: list[int]
) -> None:
    path = put(tmp_path / "a", places, shape)
    with pytest.raises(
        InputError, match=r"bytes that don't fit its shape|ends after the file|bytes of arrays"
    ) as caught:
        read_arrays(path, KIND)
    assert str(caught.value).startswith(str(path))
