"""The built-in head: a real one, of ICT-FaceKit and MakeHuman, and people drawn from it.

`make` is the entry. `samples/head/build.py` makes the package data; `asset` reads it, and `assembly` puts a face
together.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.heads.assembly import make
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["make"]
