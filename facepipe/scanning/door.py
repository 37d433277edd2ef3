"""What others do with databases of faces, found by name: `facepipe.registry.Databases`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from facepipe.scanning.database import FaceDatabase

NAME = "databases"
FORMER = {
    "facepipe.processors.clean_scan": ("facepipe.scanning.clean_scan",),
    "facepipe.processors.database": ("facepipe.scanning.database", "facepipe.verbs.whole_faces"),
    "facepipe.processors.rebuild": ("facepipe.scanning.rebuild", "facepipe.verbs.author_neutral"),
    "facepipe.processors.rebuild.author_neutral": ("facepipe.verbs.author_neutral",),
    "facepipe.processors.scan_landmarks": ("facepipe.scanning.landmarks",),
    "facepipe.processors.scan_photos": ("facepipe.scanning.photos",),
    "facepipe.processors.scan_texture": ("facepipe.scanning.texture",),
}


def load(path: Path) -> FaceDatabase:
    """The faces in a file.

    :raises InputError: no database
    """
    from facepipe.scanning.database import load_database

    return load_database(path)
