"""A command in a Python that finds no torch."""

from __future__ import annotations

import subprocess
import sys

_PROGRAM = """
import importlib.util, sys
class Without:
    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            raise ModuleNotFoundError(name)
find = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name == "torch" else find(name, package)
sys.meta_path.insert(0, Without())
from facepipe.cli import main
sys.exit(main(sys.argv[1:]))
"""
HINT = "facepipe: facepipe.rig.torch: torch is not installed, expected: pip install 'facepipe[train]'\n"


def without_torch(*words: object) -> tuple[int, str]:
    """The exit code of a command line, and what it says on stderr."""
    line = [sys.executable, "-c", _PROGRAM, *map(str, words)]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    return done.returncode, done.stderr
