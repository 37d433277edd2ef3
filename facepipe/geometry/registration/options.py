"""Options of registration, in a module without numpy: actions declare them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RegistrationOptions:
    """Expected errors and weights of a registration's terms."""

    surface_sigma_mm: float = 0.3  # of the distances from the scan; matches count by area over its square
    huber_mm: float = 0.3  # distances beyond count linearly
    reach_mm: float = 4.0  # matches further off are dropped, in the last stage
    angle: float = 0.84  # radians between normals, beyond which a match is dropped
    anchor_sigma_mm: float = 0.16  # of landmarks and markers
    membrane: float = 6.0  # stiffness of the residual
    scale: bool = True  # the scan's size is not known
