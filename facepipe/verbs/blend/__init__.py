"""Blend: faces of one topology mixed in the gradient domain, with regions, expressions and rig."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.verbs.blend.blend import BlendFaces
    from facepipe.verbs.blend.matching import MatchReport, match
    from facepipe.verbs.blend.options import BlendOptions
    from facepipe.verbs.blend.quality import BlendReport
    from facepipe.verbs.blend.result import Blend
    from facepipe.verbs.blend.session import BlendSession
    from facepipe.verbs.blend.weights import Weights
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
