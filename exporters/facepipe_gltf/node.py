"""The program node, which runs what others wrote for it alone: packages of npm, none of the working folder."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

_SECONDS = 300
# Modules beside a file or in the working folder are left alone: a downloaded folder must not bring code along.
_ROOTS = """
const path = require("path");
const roots = [path.join(path.dirname(process.execPath), "..", "lib", "node_modules"),
               path.join(process.env.APPDATA || path.dirname(process.execPath), "npm", "node_modules")];
"""


def find_node() -> str | None:
    """The program node of the PATH; None where there is none.

    Windows looks in the working folder first, and a downloaded folder must not bring programs along.
    """
    found = shutil.which("node")
    return found if found and Path(found).is_absolute() else None


def run_node(node: str, program: str, *arguments: str, request: bytes = b"") -> subprocess.CompletedProcess[bytes]:
    """What a JavaScript `program` makes of its arguments and standard input.

    It has the module `path`, and `roots`: the folders of packages that npm installed for all.

    :raises OSError: node can't be run
    :raises TimeoutExpired: of subprocess, after 300 seconds
    """
    command = [node, "-e", _ROOTS + program, *arguments]
    return subprocess.run(command, input=request, capture_output=True, timeout=_SECONDS, check=False)
