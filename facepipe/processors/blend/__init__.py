"""Blend: faces of one topology mixed in the gradient domain, with regions, expressions and rig."""

from facepipe.processors.blend.blend import Blend
from facepipe.processors.blend.options import BlendOptions
from facepipe.processors.blend.quality import BlendReport
from facepipe.processors.blend.session import BlendSession
from facepipe.processors.blend.weights import Weights

__all__ = ["Blend", "BlendOptions", "BlendReport", "BlendSession", "Weights"]
