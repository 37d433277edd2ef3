"""facepipe's command lines in a process of their own, one after another: it loads the house once for all of them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

_PROGRAM = """
import contextlib, io, json, sys
from facepipe.cli import main
ends = []
for words in json.loads(sys.argv[1]):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(words)
        except SystemExit as stop:  # usage, help
            code = stop.code or 0
    ends.append([code, out.getvalue(), err.getvalue()])
print(json.dumps(ends))
"""


class End(NamedTuple):
    """How a command line ended."""

    returncode: int
    stdout: str
    stderr: str


def python(folder: Path, root: Path, *words: object) -> End:
    """A process in a folder, which finds the modules of `root` before others."""
    path = os.pathsep.join([str(root), *filter(None, [os.environ.get("PYTHONPATH")])])
    command, environment = [sys.executable, *map(str, words)], os.environ | {"PYTHONPATH": path}
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment)
    return End(done.returncode, done.stdout, done.stderr)


def commands(folder: Path, root: Path, *lines: str) -> list[End]:
    """Lines without their first word, whose words hold no spaces."""
    done = python(folder, root, "-c", _PROGRAM, json.dumps([line.split() for line in lines]))
    assert done.returncode == 0, done.stderr
    return [End(*end) for end in json.loads(done.stdout)]
