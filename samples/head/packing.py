"""Arrays into small files: numbers in uniform steps as differences, split into bytes that deflate well."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

STEP = 0.001  # cm: of identity modes and shapes


def packed(offsets: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """(2, r, 3, n) low and high bytes of offsets (r, n, 3) in cm; `facepipe.heads.asset.unpacked` is the way back."""
    steps = np.rint(np.asarray(offsets, np.float64).transpose(0, 2, 1) / STEP)
    if np.abs(steps).max() > np.iinfo(np.int16).max // 2:
        raise ValueError("offsets beyond 16 cm, expected smaller ones")
    change = np.diff(steps.astype(np.int16), axis=2, prepend=np.int16(0))
    folded = ((change << 1) ^ (change >> 15)).view(np.uint16)  # small numbers of either sign become small ones
    return np.stack([folded & 0xFF, folded >> 8]).astype(np.uint8)


def write_arrays(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """An .npz of the same bytes for the same arrays."""
    with zipfile.ZipFile(path, "w") as archive:
        for name in sorted(arrays):
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asarray(arrays[name]), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy")
            archive.writestr(entry, content.getvalue(), zipfile.ZIP_DEFLATED, compresslevel=9)
