"""Make a database of two or more face stages of one topology.

It holds a model of neutrals (principal components) and one of expressions (a multilinear model) of the blendshapes that
all faces have that have any; others are listed as left out.

example: facepipe database create faces/*.usda -o faces.fpdb
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from facepipe.declare import source
from facepipe.kinds import FileAction, Job, action
from facepipe.scanning.database.database_report import DatabaseReport, report_of
from facepipe.scanning.database.options import DatabaseOptions, FaceNames


@action("database create", "make a database of face stages")
@dataclass(frozen=True, kw_only=True)
class CreateDatabase(FaceNames, DatabaseOptions, FileAction[DatabaseReport]):
    """The action (`create_database`)."""

    output = "database to write: .fpdb"
    suffixes = (".fpdb",)
    alone = True

    faces: tuple[Path, ...] = source("face stages of one topology", metavar="FACE")

    def write(self, job: Job) -> DatabaseReport:
        from facepipe.scanning.database.changes import create_database, stage_sources
        from facepipe.scanning.database.database_file import save_database

        sources = stage_sources(self.faces, self.names)
        with job.watch("create", 2 * len(sources)) as bar:
            made = create_database(sources, self, done=bar.update)
        save_database(made.database, job.out)
        return report_of(made.database, made.warnings)
