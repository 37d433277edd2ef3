"""Pipeline: recipes evaluated again where their sources changed. What hosts call, beside the registry."""

from facepipe.pipeline.cooking import cook
from facepipe.pipeline.options import CookOptions
from facepipe.pipeline.report import CookReport, NodeReport

__all__ = ["CookOptions", "CookReport", "NodeReport", "cook"]
