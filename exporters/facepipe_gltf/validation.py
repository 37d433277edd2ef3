"""Checks of glTF files: ours, and the Khronos validator where node, which is run here, has it."""

from __future__ import annotations

import json
import os
import subprocess
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from subprocess import CompletedProcess
from typing import Literal

import numpy as np

from facepipe.core.policy.children import find_program, run
from facepipe.core.reports import Finding
from facepipe_gltf import mesh_validation as rules
from facepipe_gltf.raw import RawDocument

_SECONDS = 300
# Modules beside a file or in the working folder are left alone: a downloaded folder must not bring code along.
_ROOTS = """
const path = require("path");
const roots = [path.join(path.dirname(process.execPath), "..", "lib", "node_modules"),
               path.join(process.env.APPDATA || path.dirname(process.execPath), "npm", "node_modules")];
"""
_PROGRAM = """
const fs = require("fs");
let validator;
try { validator = require(require.resolve("gltf-validator", { paths: roots })); }
catch (error) { console.log("null"); process.exit(0); }
const file = process.argv[1], folder = fs.realpathSync(path.dirname(file));
const below = (uri) => {
  const target = fs.realpathSync(path.resolve(folder, decodeURIComponent(uri)));
  const inside = path.relative(folder, target);
  if (inside.startsWith("..") || path.isAbsolute(inside)) throw new Error("outside of the folder");
  if (!fs.statSync(target).isFile()) throw new Error("no regular file");
  return new Uint8Array(fs.readFileSync(target));
};
validator.validateBytes(new Uint8Array(fs.readFileSync(file)), {
  uri: path.basename(file), maxIssues: 200, externalResourceFunction: async (uri) => below(uri),
}).then((report) => console.log(JSON.stringify(report)), (error) => { console.error(String(error)); process.exit(3); });
"""
_SEVERITIES: tuple[Literal["error", "warning", "info"], ...] = ("error", "warning", "info")


def run_node(
    node: str, program: str, *arguments: str, request: bytes = b"", seconds: float = _SECONDS
) -> CompletedProcess[bytes]:
    """What a JavaScript `program` makes of its arguments (absolute paths) and standard input.

    It has the module `path`, and `roots`: the folders of packages that npm installed for all.

    :raises OSError: node can't be run
    :raises TimeoutExpired: of subprocess, after `seconds`
    """
    return run([node, "-e", _ROOTS + program, *arguments], request=request, seconds=seconds)


def _check_khronos(path: Path) -> list[Finding]:
    """Errors, warnings and notes of the Khronos glTF validator (`npm install --global gltf-validator`, or NODE_PATH).

    One note where it is not installed or gave no report.
    """
    node, report, failure = find_program("node"), None, ""
    try:
        done = run_node(node, _PROGRAM, str(path.resolve())) if node else None
        if done is not None and done.returncode:
            failure = f"no report of the Khronos validator: {done.stderr.decode(errors='replace').strip()[-200:]}"
        elif done is not None:
            report = json.loads(done.stdout)  # null where it is not installed
    except subprocess.TimeoutExpired as error:
        failure = f"no report of the Khronos validator within {error.timeout:g} seconds"
    except OSError as error:
        failure = f"node can't be run: {error.strerror or error}"
    if failure:
        return [Finding(check="khronos:Report", severity="info", where=path.name, message=failure)]
    if report is None:
        message = "gltf-validator for node is not installed: the Khronos validator was not run"
        return [Finding(check="khronos:NotInstalled", severity="info", where=path.name, message=message)]
    issues = report["issues"]["messages"]
    notes = Counter(issue["code"] for issue in issues if issue["severity"] == 2)
    findings = []
    for issue in issues:
        # one finding for each kind of note: of unused objects and the like a file has hundreds
        times = notes.pop(issue["code"], 0) if issue["severity"] == 2 else 1
        if times and issue["severity"] < len(_SEVERITIES):
            message = " ".join(str(issue["message"]).split())
            findings.append(
                Finding(
                    check=f"khronos:{issue['code']}",
                    severity=_SEVERITIES[issue["severity"]],
                    where=f"{path.name} -> {issue.get('pointer') or '/'}",
                    message=f"{message} ({times} times)" if times > 1 else message,
                )
            )
    return findings


# its name, the check (places and messages), how bad what it finds is
Check = tuple[str, Callable[[RawDocument], Iterable[tuple[str, str]]], Literal["error", "warning"]]

CHECKS: tuple[Check, ...] = (
    ("GltfAsset", rules.asset, "error"),
    ("GltfReferences", rules.references, "error"),
    ("GltfNodeTree", rules.node_tree, "error"),
    ("GltfAccessors", rules.accessors, "error"),
    ("GltfFinite", rules.finite, "error"),
    ("GltfMinMax", rules.bounds, "error"),
    ("GltfVertexCounts", rules.vertex_counts, "error"),
    ("GltfTargetNames", rules.target_names, "error"),
    ("GltfDistinctTargetNames", rules.distinct_target_names, "warning"),
    ("GltfJointIndices", rules.joint_indices, "error"),
    ("GltfWeightsSum", rules.weights_sum, "error"),
    ("GltfInverseBinds", rules.inverse_binds, "error"),
    ("GltfJointOrder", rules.joint_order, "error"),
    ("GltfSkinnedNode", rules.skinned_nodes, "warning"),
)
_DATA = (rules.accessors, rules.finite, rules.bounds)


def errors(document: RawDocument, *, data: bool = True) -> Iterator[tuple[str, str]]:
    """Errors of a document: place and message.

    :param data: the data of all accessors is checked too, which takes most of the time
    """
    with np.errstate(all="ignore"):  # NaN and overflow are what some checks look for
        for _, check, severity in CHECKS:
            if severity == "error" and (data or check not in _DATA):
                yield from check(document)


def validate(path: str | os.PathLike[str], *, khronos: bool = True) -> tuple[Finding, ...]:
    """Findings of all checks in a .glb or .gltf.

    :param khronos: also run the Khronos validator; a note says so where it is not installed
    :raises InputError: no such file, or no glTF at all
    """
    return judged(RawDocument(Path(path)), CHECKS, khronos=khronos)


def judged(document: RawDocument, checks: Iterable[Check], *, khronos: bool) -> tuple[Finding, ...]:
    """Findings of `checks` in a document, and of the Khronos validator in its file."""
    with np.errstate(all="ignore"):  # NaN and overflow are what some checks look for
        findings = [
            Finding(check=f"facepipe:{name}", severity=severity, where=f"{document.path.name} -> {at}", message=message)
            for name, check, severity in checks
            for at, message in check(document)
        ]
    return tuple(findings + (_check_khronos(document.path) if khronos else []))
