"""Take faces out of a database by their names, in place and whole or not at all; -o writes another file.

Changes of one database wait for each other.

example: facepipe database remove faces.fpdb actor
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from facepipe.declare import source
from facepipe.kinds import InPlaceAction, Job, action
from facepipe.scanning.database.database_report import DatabaseReport, report_of


@action("database remove", "take faces out of a database")
@dataclass(frozen=True, kw_only=True)
class RemoveFromDatabase(InPlaceAction[DatabaseReport]):
    """The action (`remove_faces`)."""

    suffixes = (".fpdb",)

    database: Path = source("database: .fpdb")
    names: tuple[str, ...] = source(
        "names of faces, as info lists them", metavar="NAME", split=lambda name: (None, name)
    )

    def write(self, job: Job) -> DatabaseReport:
        from facepipe.scanning.database.changes import remove_faces
        from facepipe.scanning.database.database_file import load_database, save_database

        made = remove_faces(load_database(self.database), self.names, str(self.database))
        save_database(made.database, job.out)
        return report_of(made.database, made.warnings)
