"""Check faces, GLB, glTF, VRM and ONNX files. Exit 1 where a check finds an error.

example: facepipe validate head.usdc head.glb head.onnx
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from facepipe.cli.show import emit, progress


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="face stage, .glb, .gltf, .vrm or .onnx")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Check each file and print the findings."""
    from facepipe.checks import validate

    findings = []
    with progress("validate", len(arguments.files)) as bar:
        for file in arguments.files:
            findings += [(file, finding) for finding in validate(file)]
            bar.update()
    errors = sum(finding.severity == "error" for _, finding in findings)
    result = {
        "files": [str(file) for file in arguments.files],
        "errors": errors,
        "findings": [{"file": str(file), **dataclasses.asdict(finding)} for file, finding in findings],
    }
    lines = [str(finding) for _, finding in findings]
    verdict = f"{len(arguments.files)} file(s) checked: {errors} error(s), {len(findings) - errors} other finding(s)"
    emit(result, "\n".join([*lines, verdict]), as_json=arguments.json)
    return 1 if errors else 0
