"""Rebuild: an actor's scans to the actor's own neutral and blendshapes."""

from facepipe.processors.rebuild.fit_neutral import FitNeutral, FitNeutralOptions, NeutralFit
from facepipe.processors.rebuild.scan_fit import ScanFit, scan_target
from facepipe.processors.rebuild.template import Template

__all__ = ["FitNeutral", "FitNeutralOptions", "NeutralFit", "ScanFit", "Template", "scan_target"]
