"""FBX files as faces: the importer ``fbx``."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.importers.fbx.face import read
    from facepipe.importers.options import FbxOptions as Options
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["Options", "read"]
