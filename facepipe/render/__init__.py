"""Pictures of faces on a headless CPU."""

from facepipe.render.heatmap import HeatMap
from facepipe.render.photo_sheet import PhotoSheet, SheetPhoto, photo_sheet
from facepipe.render.picture import PictureOptions, picture, save_png
from facepipe.render.regions import RegionColors
from facepipe.render.sheet import contact_sheet

__all__ = [
    "HeatMap",
    "PhotoSheet",
    "PictureOptions",
    "RegionColors",
    "SheetPhoto",
    "contact_sheet",
    "photo_sheet",
    "picture",
    "save_png",
]
