"""Rebuild: an actor's scans to the actor's own neutral and blendshapes."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.scanning.rebuild.declared import FitNeutralOptions, RefineNeutralOptions, RegisterScansOptions
    from facepipe.scanning.rebuild.fit_neutral import FitNeutral, NeutralScan
    from facepipe.scanning.rebuild.personal_template import starting_shapes
    from facepipe.scanning.rebuild.project import Project, ProjectScan, read_project
    from facepipe.scanning.rebuild.rebuild import Rebuild, Rebuilt
    from facepipe.scanning.rebuild.register_scans import Composite, ExpressionScan, fit_together, register_scan
    from facepipe.scanning.rebuild.template import DEFAULT_COMPOSITES, Template, resolved
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "DEFAULT_COMPOSITES",
    "Composite",
    "ExpressionScan",
    "FitNeutral",
    "FitNeutralOptions",
    "NeutralScan",
    "Project",
    "ProjectScan",
    "Rebuild",
    "Rebuilt",
    "RefineNeutralOptions",
    "RegisterScansOptions",
    "Template",
    "fit_together",
    "read_project",
    "register_scan",
    "resolved",
    "starting_shapes",
]
