"""Faces of other tools' UsdSkel stages.

What such a stage leaves out or does differently is repaired in its session layer, which is never saved; then the
readers of facepipe's own stages read it.
"""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.stage.foreign.read import read_foreign
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["read_foreign"]
