"""Animate: a performance that was captured of a person, as a clip of a face."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.processors.animate.animate import AnimateFace, AnimateReport
    from facepipe.processors.animate.animate_action import Animate
    from facepipe.processors.animate.clip_files import read_performance
    from facepipe.processors.animate.options import AnimateOptions
    from facepipe.processors.animate.performance import Performance
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["Animate", "AnimateFace", "AnimateOptions", "AnimateReport", "Performance", "read_performance"]
