"""Animate: a performance that was captured of a person, as a clip of a face."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.verbs.animate.animate import Animate
    from facepipe.verbs.animate.clip_files import read_performance
    from facepipe.verbs.animate.face_clip import AnimateFace, AnimateReport
    from facepipe.verbs.animate.options import AnimateOptions
    from facepipe.verbs.animate.performance import Performance
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["Animate", "AnimateFace", "AnimateOptions", "AnimateReport", "Performance", "read_performance"]
