"""Projects: what a rebuild is made of, in TOML. Paths are relative to the project's folder.

template = "head.usda"                      # face stage with multipie68 landmarks
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
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from facepipe.core.errors import InputError
from facepipe.core.names import file_name
from facepipe.core.reading import is_file, read_toml
from facepipe.core.trust import check_writable
from facepipe.declare import from_json
from facepipe.processors.rebuild.composites import DEFAULT_COMPOSITES, resolved
from facepipe.processors.rebuild.options import (
    FitNeutralOptions,
    PersonalTemplateOptions,
    RefineNeutralOptions,
    RegisterScansOptions,
    SplitExpressionsOptions,
)

_MOST_BYTES = 1 << 22
_KEYS = ("template", "database", "work", "joint", "neutral", "expressions", "options")
_OPTIONS = ("neutral", "refinement", "template", "expressions", "split")


@dataclass(frozen=True, kw_only=True)
class ProjectScan:
    """A scan and what goes with it; files that are there."""

    name: str
    scan: Path
    landmarks: Path | None = None  # None: they are to be found on the scan
    weights: Mapping[str, float] = field(default_factory=dict)  # of shapes, by the names that were given


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """Which regions of the neutral are drawn closer to its scan, and how."""

    regions: tuple[str, ...] = ()  # none: all
    options: RefineNeutralOptions = field(default_factory=RefineNeutralOptions)


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
    neutral_options: FitNeutralOptions = field(default_factory=FitNeutralOptions)
    refinement: Refinement | None = None  # None: the neutral stays as it was fitted
    template_options: PersonalTemplateOptions = field(default_factory=PersonalTemplateOptions)
    expression_options: RegisterScansOptions = field(default_factory=RegisterScansOptions)
    split_options: SplitExpressionsOptions = field(default_factory=SplitExpressionsOptions)


def read_project(path: Path) -> Project:
    """A project's text, checked.

    :raises InputError: not readable, no TOML, not such a project, a file that it names and that is not there, or a work
        folder outside the roots
    """
    content = read_toml(path, _MOST_BYTES)
    where = str(path)
    _check_keys(where, content, _KEYS)
    options = _table(where, content, "options")
    _check_keys(f"{where} -> options", options, _OPTIONS)
    if "neutral" not in content:
        raise InputError(where, "has no neutral, expected a table [neutral] with its scan")
    expressions = _table(where, content, "expressions")
    return Project(
        path=path,
        template=_file(where, content, "template", path.parent),
        database=_file(where, content, "database", path.parent),
        work=_work(where, content, path),
        joint=_flag(where, content, "joint"),
        neutral=_scan(where, "neutral", _table(where, content, "neutral"), path.parent),
        expressions=tuple(
            _expression(f"{where} -> expressions", name, own, path.parent) for name, own in expressions.items()
        ),
        neutral_options=from_json(FitNeutralOptions, options.get("neutral", {}), f"{where} -> options.neutral"),
        refinement=_refinement(where, options),
        template_options=from_json(
            PersonalTemplateOptions, options.get("template", {}), f"{where} -> options.template"
        ),
        expression_options=from_json(
            RegisterScansOptions, options.get("expressions", {}), f"{where} -> options.expressions"
        ),
        split_options=from_json(SplitExpressionsOptions, options.get("split", {}), f"{where} -> options.split"),
    )


def expression_weights(project: Project, scan: ProjectScan, shapes: tuple[str, ...]) -> dict[str, float]:
    """Weights of an expression by the names of the personal template's `shapes`.

    :raises InputError: a shape that is not there
    """
    return resolved(scan.weights, shapes, f"{project.path} -> expressions -> {scan.name} -> weights")


def _refinement(where: str, options: Mapping[str, Any]) -> Refinement | None:
    if "refinement" not in options:
        return None
    where = f"{where} -> options.refinement"
    values = options["refinement"]
    regions = values.get("regions", []) if isinstance(values, dict) else []
    if not (isinstance(regions, list) and all(isinstance(name, str) for name in regions)):
        raise InputError(f"{where} -> regions", f"{str(regions)[:40]}, expected a list of names")
    numbers = {key: value for key, value in values.items() if key != "regions"} if isinstance(values, dict) else values
    return Refinement(regions=tuple(regions), options=from_json(RefineNeutralOptions, numbers, where))


def _scan(where: str, name: str, content: object, folder: Path) -> ProjectScan:
    where = f"{where} -> {name[:60]}"
    if not (name.isascii() and name.isidentifier()) or file_name(name) != name:
        raise InputError(where, "expected a name of letters, digits and underscores that files can have")
    if not isinstance(content, dict):
        raise InputError(where, f"{str(content)[:40]}, expected a table with a scan")
    _check_keys(where, content, ("scan", "landmarks", "weights"))
    scan = _file(where, content, "scan", folder)
    beside = scan.with_name(f"{scan.stem}.landmarks.json")
    landmarks = _file(where, content, "landmarks", folder) if "landmarks" in content else None
    return ProjectScan(
        name=name,
        scan=scan,
        landmarks=landmarks or (beside if beside.is_file() else None),
        weights=_weights(where, content["weights"]) if "weights" in content else {},
    )


def _expression(where: str, name: str, content: object, folder: Path) -> ProjectScan:
    scan = _scan(where, name, content, folder)
    if scan.weights:
        return scan
    if name not in DEFAULT_COMPOSITES:
        known = ", ".join(DEFAULT_COMPOSITES)
        raise InputError(
            f"{where} -> {name[:60]}", f"no weights, expected some, or one of the names that have them: {known}"
        )
    return replace(scan, weights=dict(DEFAULT_COMPOSITES[name]))


def _weights(where: str, weights: object) -> dict[str, float]:
    if not isinstance(weights, dict) or not weights:
        raise InputError(f"{where} -> weights", f"{str(weights)[:40]}, expected a weight for each shape that it shows")
    for shape, weight in weights.items():
        if isinstance(weight, bool) or not isinstance(weight, int | float) or not 0.0 < weight <= 2.0:
            raise InputError(f"{where} -> weights -> {shape[:60]}", f"{weight}, expected a number above 0, up to 2")
    return {shape: float(weight) for shape, weight in weights.items()}


def _check_keys(where: str, content: Mapping[str, Any], known: tuple[str, ...]) -> None:
    for key in content:
        if key not in known:
            raise InputError(where, f"'{key[:60]}' is unknown, expected some of {', '.join(known)}")


def _table(where: str, content: Mapping[str, Any], key: str) -> dict[str, Any]:
    table = content.get(key, {})
    if not isinstance(table, dict):
        raise InputError(f"{where} -> {key}", f"{str(table)[:40]}, expected a table")
    return table


def _text(where: str, content: Mapping[str, Any], key: str, default: str | None = None) -> str:
    text = content.get(key, default)
    if text is None:
        raise InputError(where, f"has no {key}, expected a file's name")
    if not isinstance(text, str) or not text:
        raise InputError(f"{where} -> {key}", f"{str(text)[:40]}, expected a file's name")
    return text


def _work(where: str, content: Mapping[str, Any], path: Path) -> Path:
    folder = path.parent / _text(where, content, "work", path.stem)
    check_writable(f"{where} -> work", folder, path)
    return folder


def _flag(where: str, content: Mapping[str, Any], key: str) -> bool:
    flag = content.get(key, False)
    if not isinstance(flag, bool):
        raise InputError(f"{where} -> {key}", f"{str(flag)[:40]}, expected true or false")
    return flag


def _file(where: str, content: Mapping[str, Any], key: str, folder: Path) -> Path:
    path = folder / _text(where, content, key)
    if not is_file(path):
        raise InputError(f"{where} -> {key}", f"{path}: no such file")
    return path
