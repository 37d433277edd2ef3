"""facepipe: face assets from a DCC to a game engine.

``facepipe.open(path)`` gives a `Face`, the typed view of a USD stage.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import facepipe_schemas as facepipe_schemas  # registers them: before USD is in use, where the host hasn't used it yet

if TYPE_CHECKING:
    from facepipe.stage import Face

__version__ = "0.1.0"


def open(path: str | os.PathLike[str]) -> Face:
    """Open the face of a USD file.

    :raises facepipe.errors.InputError: no such file, or no readable USD
    :raises facepipe.errors.SchemaError: a stage without a face
    """
    from facepipe.stage import open_face

    return open_face(path)
