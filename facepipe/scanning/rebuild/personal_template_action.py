"""Make a person's starting shapes: those of a database or of the template, carried to the person's neutral.

NEUTRAL is a face stage of `facepipe fit-neutral`, corrected by hand or not, on the topology of --template. Shapes come
from --database, as its mean person has them and its people have in common, where it has expressions; else from the
template, by deformation transfer. OUT is an override layer over NEUTRAL; shapes that the database lacks stay as they
are. --flatten writes a standalone file.

examples:
  facepipe personal-template anna.usdc --template head.usdc --database faces.fpdb -o personal.usdc
  facepipe personal-template anna.usdc --template head.usdc --shapes-from template -o personal.usdc
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.reports import table
from facepipe.declare import source
from facepipe.kinds import Job, StageAction, action
from facepipe.scanning.rebuild.declared import PersonalTemplateOptions

if TYPE_CHECKING:
    from facepipe.scanning.rebuild.personal_template import PersonalReport
    from facepipe.stage import Face


@action("personal-template", "make a person's starting shapes")
@dataclass(frozen=True, kw_only=True)
class PersonalTemplateAction(PersonalTemplateOptions, StageAction["PersonalReport"]):
    """The action."""

    neutral: Path = source("face stage with the person's neutral")
    template: Path = source("face stage that NEUTRAL was fitted with", flag="--template", metavar="FACE")
    database: Path | None = source(
        "faces of the template's topology: .fpdb", default=None, flag="--database", metavar="FPDB"
    )

    def author(self, face: Face, job: Job) -> PersonalReport:
        from facepipe.importers import read_face
        from facepipe.kinds import found_of
        from facepipe.scanning.database import load_database
        from facepipe.scanning.rebuild.personal_template import author_personal, starting_names
        from facepipe.scanning.rebuild.template import Template

        template = Template.of(read_face(self.template).parts(), str(self.template))
        database = None if self.database is None else load_database(self.database)
        before = found_of(face.parts().recipe)  # measures for the quality gate of a database stay
        recipe = job.recipe(**{name: before[name] for name in ("quality",) if name in before})
        with job.watch("shapes", len(starting_names(template, database, self))) as bar:
            return author_personal(face, template, database, self, recipe, bar.update)

    def text(self, report: PersonalReport, out: Path) -> str:
        rows = [
            ("shapes", f"{len(report.motion_mm)}, {report.source}"),
            ("largest motion", f"{max(report.motion_mm.values()):.1f} mm"),
            ("from the template's", f"mean {report.change_mean_mm:.2f} mm, over what they move"),
        ]
        return "\n".join([str(out), table(rows)])
