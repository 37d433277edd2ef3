"""facepipe: face assets from a DCC to a game engine.

``facepipe.open(path)`` gives a `Face`, the typed view of a USD stage.
"""

from typing import TYPE_CHECKING

import facepipe_schemas as facepipe_schemas  # registers them: before USD is in use, where the host hasn't used it yet

from facepipe.core.loading import keep_old_names, lazy

if TYPE_CHECKING:
    from facepipe.stage.face import open_face as open
else:
    __getattr__, __dir__ = lazy(__name__)

keep_old_names()

__all__ = ["open"]
__version__ = "0.1.0"
