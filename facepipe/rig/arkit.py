"""The names of ARKit's 52 face shapes, as a face's expressions are called where they mean those (DESIGN section 4)."""

from __future__ import annotations

from facepipe.rig.conventions import CONVENTIONS

ARKIT_SHAPES = frozenset(CONVENTIONS["arkit"].written)
