"""Programs of npm's packages that exporters can do without, run by node where it has them."""

from __future__ import annotations

import subprocess

from facepipe.core.errors import ExportError, InputError
from facepipe.core.policy.children import find_program

_SECONDS = 300
_NOT_INSTALLED = 4
_FOUND = """
const { pathToFileURL } = require("url");
const found = (name) => {
  try { return pathToFileURL(require.resolve(name, { paths: roots })).href; } catch (error) { process.exit(4); }
};
const received = async () => {
  const chunks = [];
  for await (const chunk of process.stdin) chunks.push(chunk);
  return Buffer.concat(chunks);
};
"""


def answer_of(where: str, package: str, program: str, request: bytes, seconds: float = _SECONDS) -> bytes:
    """What the body of an asynchronous JavaScript function writes to standard output.

    It has `found(name)`, the address of a package's module, and `received()`, which gives the request.

    :param where: the option that asks for it, for messages
    :raises InputError: node or the package is not installed
    :raises ExportError: the program failed
    """
    from facepipe_gltf.validation import run_node

    node = find_program("node")
    if node is None:
        raise InputError(where, f"needs node (20 or newer) on the PATH, and its package {package}")
    failed = "(error) => { console.error(String(error)); process.exitCode = 3; }"
    asked = f"{_FOUND}(async () => {{{program}}})().catch({failed});"
    try:
        done = run_node(node, asked, request=request, seconds=seconds)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ExportError(where, f"node did not compress the file: {error}") from None
    if done.returncode == _NOT_INSTALLED:
        how = f"`npm install --global {package}`, or NODE_PATH with the folder that holds it"
        raise InputError(where, f"node has no package {package}, expected {how}")
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines()
        raise ExportError(where, f"node did not compress the file: {lines[-1][:200] if lines else done.returncode}")
    return done.stdout
