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
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core import __version__
from facepipe.core.arrays import AnyArray, FloatArray
from facepipe.core.atomic import collect
from facepipe.core.errors import InputError
from facepipe.core.policy.paths import check_found, check_writable
from facepipe.core.reports import Report
from facepipe.geometry.similarity import Similarity
from facepipe.importers.scan_file import read_scan
from facepipe.importers.scan_landmarks import read_scan_landmarks
from facepipe.parts import FaceParts
from facepipe.records import ArrayReader, from_json
from facepipe.scanning.database import FaceDatabase, load_database
from facepipe.scanning.rebuild.fit_neutral import NeutralReport
from facepipe.scanning.rebuild.project import Project, ProjectScan
from facepipe.scanning.rebuild.refine_neutral import RefineReport
from facepipe.scanning.rebuild.register_scans import Composite, CompositeReport, NeutralScan
from facepipe.scanning.rebuild.scan_input import landmarks_of
from facepipe.scanning.rebuild.split_expressions import SplitReport
from facepipe.scanning.rebuild.template import Template
from facepipe.scans import Scan, ScanLandmarks
from facepipe.stage import open_face, save_parts
from facepipe.stage.recipes import source_digest
from facepipe.verbs.array_file import read_arrays, write_arrays
from facepipe.verbs.whole_faces import whole_face

_MORE = ("together",)  # of a report of all scans together
CORRECTIONS = "corrections"
KIND = "facepipe rebuild stage 1"
_SUFFIXES = (".usdc", ".usda", ".usd", ".usdz", ".obj", ".glb", ".gltf")


@dataclass(frozen=True, kw_only=True)
class Kept:
    """Arrays and JSON of one kind of step."""

    points: tuple[str, ...] = ()  # arrays (n, 3)
    matched: bool = False  # and one of (n,) integers
    shapes: bool = False  # and one of (n, 3) a name
    place: bool = False
    report: type[Report] | None = None

    def check(self, arrays: Mapping[str, AnyArray], content: Mapping[str, Any], count: int) -> None:
        """:param count: points of the template
        :raises InputError: something else
        """
        names = list(self.points) + ([f"shape/{name}" for name in _names(content)] if self.shapes else [])
        sizes: dict[str, tuple[int, ...]] = dict.fromkeys(names, (count, 3))
        for name, shape in (sizes | ({"matched": (count,)} if self.matched else {})).items():
            if name not in arrays or arrays[name].shape != shape:
                raise InputError(name, f"no array of shape {shape}")
        if self.place:
            _check_place(content.get("place"))
        if self.report is not None:
            own = content.get("report")
            known = {key: one for key, one in own.items() if key not in _MORE} if isinstance(own, dict) else own
            from_json(self.report, known, ArrayReader(b""), "report")


NEUTRAL = Kept(points=("points", "expression"), place=True, report=NeutralReport)
REFINED = Kept(points=("points",), report=RefineReport)
TEMPLATE = Kept(shapes=True)
EXPRESSION = Kept(points=("points",), matched=True, place=True, report=CompositeReport)
SHAPES = Kept(shapes=True, report=SplitReport)


def _names(content: Mapping[str, Any]) -> list[str]:
    names = content.get("names")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError("names", "no list of names")
    return names


def _check_place(content: object) -> None:
    try:
        place = place_of(content if isinstance(content, Mapping) else {})
    except (LookupError, TypeError, ValueError):
        raise InputError("place", "no rotation, translation and scale") from None
    sound = place.rotation.shape == (3, 3) and place.translation.shape == (3,) and 0.0 < place.scale < math.inf
    turns = sound and np.allclose(place.rotation @ place.rotation.T, np.eye(3), atol=1e-3)
    if not turns or not np.isfinite(place.translation).all():
        raise InputError("place", "no rotation, translation and scale")


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """How a result lies on its scan."""

    place: Similarity  # from the scan's coordinates to those of the points
    report: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class FittedNeutral(Fitted):
    """The neutral, as corrected."""

    scan: NeutralScan


@dataclass(frozen=True, kw_only=True)
class FittedExpression(Fitted):
    """An expression, as corrected."""

    composite: Composite


def place_json(place: Similarity) -> dict[str, Any]:
    """A similarity as JSON."""
    return {
        "rotation": place.rotation.tolist(),
        "translation": place.translation.tolist(),
        "scale": place.scale,
    }


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


@dataclass(frozen=True, kw_only=True)
class StepResult:
    """What one step found."""

    arrays: Mapping[str, AnyArray]
    content: Mapping[str, Any]  # JSON: report, weights, place
    reused: bool  # it was there, of the same inputs


class WorkFolder:
    """:raises InputError: `path` can't be made, is a file, or has links that lead outside the roots"""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.place(CORRECTIONS).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(path, f"can't be made: {error.strerror or error}") from error

    def step(
        self,
        name: str,
        inputs: Mapping[str, Any],
        compute: Callable[[], tuple[Mapping[str, AnyArray], Mapping[str, Any]]],
        check: Callable[[Mapping[str, AnyArray], Mapping[str, Any]], object] = lambda arrays, content: None,
    ) -> StepResult:
        """The result of a step: the one that is there where it came from the same `inputs`, otherwise a new one.

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
            return known
        arrays, content = compute()
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(path, KIND, {"key": key, "content": dict(content)}, arrays)
        fresh = self._read(path, key, check)
        if fresh is None:
            raise InputError(path, "changed while it was written, expected one rebuild at a time in a work folder")
        return StepResult(arrays=fresh.arrays, content=fresh.content, reused=False)

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

    def _read(
        self, path: Path, key: str, check: Callable[[Mapping[str, AnyArray], Mapping[str, Any]], object]
    ) -> StepResult | None:
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
        return StepResult(arrays=file.arrays, content=content, reused=True)


def array_digest(*arrays: AnyArray) -> str:
    """``sha256:...`` of arrays of numbers."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return f"sha256:{digest.hexdigest()}"


class Steps:
    """The work folder of one run, and what happened in it.

    :param began: called with the name of each step as it begins
    :raises InputError: a work folder that can't be made
    """

    def __init__(self, project: Project, template: Template, began: Callable[[str], object]) -> None:
        self.project, self.template, self._began = project, template, began
        self._folder = WorkFolder(project.work)
        self._database: FaceDatabase | None = None
        self._digests: dict[Path, str] = {}
        self._found: dict[Path, ScanLandmarks] = {}
        self.reused: list[str] = []
        self.corrected: list[str] = []

    def step(
        self,
        name: str,
        inputs: Mapping[str, Any],
        compute: Callable[[], tuple[dict[str, Any], dict[str, Any]]],
        kept: Kept,
    ) -> StepResult:
        """The result of a step, with a mesh beside it where it has points: for eyes and for an artist's hand.

        :raises FacepipeError: of `compute`
        """
        self._began(name)
        count = self.template.topology.point_count
        result = self._folder.step(name, inputs, compute, partial(kept.check, count=count))
        if result.reused:
            self.reused.append(name)
        if "points" in result.arrays:
            self._show(name, result)
        return result

    def after_correction(self, name: str, points: FloatArray) -> FloatArray:
        """The points (n, 3) of a step, or of the mesh that an artist put in their place.

        :raises InputError: a mesh that can't be read, or more than one
        :raises TopologyError: a mesh of another topology
        """
        path = self._folder.correction(name)
        if path is None:
            return np.asarray(points, np.float64)
        self.corrected.append(name)
        return whole_face(_face(path), str(path), self.template.topology, self.template.where).points

    def has_correction(self, name: str) -> bool:
        """Whether an artist put a mesh in the place of a step's result.

        :raises InputError: more than one
        """
        return self._folder.correction(name) is not None

    def idle_corrections(self) -> tuple[str, ...]:
        """A line for each mesh that corrects nothing."""
        idle = [name for name in self._folder.corrections() if name not in self.corrected]
        return tuple(f"{self._folder.path}/corrections/{name}: corrects no result" for name in idle)

    def read(self, scan: ProjectScan) -> tuple[Scan, ScanLandmarks]:
        """A scan and its landmarks, which are found on it, once, where none are given.

        :raises FacepipeError: of the readers
        """
        named = replace(read_scan(scan.scan), name=str(scan.scan))
        if scan.landmarks:
            return named, self.landmarks(scan)
        if scan.scan not in self._found:
            self._found[scan.scan] = landmarks_of(None, named)[0]
        return named, self._found[scan.scan]

    def landmarks(self, scan: ProjectScan) -> ScanLandmarks:
        """Those that are given for a scan."""
        return read_scan_landmarks(scan.landmarks) if scan.landmarks else ScanLandmarks()

    def database(self) -> FaceDatabase:
        """The project's, read once."""
        if self._database is None:
            self._database = load_database(self.project.database)
        return self._database

    def digest(self, path: Path | None) -> str:
        """Of a file with what it stands on, found once; empty where there is none.

        :raises InputError: a file that can't be read
        """
        if path is None:
            return ""
        if path not in self._digests:
            self._digests[path] = source_digest(path)
        return self._digests[path]

    def inputs(self, scan: ProjectScan, options: Any, **more: Any) -> dict[str, Any]:
        """What a fit to one scan depends on."""
        return {
            "template": self.digest(self.project.template),
            "scan": self.digest(scan.scan),
            "landmarks": self.digest(scan.landmarks),
            "options": asdict(options),
            **more,
        }

    def _show(self, name: str, result: StepResult) -> None:
        path = self._folder.place(f"{name}.usdc")
        if not (result.reused and path.is_file()):
            save_parts(self.template.topology.parts(result.arrays["points"]), path)


def _face(path: Path) -> FaceParts:
    """A corrected mesh; OBJ files are in millimetres, Y up, as the meshes of the work folder are."""
    from facepipe.importers import load, obj

    suffix = path.suffix.lower()
    if suffix == ".obj":
        return load("obj", path, obj.Options(meters_per_unit=0.001, up_axis="Y")).parts
    if suffix in (".glb", ".gltf"):
        return load("gltf", path).parts
    return open_face(path).parts()
