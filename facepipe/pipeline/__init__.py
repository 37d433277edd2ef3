"""Pipeline: recipes evaluated again where their sources changed. What hosts call, beside the registry."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.pipeline.cooking import cook
    from facepipe.pipeline.options import CookOptions
    from facepipe.pipeline.report import CookReport, NodeReport
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["CookOptions", "CookReport", "NodeReport", "cook"]
