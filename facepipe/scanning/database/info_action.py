"""List what is in a database: who, since when, how exactly, and how it came to be.

example: facepipe database info faces.fpdb --json
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from facepipe.core.reports import Watch
from facepipe.declare import source
from facepipe.kinds import Inspector, action
from facepipe.scanning.database.database_report import DatabaseReport, report_of


@dataclass(frozen=True, kw_only=True)
class DatabaseInfoReport(DatabaseReport):
    """What is in a database, and its file."""

    path: Path
    bytes: int


@action("database info", "list what is in a database")
@dataclass(frozen=True, kw_only=True)
class DatabaseInfo(Inspector[DatabaseInfoReport]):
    """The action."""

    database: Path = source("database: .fpdb")

    def look(self, watch: Watch) -> DatabaseInfoReport:
        from facepipe.scanning.database.database_file import load_database

        found = report_of(load_database(self.database))
        return DatabaseInfoReport(**vars(found), path=self.database, bytes=self.database.stat().st_size)
