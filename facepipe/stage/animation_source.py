"""The animation that a skeleton plays, and when."""

from __future__ import annotations

import numpy as np
from pxr import UsdSkel

from facepipe.errors import InputError
from facepipe.parts import FloatArray
from facepipe.stage.face import Face
from facepipe.stage.opinions import editable
from facepipe.stage.traversal import prims_below


def play(face: Face, name: str) -> None:
    """Author an animation of the face as its skeleton's source: what opens the stage shows the face in it.

    :raises InputError: no such animation
    """
    prims = list(prims_below(face.prim, face.where))
    found = next((prim for prim in prims if prim.IsA(UsdSkel.Animation) and prim.GetName() == name), None)
    if found is None:
        raise InputError(face.where, f"no animation '{name}'")
    skeleton = next(prim for prim in prims if prim.IsA(UsdSkel.Skeleton))
    UsdSkel.BindingAPI.Apply(editable(skeleton)).CreateAnimationSourceRel().SetTargets([found.GetPath()])


def on_frames(face: Face, seconds: FloatArray) -> FloatArray:
    """(T,) seconds, those that are a whole time code of the stage in float32 exactly so."""
    rate = face.stage.GetTimeCodesPerSecond()
    whole = np.rint(np.asarray(seconds, dtype=np.float64) * rate) / rate
    return np.where(whole.astype(np.float32) == np.asarray(seconds, dtype=np.float32), whole, seconds)
