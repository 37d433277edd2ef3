"""Cooking: recipes evaluated again where their sources changed."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.cooking.cooking import cook
    from facepipe.cooking.report import CookOptions, CookReport, NodeReport
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["CookOptions", "CookReport", "NodeReport", "cook"]
