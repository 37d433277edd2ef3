"""Faces fitted to scans: a model's modes, the scan's place and a smooth residual, all solved together."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.geometry.registration.options import RegistrationOptions
    from facepipe.geometry.registration.solve import register, register_together
    from facepipe.geometry.registration.surface import Anchors, DeformableSurface, Shown
    from facepipe.geometry.registration.target import ScanTarget
    from facepipe.geometry.registration.view import Registered, View
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "Anchors",
    "DeformableSurface",
    "Registered",
    "RegistrationOptions",
    "ScanTarget",
    "Shown",
    "View",
    "register",
    "register_together",
]
