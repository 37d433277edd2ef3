"""VRM 1.0 writer: a face as an avatar's head, one .vrm file."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe_gltf.vrm.options import Options
    from facepipe_gltf.vrm.validation import validate
    from facepipe_gltf.vrm.writer import export, outputs
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["Options", "export", "outputs", "validate"]
