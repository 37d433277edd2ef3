"""A small procedural head with eyes, teeth, shapes, skin, regions and landmarks: what unit tests need a whole face for.

`make` is the entry; each module makes one kind of part, of formulas and tables. Seeds give people on one topology.
"""

from __future__ import annotations

from procedural_head.build import make

__all__ = ["make"]
