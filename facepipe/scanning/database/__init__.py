"""Collect faces of one topology: models of what people's neutrals and expressions differ in.

examples:
  facepipe database create faces/*.usda -o faces.fpdb
  facepipe database add faces.fpdb actor.usdc
  facepipe database remove faces.fpdb actor
  facepipe database info faces.fpdb --json

`facepipe database ACTION --help` shows options.
"""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.scanning.database.changes import add_faces, create_database, remove_faces
    from facepipe.scanning.database.database_file import load_database, save_database
    from facepipe.scanning.database.face_database import (
        FaceDatabase,
        Update,
        carried_mean,
        predicted_shapes,
    )
    from facepipe.scanning.database.options import (
        AddOptions,
        DatabaseOptions,
        Quality,
        QualityLimits,
        misses,
        quality_from,
    )
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "AddOptions",
    "DatabaseOptions",
    "FaceDatabase",
    "Quality",
    "QualityLimits",
    "Update",
    "add_faces",
    "carried_mean",
    "create_database",
    "load_database",
    "misses",
    "predicted_shapes",
    "quality_from",
    "remove_faces",
    "save_database",
]
