"""Pictures of faces on a headless CPU."""

from facepipe.render.heatmap import HeatMap
from facepipe.render.picture import PictureOptions, picture, save_png
from facepipe.render.regions import RegionColors
from facepipe.render.sheet import contact_sheet

__all__ = ["HeatMap", "PictureOptions", "RegionColors", "contact_sheet", "picture", "save_png"]
