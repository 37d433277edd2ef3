"""Projects: what a rebuild is made of, in TOML. Paths are relative to the project's folder.

template = "head.usdc"                      # face stage with multipie68 landmarks
database = "faces.fpdb"
work = "work"                               # folder of results, below the roots (default: the project's name)
joint = true                                # the neutral is refined on all scans together (default: false)

[neutral]
scan = "scans/neutral.ply"
landmarks = "scans/neutral.landmarks.json"  # default: beside the scan, or found on it
weights = { eyeBlinkLeft = 1, eyeBlinkRight = 1 }  # what the scan shows besides the neutral (default: nothing)

[expressions.smile]                         # one table for each other scan
scan = "scans/smile.ply"
weights = { mouthSmileLeft = 1, mouthSmileRight = 1 }  # default: what the table of composites has under its name

[options.neutral]                           # and options.template, options.expressions, options.split
unit = "mm"

[options.refinement]                        # without this table the neutral stays as it was fitted
regions = ["nose", "mouth"]                 # default: all may follow
detail_mm = 8
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.core.names import file_name
from facepipe.core.policy.paths import check_writable, file_named, path_named
from facepipe.core.reading import file_beside, is_file, read_toml
from facepipe.declare import from_json
from facepipe.scanning.rebuild.declared import (
    BakeScanOptions,
    FitNeutralOptions,
    PersonalTemplateOptions,
    RefineNeutralOptions,
    RegisterScansOptions,
    SplitExpressionsOptions,
)
from facepipe.scanning.rebuild.template import DEFAULT_COMPOSITES, resolved

_MOST_BYTES = 1 << 22


@dataclass(frozen=True, kw_only=True)
class ProjectScan:
    """A scan and what goes with it; files that are there."""

    name: str
    scan: Path
    landmarks: Path | None = None  # None: they are to be found on the scan
    weights: Mapping[str, float] = field(default_factory=dict)  # of shapes, by the names that were given


@dataclass(frozen=True, kw_only=True)
class Refinement(RefineNeutralOptions):
    """Which regions of the neutral are drawn closer to its scan, and how."""

    regions: tuple[str, ...] = ()  # none: all


@dataclass(frozen=True, kw_only=True)
class ProjectOptions:
    """Options of each step."""

    neutral: FitNeutralOptions = field(default_factory=FitNeutralOptions)
    refinement: Refinement | None = None  # None: the neutral stays as it was fitted
    template: PersonalTemplateOptions = field(default_factory=PersonalTemplateOptions)
    expressions: RegisterScansOptions = field(default_factory=RegisterScansOptions)
    split: SplitExpressionsOptions = field(default_factory=SplitExpressionsOptions)
    textures: BakeScanOptions = field(default_factory=BakeScanOptions)


@dataclass(frozen=True, kw_only=True)
class Project:
    """A rebuild, checked as far as its text goes."""

    path: Path
    template: Path
    database: Path
    work: Path
    neutral: ProjectScan
    expressions: tuple[ProjectScan, ...]  # in the order of the file
    joint: bool = False  # the neutral is refined on all scans together
    options: ProjectOptions = field(default_factory=ProjectOptions)


@dataclass(frozen=True, kw_only=True)
class _ScanTable:
    scan: str
    landmarks: str | None = None
    weights: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        if self.weights is not None and not self.weights:
            raise InputError("weights", "{}, expected a weight for each shape that it shows")
        for shape, weight in (self.weights or {}).items():
            if not 0.0 < weight <= 2.0:
                raise InputError(f"weights -> {shape[:60]}", f"{weight}, expected a number above 0, up to 2")


@dataclass(frozen=True, kw_only=True)
class _ProjectTable:
    template: str
    database: str
    work: str = ""
    joint: bool = False
    neutral: _ScanTable
    expressions: Mapping[str, _ScanTable] = field(default_factory=dict)
    options: ProjectOptions = field(default_factory=ProjectOptions)


def read_project(path: Path) -> Project:
    """A project's text, checked.

    :raises InputError: not readable, no TOML, not such a project, a file that it names and that is not there, or one or
        a work folder that is outside the roots
    """
    where = str(path)
    table = from_json(_ProjectTable, read_toml(path, _MOST_BYTES), where)
    work = path_named(f"{where} -> work", table.work or path.stem, path)
    check_writable(f"{where} -> work", work, path)
    return Project(
        path=path,
        template=_file(f"{where} -> template", table.template, path),
        database=_file(f"{where} -> database", table.database, path),
        work=work,
        joint=table.joint,
        neutral=_scan(where, "neutral", table.neutral, path, {}),
        expressions=tuple(
            _scan(f"{where} -> expressions", name, scan, path, DEFAULT_COMPOSITES.get(name))
            for name, scan in table.expressions.items()
        ),
        options=table.options,
    )


def expression_weights(project: Project, scan: ProjectScan, shapes: tuple[str, ...]) -> dict[str, float]:
    """Weights of an expression by the names of the personal template's `shapes`.

    :raises InputError: a shape that is not there
    """
    return resolved(scan.weights, shapes, f"{project.path} -> expressions -> {scan.name} -> weights")


def _scan(where: str, name: str, table: _ScanTable, project: Path, usual: Mapping[str, float] | None) -> ProjectScan:
    """:param usual: its weights where the table has none; None: it needs some"""
    where = f"{where} -> {name[:60]}"
    if not (name.isascii() and name.isidentifier()) or file_name(name) != name:
        raise InputError(where, "expected a name of letters, digits and underscores that files can have")
    scan = _file(f"{where} -> scan", table.scan, project)
    if table.landmarks is None:
        landmarks = file_beside(scan, f"{scan.stem}.landmarks.json")
    else:
        landmarks = _file(f"{where} -> landmarks", table.landmarks, project)
    weights = table.weights or usual
    if weights is None:
        known = ", ".join(DEFAULT_COMPOSITES)
        raise InputError(where, f"no weights, expected some, or one of the names that have them: {known}")
    weights = {shape: float(weight) for shape, weight in weights.items()}
    return ProjectScan(name=name, scan=scan, landmarks=landmarks, weights=weights)


def _file(where: str, name: str, project: Path) -> Path:
    path = file_named(where, name, project)
    if not is_file(path):
        raise InputError(where, f"{path}: no such file")
    return path
