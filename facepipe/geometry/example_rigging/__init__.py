"""Example-based facial rigging: a person's own shapes from scans of composites (Li, Weise & Pauly, SIGGRAPH 2010)."""

from facepipe.geometry.example_rigging.options import SplitOptions
from facepipe.geometry.example_rigging.split import Split, split_shapes
from facepipe.geometry.example_rigging.telling import RankReport

__all__ = ["RankReport", "Split", "SplitOptions", "split_shapes"]
