"""The program node, which runs what others wrote for it alone: packages of npm, none of the working folder."""

from __future__ import annotations

from subprocess import CompletedProcess

from facepipe.core.policy.children import run

_SECONDS = 300
# Modules beside a file or in the working folder are left alone: a downloaded folder must not bring code along.
_ROOTS = """
const path = require("path");
const roots = [path.join(path.dirname(process.execPath), "..", "lib", "node_modules"),
               path.join(process.env.APPDATA || path.dirname(process.execPath), "npm", "node_modules")];
"""


def run_node(node: str, program: str, *arguments: str, request: bytes = b"") -> CompletedProcess[bytes]:
    """What a JavaScript `program` makes of its arguments (absolute paths) and standard input.

    It has the module `path`, and `roots`: the folders of packages that npm installed for all.

    :raises OSError: node can't be run
    :raises TimeoutExpired: of subprocess, after 300 seconds
    """
    return run([node, "-e", _ROOTS + program, *arguments], request=request, seconds=_SECONDS)
