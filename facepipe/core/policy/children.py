"""The one place that starts processes: their programs, modules and libraries never come from the working folder.

A downloaded folder can hold a ``json.py``, a ``pip.py`` or a program called ``node``. So programs have absolute paths,
Python gets ``-P``, lists of folders in the environment lose entries that mean the working folder, and processes start
in a folder of ours: paths that they are given are absolute.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from facepipe.core.errors import InputError

# where code is looked for: entries that are empty or relative mean the working folder, and are left out
_FOLDERS = (
    "PATH",
    "PYTHONPATH",
    "PYTHONPYCACHEPREFIX",  # a folder of bytecode, which would be run in place of modules
    "PYTHONUSERBASE",
    "PXR_PLUGINPATH_NAME",
    "NODE_PATH",
    "LD_LIBRARY_PATH",
    "DYLD_LIBRARY_PATH",
    "DYLD_FALLBACK_LIBRARY_PATH",
)
_DROPPED = ("PYTHONSTARTUP", "PYTHONHOME", "NODE_OPTIONS")  # code to run first, and another standard library
_HERE = Path(__file__).parent
_ENDINGS = (".exe",) if os.name == "nt" else ("",)  # no .cmd: a shell would read its arguments


def find_program(name: str) -> str | None:
    """The absolute path of a program in an absolute folder of PATH; None where there is none.

    Windows, and `shutil.which` there, look into the working folder first.
    """
    for folder in _absolute(os.environ.get("PATH", os.defpath)):
        for ending in _ENDINGS:
            path = Path(folder, name + ending)
            if path.is_file() and os.access(path, os.X_OK):
                return str(path)
    return None


def python(module: str, *words: str) -> list[str]:
    """The words that run a module with this Python.

    :raises InputError: its program is not known, as in some hosts that embed it
    """
    if not Path(sys.executable or "").is_absolute():
        raise InputError("Python", f"its program is not known ({sys.executable!r}), expected an absolute path")
    return [sys.executable, "-P", "-m", module, *words]


def remote_python() -> str:
    """The start of a shell's line that runs modules with this Python on another host."""
    return f"{shlex.quote(sys.executable)} -P"


def environment(more: Mapping[str, str] | None = None) -> dict[str, str]:
    """The variables of a process: those of this one (credentials, proxies, devices, ours) without ways to bring code.

    :param more: values that are set on top
    """
    kept = {name: value for name, value in os.environ.items() if name not in _DROPPED}
    for name in _FOLDERS:
        if name in kept:
            kept[name] = os.pathsep.join(_absolute(kept[name]))
            if not kept[name]:  # an empty list can mean the working folder
                del kept[name]
    return {**kept, "PYTHONSAFEPATH": "1", **(more or {})}


def start(words: Sequence[str], more: Mapping[str, str] | None = None, **pipes: Any) -> subprocess.Popen[bytes]:
    """Start a process.

    :param words: an absolute path of a program, and its arguments
    :param more: variables that are set on top of `environment`
    :param pipes: ``stdin``, ``stdout`` and ``stderr`` as of `subprocess.Popen`
    :raises OSError: it can't be started
    """
    return subprocess.Popen(_checked(words), env=environment(more), cwd=_HERE, **pipes)


def run(words: Sequence[str], *, request: bytes = b"", seconds: float | None) -> subprocess.CompletedProcess[bytes]:
    """What a process answers to a request on its standard input.

    :param words: as in `start`
    :param seconds: it may take; None: as long as it likes
    :raises OSError: it can't be started
    :raises TimeoutExpired: of subprocess, after so many seconds
    """
    return subprocess.run(
        _checked(words), input=request, env=environment(), cwd=_HERE, capture_output=True, timeout=seconds, check=False
    )


def _checked(words: Sequence[str]) -> list[str]:
    if not Path(words[0]).is_absolute():
        raise InputError(words[0], "is no absolute path, expected the program that is meant")
    return [*words]


def _absolute(folders: str) -> list[str]:
    return [folder for folder in folders.split(os.pathsep) if Path(folder).is_absolute()]
