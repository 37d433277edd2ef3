"""Faces fitted to scans: a model's modes, the scan's place and a smooth residual, all solved together."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.geometry.options import RegistrationOptions
    from facepipe.geometry.registration.solve import STAGES, Stage, register, register_together
    from facepipe.geometry.registration.step import Registered, View
    from facepipe.geometry.registration.surface import Anchors, DeformableSurface, ScanTarget, Shown
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "STAGES",
    "Anchors",
    "DeformableSurface",
    "Registered",
    "RegistrationOptions",
    "ScanTarget",
    "Shown",
    "Stage",
    "View",
    "register",
    "register_together",
]
