"""What people's heads differ in, and what goes with the skin of a person: eyeballs, lids, the inside of the mouth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.threads import one_thread
from facepipe.heads.assembly import blendshapes_of, make_head
from facepipe.heads.asset import asset
from facepipe.heads.part_fits import fit_eyes, fit_mouth
from facepipe.parts import FaceParts

BLINKS = ("eyeBlinkLeft", "eyeBlinkRight")


@one_thread()
def average() -> FaceParts:
    """The bare average head, without materials."""
    return make_head(np.zeros(len(asset().modes)))


def modes() -> FloatArray:
    """(m, n, 3) offsets in centimetres of a standard deviation each, of all meshes' points one after another."""
    return np.asarray(asset().modes, dtype=np.float64)


@one_thread()
def with_parts_fitted(points: FloatArray) -> FloatArray:
    """Points (n, 3) of a person in centimetres, with eyeballs that fit the lids, a mouth's inside behind the skin."""
    return fit_eyes(fit_mouth(points), asset().shapes)[0]


@one_thread()
def with_own_blinks(parts: FaceParts, points: FloatArray) -> FaceParts:
    """A face of the built-in head's topology, whose blinks close the lids of points (n, 3), in centimetres."""
    shapes = fit_eyes(points, asset().shapes)[1]
    own = {name: shapes[name] for name in BLINKS}
    meshes = []
    for mesh in parts.meshes:
        part = asset().parts.get(mesh.name)
        blinks = {} if part is None else {shape.name: shape for shape in blendshapes_of(part, own)}
        meshes.append(replace(mesh, blendshapes=tuple(blinks.get(shape.name, shape) for shape in mesh.blendshapes)))
    return replace(parts, meshes=tuple(meshes))
