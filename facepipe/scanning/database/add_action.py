"""Put more faces into a database, in place and whole or not at all; -o writes another file.

Changes of one database wait for each other. A rebuilt face is refused whose measures, in its recipe or in a report
given by --quality, miss the limits below. A report is a JSON object, alone or under "quality": {"surface_mean_mm": 0.1,
"surface_p95_mm": 0.4, "coverage": 0.9, "flipped_triangles": 0}.

examples:
  facepipe database add faces.fpdb actor.usdc
  facepipe database add faces.fpdb actor.usdc --quality report.json -o more.fpdb
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError
from facepipe.declare import source
from facepipe.kinds import InPlaceAction, Job, action
from facepipe.scanning.database.database_report import DatabaseReport, report_of
from facepipe.scanning.database.options import AddOptions, FaceNames

if TYPE_CHECKING:
    from facepipe.scanning.database.options import Quality

_MOST_REPORT = 1 << 26  # bytes of a report


def _report_file(word: str) -> tuple[str, str]:
    """The file of REPORT or NAME=REPORT, and the name."""
    name, equals, file = word.partition("=")
    return (file, name) if equals else (word, "")


@action("database add", "put more faces into a database")
@dataclass(frozen=True, kw_only=True)
class AddToDatabase(FaceNames, AddOptions, InPlaceAction[DatabaseReport]):
    """The action (`add_faces`)."""

    suffixes = (".fpdb",)

    database: Path = source("database: .fpdb")
    faces: tuple[Path, ...] = source("face stages of one topology", metavar="FACE")
    quality: tuple[str, ...] = source(
        "measures of a face: a JSON report, with several faces NAME=REPORT, once for each",
        default=(),
        flag="--quality",
        metavar="REPORT",
        split=_report_file,
        kept=False,
    )

    def write(self, job: Job) -> DatabaseReport:
        from facepipe.scanning.database.changes import add_faces, stage_sources
        from facepipe.scanning.database.database_file import load_database, save_database

        database = load_database(self.database)
        sources = stage_sources(self.faces, self.names, database, str(self.database))
        from facepipe.core.reading import read_json
        from facepipe.scanning.database.options import quality_from

        qualities: dict[str, Quality] = {}
        for word in self.quality:
            file, name = _report_file(word)
            if not name and len(sources) != 1:
                raise InputError(f"--quality {word}", f"{len(sources)} faces, expected NAME=REPORT")
            name = name or sources[0].name
            if name in qualities:
                raise InputError(f"--quality {word}", f"a report of '{name}' twice, expected one")
            qualities[name] = quality_from(read_json(Path(file), _MOST_REPORT), file)
        for face in sources:
            if face.name not in qualities:
                try:
                    measures = face.quality()
                except InputError:
                    if not self.ignore_quality:
                        raise
                    measures = None
                qualities |= {} if measures is None else {face.name: measures}
        with job.watch("add", 2 * len(sources)) as bar:
            made = add_faces(database, sources, self, qualities=qualities, done=bar.update)
        save_database(made.database, job.out)
        return report_of(made.database, made.warnings)
