"""The Khronos glTF validator, where node has it (`npm install --global gltf-validator`, or NODE_PATH)."""

from __future__ import annotations

import json
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any, Literal

from facepipe.core.reports import Finding
from facepipe_gltf.node import find_node

# Modules beside the file or in the working folder are left alone: a downloaded folder must not bring code along.
_PROGRAM = """
const fs = require("fs"), path = require("path");
const roots = [path.join(path.dirname(process.execPath), "..", "lib", "node_modules"),
               path.join(process.env.APPDATA || path.dirname(process.execPath), "npm", "node_modules")];
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
_SECONDS = 300
_SEVERITIES: tuple[Literal["error", "warning", "info"], ...] = ("error", "warning", "info")


def check_khronos(path: Path) -> list[Finding]:
    """Its errors, warnings and notes; one note where it is not installed or gave no report."""
    node = find_node()
    report = _report(node, path) if node else None
    if isinstance(report, str):
        return [Finding(check="khronos:Report", severity="info", where=path.name, message=report)]
    if report is None:
        message = "gltf-validator for node is not installed: the Khronos validator was not run"
        return [Finding(check="khronos:NotInstalled", severity="info", where=path.name, message=message)]
    return _findings(path, report["issues"]["messages"])


def _findings(path: Path, issues: list[dict[str, Any]]) -> list[Finding]:
    """A finding per error and warning, and one per kind of note."""
    notes = Counter(issue["code"] for issue in issues if issue["severity"] == 2)
    found = []
    for issue in issues:
        times = notes.pop(issue["code"], 0) if issue["severity"] == 2 else 1
        if times and issue["severity"] < len(_SEVERITIES):
            message = " ".join(str(issue["message"]).split())
            found.append(
                Finding(
                    check=f"khronos:{issue['code']}",
                    severity=_SEVERITIES[issue["severity"]],
                    where=f"{path.name} -> {issue.get('pointer') or '/'}",
                    message=f"{message} ({times} times)" if times > 1 else message,
                )
            )
    return found


def _report(node: str, path: Path) -> Any:
    """Its report, None where it is not installed, or a line that says why there is none."""
    command = [node, "-e", _PROGRAM, str(path.resolve())]
    try:
        done = subprocess.run(command, capture_output=True, timeout=_SECONDS, check=False)
    except subprocess.TimeoutExpired:
        return f"no report of the Khronos validator within {_SECONDS} seconds"
    except OSError as error:
        return f"node can't be run: {error.strerror or error}"
    if done.returncode:
        return f"no report of the Khronos validator: {done.stderr.decode(errors='replace').strip()[-200:]}"
    return json.loads(done.stdout)
