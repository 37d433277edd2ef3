"""The work folder of a rebuild: each stage's result, kept until its inputs change, and an artist's corrections.

A result is ``NAME.fpstage`` (arrays, and JSON with the key of the inputs that it came from), written whole or not at
all, so that an interrupted rebuild goes on where it was. Beside it ``NAME.usdc`` shows the mesh. A corrected mesh of
the same topology, ``corrections/NAME.usdc`` (or .usda, .obj, .glb ...), takes its place in all that follows.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core import __version__
from facepipe.core.atomic import collect
from facepipe.core.errors import InputError
from facepipe.core.trust import check_writable
from facepipe.processors.database.array_file import read_arrays, write_arrays

Array = npt.NDArray[Any]

CORRECTIONS = "corrections"
KIND = "facepipe rebuild stage 1"
_SUFFIXES = (".usdc", ".usda", ".usd", ".usdz", ".obj", ".glb", ".gltf")


@dataclass(frozen=True, kw_only=True)
class StageResult:
    """What one stage found."""

    arrays: Mapping[str, Array]
    content: Mapping[str, Any]  # JSON: report, weights, place
    reused: bool  # it was there, of the same inputs


class WorkFolder:
    """:raises InputError: `path` can't be made, or is a file"""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            (path / CORRECTIONS).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(path, f"can't be made: {error.strerror or error}") from error

    def stage(
        self,
        name: str,
        inputs: Mapping[str, Any],
        compute: Callable[[], tuple[Mapping[str, Array], Mapping[str, Any]]],
        check: Callable[[Mapping[str, Array], Mapping[str, Any]], object] = lambda arrays, content: None,
    ) -> StageResult:
        """The result of a stage: the one that is there where it came from the same `inputs`, otherwise a new one.

        A damaged file is made anew, and so is one that holds something else.

        :param inputs: JSON: digests of files and arrays, options
        :param check: raises InputError where arrays and content are not what the stage keeps
        :raises FacepipeError: of `compute`; what was there stays then. Or links that lead outside the roots
        """
        key = stage_key(inputs)
        path = self.place(f"{name}.fpstage")
        collect(path.parent)  # nothing may be written there any more
        known = self._read(path, key, check)
        if known is not None:
            return known
        arrays, content = compute()
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(path, KIND, {"key": key, "content": dict(content)}, arrays)
        fresh = self._read(path, key, check)
        if fresh is None:
            raise InputError(path, "changed while it was written, expected one rebuild at a time in a work folder")
        return StageResult(arrays=fresh.arrays, content=fresh.content, reused=False)

    def place(self, name: str) -> Path:
        """Where a file of results is written.

        :raises InputError: links in the work folder lead outside the roots
        """
        path = self.path / name
        check_writable(path, path, self.path / CORRECTIONS)
        return path

    def correction(self, name: str) -> Path | None:
        """The corrected mesh of a stage's result.

        :raises InputError: more than one
        """
        found = [self.path / CORRECTIONS / f"{name}{suffix}" for suffix in _SUFFIXES]
        found = [path for path in found if path.is_file()]
        if len(found) > 1:
            names = ", ".join(path.name for path in found)
            raise InputError(self.path / CORRECTIONS, f"{names}, expected one correction of {name}")
        return found[0] if found else None

    def corrections(self) -> tuple[str, ...]:
        """Names of all corrected meshes, as paths below ``corrections`` without suffixes."""
        folder = self.path / CORRECTIONS
        files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _SUFFIXES and path.is_file())
        return tuple(path.relative_to(folder).with_suffix("").as_posix() for path in files)

    def _read(
        self, path: Path, key: str, check: Callable[[Mapping[str, Array], Mapping[str, Any]], object]
    ) -> StageResult | None:
        if not path.is_file():
            return None
        try:
            found = read_arrays(path, KIND)
            content = found.content.get("content")
            if found.content.get("key") != key or not isinstance(content, dict):
                return None
            check(found.arrays, content)
        except InputError:
            return None
        return StageResult(arrays=found.arrays, content=content, reused=True)


def stage_key(inputs: Mapping[str, Any]) -> str:
    """``sha256:...`` of what a stage's result depends on, facepipe's version among it."""
    text = json.dumps({"facepipe": __version__, **inputs}, sort_keys=True, allow_nan=False)
    return f"sha256:{hashlib.sha256(text.encode()).hexdigest()}"


def array_digest(*arrays: Array) -> str:
    """``sha256:...`` of arrays of numbers."""
    found = hashlib.sha256()
    for array in arrays:
        found.update(f"{array.dtype.str}{array.shape}".encode())
        found.update(np.ascontiguousarray(array).tobytes())
    return f"sha256:{found.hexdigest()}"
