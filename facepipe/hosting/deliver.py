"""A face for the engine in one go: GLB, ONNX and a report of checks, all of them or none."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

from facepipe.checks import validate
from facepipe.core.atomic import hidden_folder, replacing, together
from facepipe.core.errors import InputError
from facepipe.core.policy.paths import check_written
from facepipe.core.reports import ExportReport, Finding, Report
from facepipe.registry import exporter
from facepipe.stage import open_face

_SUFFIXES = ("glb", "onnx")


@dataclass(frozen=True, kw_only=True)
class DeliveryReport(Report):
    """What was written, and what the checks found in the face and in the files."""

    files: tuple[Path, ...]
    exports: tuple[ExportReport, ...]
    findings: tuple[Finding, ...]
    facts: tuple[str, ...] = ()  # what a format doesn't hold, which is no fault

    @property
    def errors(self) -> int:
        """Findings that are errors."""
        return sum(finding.severity == "error" for finding in self.findings)


def outputs(folder: Path, name: str) -> tuple[Path, ...]:
    """The files that `deliver` writes."""
    return tuple(folder / f"{name}.{suffix}" for suffix in ("glb", "onnx", "onnx.json", "report.json"))


def deliver(path: Path, folder: Path, name: str, *, sliders: bool = False, overwrite: bool = False) -> DeliveryReport:
    """Export the face of a USD file as ``name.glb`` and ``name.onnx`` and check all; a report goes beside them.

    :param folder: there already
    :param sliders: the graph takes sliders in place of bone coefficients and shape weights
    :param overwrite: put the files in place of others of their names
    :raises InputError: no such folder, a name that is a path, or files that are there already
    :raises FacepipeError: a face that a format can't hold; then nothing is written
    """
    if not name or Path(name).name != name:
        raise InputError(f"name '{name}'", "expected a file name without folder and suffix")
    check_written(folder / name)
    if not folder.is_dir():
        raise InputError(folder, "the folder does not exist")
    there = [output.name for output in outputs(folder, name) if output.exists()]
    if there and not overwrite:
        raise InputError(folder / there[0], "exists, expected another name or folder (or to overwrite it)")
    face = open_face(path)
    with hidden_folder(folder) as inner:
        exports, findings = [], list(validate(path))
        for suffix in _SUFFIXES:
            module = exporter(f"{name}.{suffix}")
            settings = {"sliders": True} if sliders and suffix == "onnx" else {}
            exports.append(module.export(face, inner / f"{name}.{suffix}", module.Options(**settings)))
            findings += validate(inner / f"{name}.{suffix}")
        names = sorted(one.name for one in inner.iterdir())
        moved = [  # to where they go
            dataclasses.replace(
                export, path=folder / export.path.name, files=tuple(folder / file.name for file in export.files)
            )
            for export in exports
        ]
        report = DeliveryReport(
            files=tuple(folder / one for one in (*names, f"{name}.report.json")),
            exports=tuple(moved),
            findings=tuple(findings),
            facts=tuple(dict.fromkeys(line for export in exports for line in export.dropped)),
            warnings=tuple(dict.fromkeys(line for export in exports for line in export.warnings)),
        )
        # the report as JSON with file names alone and without times: the same face gives the same bytes
        content = report.to_dict()
        content["files"] = [Path(one).name for one in content["files"]]
        for export in content["exports"]:
            del export["seconds"]
            export["path"] = Path(export["path"]).name
            export["files"] = [Path(file).name for file in export["files"]]
        (inner / f"{name}.report.json").write_text(
            json.dumps(content, indent=2, sort_keys=True) + "\n", encoding="utf-8"
        )
        with together(folder / f"{name}.glb"):
            for one in sorted(inner.iterdir()):
                with replacing(folder / one.name) as temporary:
                    one.replace(temporary)
    return report
