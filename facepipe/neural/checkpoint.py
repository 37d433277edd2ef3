"""Where a training stands, in a file: killed, it goes on from there."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from facepipe.core.arrays import AnyArray
from facepipe.core.errors import InputError
from facepipe.neural.motion import Motion
from facepipe.verbs.array_file import Content, read_arrays, write_arrays

KIND = "facepipe neural rig training 2"
_NAMES = ("numbers", "random")


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """One part of a training's file: of these frames, with these options. Parts don't touch each other."""

    path: Path
    part: str
    key: str  # digest of frames and options

    @classmethod
    def for_training(cls, path: Path, part: Literal["rig", "encoder"], motion: Motion, options: Any) -> Checkpoint:
        """:param options: a dataclass of plain values"""
        digest = hashlib.sha256(json.dumps(dataclasses.asdict(options), sort_keys=True).encode())
        for array in (motion.values, motion.points, motion.blocks, motion.coefficients):
            digest.update(b"" if array is None else np.ascontiguousarray(array).data)
        return cls(path=path, part=part, key=digest.hexdigest())

    def state(self) -> Mapping[str, AnyArray] | None:
        """What was kept last; None where nothing was yet.

        :raises InputError: a damaged file, or one of other frames or options
        """
        file = self._file()
        key = _keys(file).get(self.part)
        if key is None:
            return None
        if key != self.key:
            what = f"a training of other frames or options ({self.part})"
            raise InputError(self.path, f"{what}, expected these (or another file)")
        prefix = f"{self.part}."
        arrays = {name.removeprefix(prefix): one for name, one in file.arrays.items() if name.startswith(prefix)}
        lacking = [name for name in _NAMES if name not in arrays]
        if lacking:
            raise InputError(self.path, f"lacks {prefix}{lacking[0]}, expected a training")
        return arrays

    def keep(self, state: Mapping[str, AnyArray]) -> None:
        """Write, whole or not at all; the other parts stay as they are."""
        file, prefix = self._file(), f"{self.part}."
        others = {name: one for name, one in file.arrays.items() if not name.startswith(prefix)}
        arrays = {f"{prefix}{name}": one for name, one in state.items()}
        write_arrays(self.path, KIND, {"keys": {**_keys(file), self.part: self.key}}, others | arrays)

    def _file(self) -> Content:
        return read_arrays(self.path, KIND) if self.path.exists() else Content({}, {})


def _keys(file: Content) -> dict[str, str]:
    keys = file.content.get("keys")
    return keys if isinstance(keys, dict) else {}
