"""Web: faces in a browser. A runtime module for game pages and tools (`src/runtime`), and a viewer served from here.

`view` serves the viewer's page for a face; `facepipe_web.build` makes what it serves. Nothing comes from other hosts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe_web.build import page_files
    from facepipe_web.options import Options
    from facepipe_web.viewer import Viewer, view, write_assets
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["Options", "Viewer", "page_files", "view", "write_assets"]
