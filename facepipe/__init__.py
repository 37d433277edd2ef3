"""facepipe: face assets from a DCC to a game engine.

    face = facepipe.read("head.glb")                  # a `Face`, the typed view of a USD stage
    facepipe.fit_bones("head.usdc", targets=["smile.usda"], out="fitted.usdc")
    facepipe.export("fitted.usdc", "fitted.glb")

Every action of the command line is a function here: `facepipe blend` is `facepipe.blend`, `facepipe fit-bones`
`facepipe.fit_bones`, with its sources and options as arguments.
"""

from typing import TYPE_CHECKING

import facepipe_schemas as facepipe_schemas  # registers them: before USD is in use, where the host hasn't used it yet

from facepipe import former_names
from facepipe.core import __version__ as __version__
from facepipe.core.loading import lazy

if TYPE_CHECKING:  # of which `lazy` knows; type checkers read __init__.pyi, which is made of it and of the actions
    from facepipe.api import read, sample
    from facepipe.checks import validate
    from facepipe.cooking.cooking import cook
    from facepipe.core.errors import ExportError, FacepipeError, FitError, InputError, SchemaError, TopologyError
    from facepipe.exporting import export
    from facepipe.stage.face import Face
    from facepipe.stage.face import open_face as open
else:
    former_names.install()
    __getattr__, __dir__ = lazy(__name__, "facepipe.api")

__all__ = [
    "ExportError",
    "Face",
    "FacepipeError",
    "FitError",
    "InputError",
    "SchemaError",
    "TopologyError",
    "batch",
    "cook",
    "export",
    "open",
    "read",
    "sample",
    "validate",
]
