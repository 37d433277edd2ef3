"""Build hook of wheels: the page is built into them. In editable installs `python -m facepipe_web.build` builds it."""

from __future__ import annotations

import runpy
import shutil
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class WebBuildHook(BuildHookInterface):  # type: ignore[misc]  # hatchling is there while a wheel is built
    """Runs `build.py` before a wheel is packed."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build where it is needed; a machine without node makes a wheel without the viewer, and says so."""
        if version == "editable":
            return
        builder = runpy.run_path(str(Path(self.root) / "exporters" / "facepipe_web" / "build.py"))
        if builder["is_built"]():
            return
        if shutil.which("npm") is None:
            self.app.display_warning("facepipe view is left out of this wheel: it needs node 20 and npm")
            return
        builder["build"]()
