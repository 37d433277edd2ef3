"""What a rig must have for its bones to be fitted, and what of it formats can't hold."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.parts import FaceParts
from facepipe.processors.same_topology import check_invertible, check_spaces
from facepipe.rig import Rig
from facepipe.rig.trs import decompose

_EVEN = 1e-4  # scales that differ less, relative to the largest, are the same
_SHOWN = 4  # names of a list


def check_rig(where: str, parts: FaceParts, rig: Rig) -> None:
    """Check that bones move points.

    :raises InputError: no joints, or no point that follows one
    :raises TopologyError: singular bind transforms or spaces
    """
    if not rig.joints:
        raise InputError(where, "has no joints, expected a skinned face (`facepipe skin` makes one)")
    if rig.influences[:, : len(rig.joints)].nnz == 0:
        raise InputError(where, "no point follows a joint, expected a skinned face (`facepipe skin` makes one)")
    rig.require_linear("the fit")
    check_spaces(where, parts)
    for joint, bind, rest in zip(rig.joints, parts.skeleton.bind_transforms, rig.rest, strict=True):
        check_invertible(f"{where} -> {joint}", "bind transform", bind)
        check_invertible(f"{where} -> {joint}", "rest transform", rest)


def rest_shear(rig: Rig) -> list[str]:
    """A warning of joints whose rest scale is not the same in all directions: what turns at or below them shears."""
    scales = np.abs(decompose(rig.rest).scale)
    uneven = np.flatnonzero(scales.max(axis=1) - scales.min(axis=1) > _EVEN * scales.max(axis=1))
    if not len(uneven):
        return []
    names = _some([rig.joints[number] for number in uneven])
    return [f"rest scale of {names} differs by direction: rotations at and below shear, which not every engine keeps"]


def local_shear(rig: Rig, coefficients: FloatArray) -> list[str]:
    """Joints whose local transforms have shear in a frame of (T, m, 9) coefficients; a few names."""
    sheared = np.stack([decompose(rig.local_transforms(one)).sheared for one in coefficients]).any(axis=0)
    names = [rig.joints[number] for number in np.flatnonzero(sheared)]
    return [_some(names)] if names else []


def _some(names: list[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")
