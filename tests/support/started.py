"""Who starts processes: an audit hook refuses those that facepipe starts past `facepipe.core.policy.children`."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import FrameType

import facepipe
from facepipe.core.policy import children

_EVENTS = {"subprocess.Popen", "os.exec", "os.posix_spawn", "os.spawn", "os.system", "os.startfile"}
_CODE = Path(facepipe.__file__).parents[1]
_OURS = tuple(f"{_CODE / room}{os.sep}" for room in ("facepipe", "exporters", "schemas"))
_BUILDS = ("build.py", "hatch_hook.py", "generate.py")  # scripts that build the house
started: list[str] = []  # programs that the helper has started


class StartedPastTheHelperError(Exception):
    """A process that is started elsewhere."""


def watch() -> None:
    """From now on, for this process."""
    sys.addaudithook(_on_event)


def _on_event(event: str, arguments: tuple[object, ...]) -> None:
    if event not in _EVENTS:
        return
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        file = frame.f_code.co_filename
        if file == children.__file__:
            started.append(str(arguments[0]))
            return
        if file.startswith(_OURS) and not file.endswith(_BUILDS):
            raise StartedPastTheHelperError(f"{event} of {arguments[:2]} in {file}:{frame.f_lineno}")
        frame = frame.f_back
