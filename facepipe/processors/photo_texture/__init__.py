"""Textures from photos: the photos' colours, without their light, on a fitted face."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.processors.photo_texture.author import hide_brow_cards
    from facepipe.processors.photo_texture.bake import Baker
    from facepipe.processors.photo_texture.bake_photo_action import BakePhoto
    from facepipe.processors.photo_texture.evened import inner, missed_light, one_sided
    from facepipe.processors.photo_texture.observed import DARKEST, Observed
    from facepipe.processors.photo_texture.report import BakePhotoReport
    from facepipe.processors.photo_texture.seen_skin import step
    from facepipe.processors.photo_texture.skin_surface import SkinSurface, skin_of
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "DARKEST",
    "BakePhoto",
    "BakePhotoReport",
    "Baker",
    "Observed",
    "SkinSurface",
    "hide_brow_cards",
    "inner",
    "missed_light",
    "one_sided",
    "skin_of",
    "step",
]
