"""The decoder of EXT_meshopt_compression: meshoptimizer's own is the judge."""

from __future__ import annotations

import base64
import functools
from typing import Any

import numpy as np
import pytest
from facepipe_gltf.read.meshopt import decode
from hypothesis import given, settings
from hypothesis import strategies as st
from node import meshopt_encode

KINDS = [
    "noise",
    "zeros",
    "smooth",
    "one",
    "wide",
    "triangles",
    "triangle soup",
    "long triangles",
    "indices",
    "OCTAHEDRAL 4",
    "OCTAHEDRAL 8",
    "QUATERNION 8",
    "EXPONENTIAL 16",
]


def grid_triangles(side: int) -> np.ndarray:
    """Triangles of a grid of side x side points, as they come."""
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    quads = np.stack([corner, corner + 1, corner + side, corner + side, corner + 1, corner + side + 1], axis=1)
    return quads.ravel()


def request(name: str) -> dict[str, Any]:
    """What is to be compressed."""
    rng = np.random.default_rng(KINDS.index(name))
    plain: dict[str, tuple[np.ndarray, int, str]] = {
        "noise": (rng.integers(0, 256, (700, 12), np.uint8), 12, "ATTRIBUTES"),
        "zeros": (np.zeros((5000, 8), np.uint8), 8, "ATTRIBUTES"),
        "smooth": (np.cumsum(rng.integers(-3, 4, (1000, 4)), axis=0).astype("<i2"), 8, "ATTRIBUTES"),
        "one": (rng.integers(0, 256, (1, 4), np.uint8), 4, "ATTRIBUTES"),
        "wide": (rng.integers(0, 5, (300, 256), np.uint8), 256, "ATTRIBUTES"),
        "triangles": (grid_triangles(40).astype("<u2"), 2, "TRIANGLES"),
        "triangle soup": (rng.integers(0, 65536, 900).astype("<u2"), 2, "TRIANGLES"),
        "long triangles": (rng.permutation(grid_triangles(30).reshape(-1, 3)).astype("<u4") * 999, 4, "TRIANGLES"),
        "indices": (rng.integers(0, 1 << 20, 500).astype("<u4"), 4, "INDICES"),
    }
    if name in plain:
        values, size, mode = plain[name]
        return {"data": values, "count": values.nbytes // size, "size": size, "mode": mode}
    kind, _, size_text = name.partition(" ")
    floats = rng.normal(size=(333, 4)).astype("<f4")
    if kind != "EXPONENTIAL":
        width = 3 if kind == "OCTAHEDRAL" else 4
        floats[:, :width] /= np.linalg.norm(floats[:, :width], axis=1, keepdims=True)
        floats[:, 3] = np.clip(floats[:, 3], -1, 1)
    return {"data": floats, "count": 333, "size": int(size_text), "mode": "ATTRIBUTES", "filter": kind}


@functools.cache
def answers() -> dict[str, tuple[bytes, bytes, dict[str, Any]]]:
    """Compressed, decoded by meshoptimizer, and what was asked, of every kind."""
    asked = {name: request(name) for name in KINDS}
    words = [one | {"data": base64.b64encode(one["data"].tobytes()).decode()} for one in asked.values()]
    found = [[base64.b64decode(one[key]) for key in ("packed", "decoded")] for one in meshopt_encode(words)]
    return {name: (*pair, asked[name]) for name, pair in zip(KINDS, found, strict=True)}


@pytest.mark.parametrize("name", KINDS)
def test_it_decodes_what_meshoptimizer_decodes(name: str) -> None:
    packed, expected, asked = answers()[name]
    found = decode(packed, asked["count"], asked["size"], asked["mode"], asked.get("filter", "NONE"))
    assert len(found) == asked["count"] * asked["size"]
    if asked.get("filter") in ("OCTAHEDRAL", "QUATERNION"):  # in float32 there: some halves round the other way
        kind = "<i1" if asked["size"] == 4 else "<i2"
        steps = np.frombuffer(found, kind).astype(int) - np.frombuffer(expected, kind)
        assert np.abs(steps).max() <= 1
        assert (steps != 0).mean() < 0.01
    else:
        assert found == expected


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damaged_data_is_refused_or_decoded_to_its_size(data: st.DataObject) -> None:
    packed, _, asked = answers()[data.draw(st.sampled_from(KINDS))]
    broken = bytearray(packed)
    for _ in range(data.draw(st.integers(0, 4))):
        broken[data.draw(st.integers(0, len(broken) - 1))] = data.draw(st.integers(0, 255))
    del broken[data.draw(st.integers(0, len(broken))) :]
    count = data.draw(st.sampled_from([asked["count"], 3, 0, 1 << 40]))
    size = data.draw(st.sampled_from([asked["size"], 0, 3, 1 << 40]))
    try:
        found = decode(bytes(broken), count, size, asked["mode"], asked.get("filter", "NONE"))
    except ValueError:
        return
    assert len(found) == count * size


def test_other_modes_are_refused() -> None:
    packed, _, asked = answers()["noise"]
    for mode, filtered in (("POINTS", "NONE"), ("ATTRIBUTES", "LINEAR")):
        with pytest.raises(ValueError, match="expected ones of EXT_meshopt_compression"):
            decode(packed, asked["count"], asked["size"], mode, filtered)
