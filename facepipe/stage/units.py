"""Units and axes of a stage."""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdGeom

from facepipe.errors import SchemaError

_LEAST, _LARGEST = 1e-9, 1e9  # metres


def check_units(where: object, stage: Usd.Stage) -> None:
    """:raises SchemaError: a unit that is no length, or an up axis that is neither Y nor Z"""
    unit, up = float(UsdGeom.GetStageMetersPerUnit(stage)), str(UsdGeom.GetStageUpAxis(stage))
    if not (np.isfinite(unit) and _LEAST <= unit <= _LARGEST):
        raise SchemaError(where, f"metersPerUnit {unit:g}, expected a length above 0")
    if up not in ("Y", "Z"):
        raise SchemaError(where, f"upAxis '{up}', expected Y or Z")
