"""Rebuild: an actor's scans to the actor's own neutral and blendshapes."""

from facepipe.processors.rebuild.composites import DEFAULT_COMPOSITES, resolved
from facepipe.processors.rebuild.fit_neutral import FitNeutral, FitNeutralOptions, NeutralFit, NeutralReport
from facepipe.processors.rebuild.personal_template import PersonalTemplate, PersonalTemplateOptions
from facepipe.processors.rebuild.project import Project, ProjectScan, read_project
from facepipe.processors.rebuild.rebuild import Readers, Rebuild, Rebuilt
from facepipe.processors.rebuild.register_scans import (
    Composite,
    CompositeReport,
    ExpressionScan,
    NeutralScan,
    RegisteredComposite,
    RegisterScans,
    RegisterScansOptions,
)
from facepipe.processors.rebuild.scan_fit import ScanFit
from facepipe.processors.rebuild.split_expressions import (
    ShapeReport,
    SplitExpressions,
    SplitExpressionsOptions,
    SplitFit,
    SplitReport,
)
from facepipe.processors.rebuild.template import Template

__all__ = [
    "DEFAULT_COMPOSITES",
    "Composite",
    "CompositeReport",
    "ExpressionScan",
    "FitNeutral",
    "FitNeutralOptions",
    "NeutralFit",
    "NeutralReport",
    "NeutralScan",
    "PersonalTemplate",
    "PersonalTemplateOptions",
    "Project",
    "ProjectScan",
    "Readers",
    "Rebuild",
    "Rebuilt",
    "RegisterScans",
    "RegisterScansOptions",
    "RegisteredComposite",
    "ScanFit",
    "ShapeReport",
    "SplitExpressions",
    "SplitExpressionsOptions",
    "SplitFit",
    "SplitReport",
    "Template",
    "read_project",
    "resolved",
]
