"""Pictures of faces on a headless CPU."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.pictures.face_picture import PictureOptions, picture, poses, save_png
    from facepipe.pictures.overlay import HeatMap, RegionColors, contact_sheet
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["HeatMap", "PictureOptions", "RegionColors", "contact_sheet", "picture", "poses", "save_png"]
