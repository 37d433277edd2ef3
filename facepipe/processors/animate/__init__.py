"""Animate: a performance that was captured of a person, as a clip of a face."""

from facepipe.processors.animate.animate import AnimateFace, AnimateReport
from facepipe.processors.animate.options import AnimateOptions
from facepipe.processors.animate.performance import Performance
from facepipe.processors.animate.read import read_performance

__all__ = ["AnimateFace", "AnimateOptions", "AnimateReport", "Performance", "read_performance"]
