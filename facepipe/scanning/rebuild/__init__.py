"""Rebuild: an actor's scans to the actor's own neutral and blendshapes."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.scanning.rebuild.fit_neutral import FitNeutral, NeutralFit, NeutralReport
    from facepipe.scanning.rebuild.options import (
        BakeScanOptions,
        FitNeutralOptions,
        PersonalTemplateOptions,
        RefineNeutralOptions,
        RegisterScansOptions,
        SplitExpressionsOptions,
    )
    from facepipe.scanning.rebuild.personal_template import PersonalTemplate
    from facepipe.scanning.rebuild.project import Project, ProjectScan, read_project
    from facepipe.scanning.rebuild.rebuild import Rebuild, Rebuilt
    from facepipe.scanning.rebuild.refine_neutral import RefinedNeutral, RefineNeutral, RefineReport
    from facepipe.scanning.rebuild.register_scans import (
        Composite,
        CompositeReport,
        ExpressionScan,
        FitTogether,
        NeutralScan,
        PlacedExpression,
        RegisteredComposite,
        RegisterScans,
        TogetherFit,
    )
    from facepipe.scanning.rebuild.scan_fit import ScanFit
    from facepipe.scanning.rebuild.split_expressions import ShapeReport, SplitExpressions, SplitFit, SplitReport
    from facepipe.scanning.rebuild.template import DEFAULT_COMPOSITES, Template, resolved
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "DEFAULT_COMPOSITES",
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
