"""Textures from photos: the photos' colours, without their light, on a fitted face."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.photo.texture.author import BakePhotoReport
    from facepipe.photo.texture.bake_photo_action import BakePhoto
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["BakePhoto", "BakePhotoReport"]
