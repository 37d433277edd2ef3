"""The packed head of MakeHuman, whole and small."""

from __future__ import annotations

from functools import cache

from import_data import arrays, packed

PACKED = "makehuman/makehuman_head.npz"


@cache
def small_head() -> bytes:
    """The packed head without most of its targets: quick to damage and read."""
    data = dict(arrays(PACKED))
    end = int(data["target_offset"][3])
    data |= {"target_names": data["target_names"][:3], "target_offset": data["target_offset"][:4]}
    data |= {"target_vertex": data["target_vertex"][:end], "target_delta": data["target_delta"][:end]}
    return packed(data)
