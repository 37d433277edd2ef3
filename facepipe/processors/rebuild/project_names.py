"""Names in a project that its template and database have or have not."""

from __future__ import annotations

from facepipe.processors.database import FaceDatabase
from facepipe.processors.rebuild.composites import resolved
from facepipe.processors.rebuild.personal_template import PersonalTemplate
from facepipe.processors.rebuild.project import Project, ProjectScan
from facepipe.processors.rebuild.region_weights import region_weights
from facepipe.processors.rebuild.template import Template


def check_names(project: Project, template: Template, database: FaceDatabase) -> None:
    """All regions and shapes that a project names are there: asked before the first fit, as fits take minutes.

    :raises FacepipeError: one that is not, or a database that starting shapes can't come from
    """
    if project.refinement is not None:
        region_weights(template.parts, project.refinement.regions, f"{project.path} -> options.refinement")
    shapes = PersonalTemplate(options=project.template_options).names(template, database)
    for scan in project.expressions:
        expression_weights(project, scan, shapes)


def expression_weights(project: Project, scan: ProjectScan, shapes: tuple[str, ...]) -> dict[str, float]:
    """Weights of an expression by the names of the personal template's `shapes`.

    :raises InputError: a shape that is not there
    """
    return resolved(scan.weights, shapes, f"{project.path} -> expressions -> {scan.name} -> weights")
