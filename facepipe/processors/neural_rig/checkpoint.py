"""Where a training stands, in a file: killed, it goes on from there."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError
from facepipe.processors.database.array_file import read_arrays, write_arrays
from facepipe.processors.neural_rig.motion import Motion

Array = npt.NDArray[Any]

KIND = "facepipe neural rig training 1"
_NAMES = ("numbers", "curve", "random")


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """The file of one training: of these frames, with these options."""

    path: Path
    key: str  # digest of frames and options

    @classmethod
    def of(cls, path: Path, motion: Motion, options: Any) -> Checkpoint:
        """:param options: a dataclass of plain values"""
        found = hashlib.sha256(json.dumps(dataclasses.asdict(options), sort_keys=True).encode())
        for array in (motion.values, motion.points, motion.blocks, motion.coefficients):
            found.update(b"" if array is None else np.ascontiguousarray(array).data)
        return cls(path=path, key=found.hexdigest())

    def state(self) -> Mapping[str, Array] | None:
        """What was kept last; None where nothing was yet.

        :raises InputError: a damaged file, or one of other frames or options
        """
        if not self.path.exists():
            return None
        found = read_arrays(self.path, KIND)
        if found.content.get("key") != self.key:
            raise InputError(self.path, "a training of other frames or options, expected these (or another file)")
        lacking = [name for name in _NAMES if name not in found.arrays]
        if lacking:
            raise InputError(self.path, f"lacks {lacking[0]}, expected a training")
        return found.arrays

    def keep(self, state: Mapping[str, Array]) -> None:
        """Write, whole or not at all."""
        write_arrays(self.path, KIND, {"key": self.key}, state)

    def done(self) -> None:
        """The training has ended: the file goes."""
        self.path.unlink(missing_ok=True)
