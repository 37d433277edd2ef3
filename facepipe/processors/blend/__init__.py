"""Blend: faces of one topology mixed in the gradient domain, with regions, expressions and rig."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.processors.blend.blend_action import BlendFaces
    from facepipe.processors.blend.matching import MatchReport, match
    from facepipe.processors.blend.options import BlendOptions
    from facepipe.processors.blend.quality import BlendReport
    from facepipe.processors.blend.result import Blend
    from facepipe.processors.blend.session import BlendSession
    from facepipe.processors.blend.weights import Weights
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "Blend",
    "BlendFaces",
    "BlendOptions",
    "BlendReport",
    "BlendSession",
    "MatchReport",
    "Weights",
    "match",
]
