"""Sliders of a face: authored from tables, made from its blendshapes, learned by a small network, and set."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.verbs.sliders.author_sliders import (
        AuthorNetwork,
        AuthorNetworkReport,
        AuthorSliders,
        AuthorSlidersReport,
        SetSliders,
        SetSlidersReport,
    )
    from facepipe.verbs.sliders.distil import DistilReport, DistilSliders
    from facepipe.verbs.sliders.from_shapes import MadeSlider, ShapeSlidersReport, SlidersFromShapes
    from facepipe.verbs.sliders.options import ShapeSliderOptions
    from facepipe.verbs.sliders.sliders import SlidersOfFace
    from facepipe.verbs.sliders.tables import Drive, SliderRule, SliderTable, read_table
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "AuthorNetwork",
    "AuthorNetworkReport",
    "AuthorSliders",
    "AuthorSlidersReport",
    "DistilReport",
    "DistilSliders",
    "Drive",
    "MadeSlider",
    "SetSliders",
    "SetSlidersReport",
    "ShapeSliderOptions",
    "ShapeSlidersReport",
    "SliderRule",
    "SliderTable",
    "SlidersFromShapes",
    "SlidersOfFace",
    "read_table",
]
