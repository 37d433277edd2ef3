"""Faces fitted to scans: a model's modes, the scan's place and a smooth residual, all solved together."""

from facepipe.geometry.registration.anchors import Anchors
from facepipe.geometry.registration.register import Registered, RegistrationOptions, register
from facepipe.geometry.registration.surface import DeformableSurface
from facepipe.geometry.registration.target import ScanTarget

__all__ = ["Anchors", "DeformableSurface", "Registered", "RegistrationOptions", "ScanTarget", "register"]
