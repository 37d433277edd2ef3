"""The animation that a skeleton plays, and when."""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdSkel

from facepipe.core.arrays import FloatArray, require_finite
from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.parts import Animation
from facepipe.stage.face import Face, animation_prims
from facepipe.stage.prims import editable, prims_below
from facepipe.stage.skeleton import author_source, read_animation
from facepipe.stage.values import usd_errors


def play(face: Face, name: str) -> None:
    """Author an animation of the face as its skeleton's source: what opens the stage shows the face in it.

    :raises InputError: no such animation
    """
    prim = animation_prims(face).get(name)
    if prim is None:
        raise InputError(face.where, unknown(name, [animation.name for animation in face.animations], "animation"))
    author_source(editable(_skeleton_prim(face)), prim.GetPath())


def moving_animation(face: Face) -> Animation | None:
    """What moves a face: the animation that its skeleton plays, else the only one over time; None where there is none.

    :raises InputError: NaN, or several over time of which the skeleton plays none
    :raises TopologyError: arrays that don't fit the joints or shapes
    """
    with usd_errors(face.where):
        source = UsdSkel.BindingAPI(_skeleton_prim(face)).GetInheritedAnimationSource()
    if source and source.IsA(UsdSkel.Animation):
        played = read_animation(source)
        require_finite(played, f"{face.where} -> {source.GetPath()}")
        return played
    moving = [animation for animation in face.animations if animation.times is not None]
    if len(moving) > 1:
        some = ", ".join(animation.name for animation in moving[:6])
        raise InputError(
            face.where, f"{len(moving)} animations over time ({some}), expected one, or one that the skeleton plays"
        )
    return moving[0] if moving else None


def on_frames(face: Face, seconds: FloatArray) -> FloatArray:
    """(T,) seconds; those that are a whole time code of the stage in float32 become exactly that."""
    rate = face.stage.GetTimeCodesPerSecond()
    whole = np.rint(np.asarray(seconds, dtype=np.float64) * rate) / rate
    return np.where(whole.astype(np.float32) == np.asarray(seconds, dtype=np.float32), whole, seconds)


def _skeleton_prim(face: Face) -> Usd.Prim:
    return next(prim for prim in prims_below(face.prim, face.where) if prim.IsA(UsdSkel.Skeleton))
