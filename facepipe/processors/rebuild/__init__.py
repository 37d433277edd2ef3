"""Rebuild: an actor's scans to the actor's own neutral and blendshapes."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.processors.rebuild.author_neutral import AuthorNeutral
    from facepipe.processors.rebuild.composites import DEFAULT_COMPOSITES, resolved
    from facepipe.processors.rebuild.fit_neutral import FitNeutral, NeutralFit, NeutralReport
    from facepipe.processors.rebuild.fit_together import FitTogether, PlacedExpression, TogetherFit
    from facepipe.processors.rebuild.options import (
        BakeScanOptions,
        FitNeutralOptions,
        PersonalTemplateOptions,
        RefineNeutralOptions,
        RegisterScansOptions,
        SplitExpressionsOptions,
    )
    from facepipe.processors.rebuild.personal_template import PersonalTemplate
    from facepipe.processors.rebuild.project import Project, ProjectScan, read_project
    from facepipe.processors.rebuild.rebuild import Rebuild, Rebuilt
    from facepipe.processors.rebuild.refine_neutral import RefinedNeutral, RefineNeutral, RefineReport
    from facepipe.processors.rebuild.register_scans import (
        Composite,
        CompositeReport,
        ExpressionScan,
        NeutralScan,
        RegisteredComposite,
        RegisterScans,
    )
    from facepipe.processors.rebuild.scan_fit import ScanFit
    from facepipe.processors.rebuild.split_expressions import ShapeReport, SplitExpressions, SplitFit, SplitReport
    from facepipe.processors.rebuild.template import Template
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "DEFAULT_COMPOSITES",
    "AuthorNeutral",
    "BakeScanOptions",
    "Composite",
    "CompositeReport",
    "ExpressionScan",
    "FitNeutral",
    "FitNeutralOptions",
    "FitTogether",
    "NeutralFit",
    "NeutralReport",
    "NeutralScan",
    "PersonalTemplate",
    "PersonalTemplateOptions",
    "PlacedExpression",
    "Project",
    "ProjectScan",
    "Rebuild",
    "Rebuilt",
    "RefineNeutral",
    "RefineNeutralOptions",
    "RefineReport",
    "RefinedNeutral",
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
    "TogetherFit",
    "read_project",
    "resolved",
]
