"""Faces of other tools' UsdSkel stages.

What such a stage leaves out or does differently is mended in its session layer, which is never saved; then the
readers of our own stages read it.
"""

from facepipe.stage.foreign.read import Foreign, read_foreign

__all__ = ["Foreign", "read_foreign"]
