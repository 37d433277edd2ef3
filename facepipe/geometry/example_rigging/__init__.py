"""Example-based facial rigging: a person's own shapes from scans of composites (Li, Weise & Pauly, SIGGRAPH 2010)."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.geometry.example_rigging.split import Split, split_shapes
    from facepipe.geometry.options import SplitOptions
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["Split", "SplitOptions", "split_shapes"]
