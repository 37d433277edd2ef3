"""What a studio may run before a face is published: cook it, check it, export it, check what was exported.

usage: python samples/pre_publish.py FACE FOLDER

FOLDER gets FACE.glb and FACE.onnx with its sidecar, all of them or none. Exit code 1: a threshold was missed or a check
found an error; 2: a file can't be read, cooked or written. Nothing is published then, and what was there stays.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import facepipe
from facepipe import registry
from facepipe.checks import validate
from facepipe.cooking import CookOptions, CookReport, cook
from facepipe.core.errors import FacepipeError

FORMATS = (".glb", ".onnx")


def publish(face: Path, folder: Path) -> int:
    """The exit code."""
    report = cook([face], CookOptions(validate=True))
    for node in report.nodes:
        print(f"{node.file.name}: {node.action}", *node.why, sep="; ")
    if not report.good:
        return refuse(complaints(report))
    with tempfile.TemporaryDirectory(dir=folder, prefix=".publish.") as work:
        made = [export(face, Path(work) / f"{face.stem}{suffix}") for suffix in FORMATS]
        errors = [str(one.message) for path in made for one in validate(path) if one.severity == "error"]
        if errors:
            return refuse(errors)
        for path in sorted(Path(work).iterdir()):
            path.replace(folder / path.name)
            print(str(folder / path.name))
    return 0


def export(face: Path, path: Path) -> Path:
    """The face in the format of a suffix."""
    exporter = registry.exporter(path)
    report = exporter.export(facepipe.open(face), path, exporter.Options())
    for line in (*report.warnings, *report.dropped):
        print(f"{path.name}: {line}")
    return path


def complaints(report: CookReport) -> list[str]:
    """Why a face that is cooked is not good."""
    errors = [one for found in report.findings.values() for one in found if one.severity == "error"]
    missed = [f"{node.file.name}: a threshold is missed" for node in report.nodes if node.missed]
    return [*missed, *(f"{one.where}: {one.message}" for one in errors)]


def refuse(lines: list[str]) -> int:
    """Tell why nothing is published."""
    for line in lines:
        print(line, file=sys.stderr)
    return 1


def main(words: list[str]) -> int:
    """The exit code; what can't be done is told in one line."""
    if len(words) != 2:
        print(__doc__, file=sys.stderr)
        return 2
    try:
        return publish(Path(words[0]), Path(words[1]))
    except (FacepipeError, OSError) as error:
        print(error, file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
