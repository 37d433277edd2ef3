"""Scripts under tests/support/blender, run by a Python that has Blender as a module (bpy)."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import REPOSITORY, SUPPORT

PYTHON = "FACEPIPE_BLENDER_PYTHON"

needs_blender = pytest.mark.skipif(
    not os.environ.get(PYTHON), reason=f"{PYTHON} names no Python with bpy (.ci/run makes one)"
)


def run_blender(script: str, *arguments: Any) -> subprocess.CompletedProcess[str]:
    """Run a script with JSON arguments; its output."""
    paths = [REPOSITORY, REPOSITORY / "schemas", REPOSITORY / "exporters", SUPPORT / "blender"]
    words = [json.dumps(str(argument) if isinstance(argument, Path) else argument) for argument in arguments]
    return subprocess.run(
        [os.environ[PYTHON], str(SUPPORT / "blender" / script), *words],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))},
        capture_output=True,
        text=True,
        timeout=1200,
    )


def blender(script: str, *arguments: Any, answer: Path) -> tuple[dict[str, np.ndarray], str]:
    """Run a script that must end well; what it answers, and what it says."""
    done = run_blender(script, *arguments, answer)
    assert done.returncode == 0, done.stdout + done.stderr
    with np.load(answer) as found:
        return dict(found), done.stdout + done.stderr
