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
from facepipe.cooking import CookOptions


def publish(face: Path, folder: Path) -> list[str]:
    """Why nothing is published; no reason where it is."""
    report = facepipe.cook([face], CookOptions(validate=True))
    for node in report.nodes:
        print(f"{node.file.name}: {node.action}", *node.why, sep="; ")
    if not report.good:
        missed = [f"{node.file.name}: a threshold is missed" for node in report.nodes if node.missed]
        stale = [f"{node.file.name}: {node.action}" for node in report.nodes if node.action == "outside the roots"]
        findings = [one for found in report.findings.values() for one in found if one.severity == "error"]
        return [*missed, *stale, *(f"{one.where}: {one.message}" for one in findings)]
    with tempfile.TemporaryDirectory(dir=folder, prefix=".publish.") as work:
        for path in (Path(work, f"{face.stem}{suffix}") for suffix in (".glb", ".onnx")):
            written = facepipe.export(face, path)
            for line in (*written.warnings, *written.dropped):
                print(f"{path.name}: {line}")
            errors = [one.message for one in facepipe.validate(path) if one.severity == "error"]
            if errors:
                return errors
        for path in sorted(Path(work).iterdir()):
            print(path.replace(folder / path.name))
    return []


def main(words: list[str]) -> int:
    """The exit code."""
    if len(words) != 2:
        print(__doc__, file=sys.stderr)
        return 2
    try:
        reasons = publish(Path(words[0]), Path(words[1]))
    except (facepipe.FacepipeError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    for reason in reasons:
        print(reason, file=sys.stderr)
    return 1 if reasons else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
