"""The work folder of a rebuild: each step's result, kept until its inputs change, and an artist's corrections.

A result is ``NAME.fpstage`` (arrays, and JSON with the key of the inputs that it came from), written whole or not at
all, so that an interrupted rebuild goes on where it was. Beside it ``NAME.usdc`` shows the mesh. A corrected mesh of
the same topology, ``corrections/NAME.usdc`` (or .usda, .obj, .glb ...), takes its place in all that follows.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core import __version__
from facepipe.core.arrays import AnyArray, FloatArray
from facepipe.core.atomic import collect
from facepipe.core.errors import InputError, system_errors
from facepipe.core.policy.paths import check_found, check_writable
from facepipe.core.reports import Report
from facepipe.geometry.similarity import Similarity
from facepipe.records import ArrayReader, from_json
from facepipe.verbs.array_file import read_arrays, write_arrays

_MORE = ("together",)  # of a report of all scans together
CORRECTIONS = "corrections"
KIND = "facepipe rebuild stage 1"
_SUFFIXES = (".usdc", ".usda", ".usd", ".usdz", ".obj", ".glb", ".gltf", ".fbx")


Arrays = Mapping[str, AnyArray]
Content = Mapping[str, Any]  # JSON: report, weights, place


def check_kept(
    arrays: Arrays,
    content: Content,
    *,
    count: int,
    points: tuple[str, ...] = (),
    matched: bool = False,
    shapes: bool = False,
    place: bool = False,
    report: type[Report] | None = None,
) -> None:
    """Arrays and JSON are those of one kind of step.

    :param count: points of the template
    :param points: names of arrays (n, 3)
    :param matched: and one of (n,) integers
    :param shapes: and one of (n, 3) a name
    :raises InputError: something else
    """
    # A file may be damaged, or from another template: what fits is used, anything else is made anew.
    sizes: dict[str, tuple[int, ...]] = dict.fromkeys(points, (count, 3))
    if shapes:
        names = content.get("names")
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError("names", "no list of names")
        sizes |= dict.fromkeys((f"shape/{name}" for name in names), (count, 3))
    if matched:
        sizes["matched"] = (count,)
    for name, shape in sizes.items():
        if name not in arrays or arrays[name].shape != shape:
            raise InputError(name, f"no array of shape {shape}")
    if place:
        try:
            found = place_of(content["place"])
        except (LookupError, TypeError, ValueError):
            raise InputError("place", "no rotation, translation and scale") from None
        sound = found.rotation.shape == (3, 3) and found.translation.shape == (3,) and 0.0 < found.scale < math.inf
        turns = sound and np.allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-3)
        if not turns or not np.isfinite(found.translation).all():
            raise InputError("place", "no rotation, translation and scale")
    if report is not None:
        own = content.get("report")
        known = {key: one for key, one in own.items() if key not in _MORE} if isinstance(own, dict) else own
        from_json(report, known, ArrayReader(b""), "report")


def place_json(place: Similarity | None) -> dict[str, Any] | None:
    """A similarity as JSON."""
    if place is None:
        return None
    return {"rotation": place.rotation.tolist(), "translation": place.translation.tolist(), "scale": place.scale}


def place_of(values: Mapping[str, Any]) -> Similarity:
    """A similarity of JSON."""
    return Similarity(
        rotation=np.array(values["rotation"], np.float64),
        translation=np.array(values["translation"], np.float64),
        scale=float(values["scale"]),
    )


def shape_arrays(shapes: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Shapes by arrays' names; float32, as files hold points."""
    return {f"shape/{name}": np.asarray(delta, np.float32) for name, delta in shapes.items()}


def shapes_of(arrays: Mapping[str, AnyArray], names: list[str]) -> dict[str, FloatArray]:
    """The shapes back, in the order of `names`."""
    return {name: np.asarray(arrays[f"shape/{name}"], np.float64) for name in names}


class WorkFolder:
    """:raises InputError: `path` can't be made, is a file, or has links that lead outside the roots"""

    def __init__(self, path: Path) -> None:
        self.path = path
        with system_errors(path, "can't be made"):
            self.place(CORRECTIONS).mkdir(parents=True, exist_ok=True)

    def step(
        self,
        name: str,
        inputs: Mapping[str, Any],
        compute: Callable[[], tuple[Arrays, Content]],
        check: Callable[[Arrays, Content], object] = lambda arrays, content: None,
    ) -> tuple[Arrays, Content, bool]:
        """The result of a step: the one that is there, where it came from the same `inputs`, otherwise a new one; and
        whether it was there.

        A damaged file is made anew, and so is one that holds something else.

        :param inputs: JSON: digests of files and arrays, options
        :param check: raises InputError where arrays and content are not what the step keeps
        :raises FacepipeError: of `compute`; what was there stays then. Or links that lead outside the roots
        """
        # ``sha256:...`` of what a step's result depends on, facepipe's version among it
        text = json.dumps({"facepipe": __version__, **inputs}, sort_keys=True, allow_nan=False)
        key = f"sha256:{hashlib.sha256(text.encode()).hexdigest()}"
        path = self.place(f"{name}.fpstage")
        collect(path.parent)  # nothing may be written there any more
        known = self._read(path, key, check)
        if known is not None:
            return *known, True
        arrays, content = compute()
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(path, KIND, {"key": key, "content": dict(content)}, arrays)
        fresh = self._read(path, key, check)
        if fresh is None:
            raise InputError(path, "changed while it was written, expected one rebuild at a time in a work folder")
        return *fresh, False

    def place(self, name: str) -> Path:
        """Where a file of results is written.

        :raises InputError: links in the work folder lead outside the roots
        """
        path = self.path / name
        check_writable(path, path, self.path / CORRECTIONS)
        return path

    def correction(self, name: str) -> Path | None:
        """The corrected mesh of a step's result.

        :raises InputError: more than one, or a link that leads outside the roots
        """
        files = [self.path / CORRECTIONS / f"{name}{suffix}" for suffix in _SUFFIXES]
        for path in files:
            check_found(path, self.path)
        files = [path for path in files if path.is_file()]
        if len(files) > 1:
            names = ", ".join(path.name for path in files)
            raise InputError(self.path / CORRECTIONS, f"{names}, expected one correction of {name}")
        return files[0] if files else None

    def corrections(self) -> tuple[str, ...]:
        """Names of all corrected meshes, as paths below ``corrections`` without suffixes.

        :raises InputError: a link that leads outside the roots
        """
        folder = self.path / CORRECTIONS
        check_found(folder, self.path)
        files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _SUFFIXES)
        for path in files:
            check_found(path, self.path)
        return tuple(path.relative_to(folder).with_suffix("").as_posix() for path in files if path.is_file())

    def _read(self, path: Path, key: str, check: Callable[[Arrays, Content], object]) -> tuple[Arrays, Content] | None:
        if not path.is_file():
            return None
        try:
            file = read_arrays(path, KIND)
            content = file.content.get("content")
            if file.content.get("key") != key or not isinstance(content, dict):
                return None
            check(file.arrays, content)
        except InputError:
            return None
        return file.arrays, content


def array_digest(*arrays: AnyArray) -> str:
    """``sha256:...`` of arrays of numbers."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return f"sha256:{digest.hexdigest()}"
