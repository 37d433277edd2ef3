"""Sliders of a face: authored from tables, and set."""

from facepipe.processors.sliders.author_sliders import AuthorSliders, AuthorSlidersReport
from facepipe.processors.sliders.recipe import SliderRecipe, read_slider_recipe, slider_recipe
from facepipe.processors.sliders.rules import Drive, SliderRule
from facepipe.processors.sliders.set_sliders import SetSliders, SetSlidersReport
from facepipe.processors.sliders.tables import SliderTable, read_table

__all__ = [
    "AuthorSliders",
    "AuthorSlidersReport",
    "Drive",
    "SetSliders",
    "SetSlidersReport",
    "SliderRecipe",
    "SliderRule",
    "SliderTable",
    "read_slider_recipe",
    "read_table",
    "slider_recipe",
]
