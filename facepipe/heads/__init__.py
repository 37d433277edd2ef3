"""The built-in sample: a procedural human head with eyes, teeth, shapes, skin, regions and landmarks.

`make` is the entry; each module makes one kind of part. Everything is computed from formulas and the tables in these
modules: no scan or model of anyone is in it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.heads.build import make
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["make"]
