"""What counts how much in a registration: without numpy, since actions declare it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RegistrationOptions:
    """What counts how much."""

    surface_sigma_mm: float = 0.3  # of the distances from the scan; matches count by area over its square
    huber_mm: float = 0.3  # distances beyond count linearly
    reach_mm: float = 4.0  # matches further off don't count, in the last stage
    angle: float = 0.84  # radians between normals, beyond which a match doesn't count
    anchor_sigma_mm: float = 0.16  # of landmarks and markers
    membrane: float = 6.0  # stiffness of the residual
    scale: bool = True  # the scan's size is not known
