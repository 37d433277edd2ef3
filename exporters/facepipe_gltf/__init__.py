"""glTF 2.0 writer: a face as .glb, or as .gltf with its buffer and images beside."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe_gltf.document import Document, write
    from facepipe_gltf.options import Options
    from facepipe_gltf.validation import validate
    from facepipe_gltf.writer import export, outputs, save
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["Document", "Options", "export", "outputs", "save", "validate", "write"]
