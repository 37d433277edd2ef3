"""glTF 2.0 files as faces: the importer ``gltf``."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe_gltf.read.face import read
    from facepipe_gltf.read.file_contents import contents
    from facepipe_gltf.read.options import Options
else:
    __getattr__, __dir__ = lazy(__name__)

SUFFIXES = (".glb", ".gltf", ".vrm")
__all__ = ["SUFFIXES", "Options", "contents", "read"]
