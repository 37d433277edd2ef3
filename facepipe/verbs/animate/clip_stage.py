"""Clips in USD and glTF: of another face, or a SkelAnimation that stands alone, as Audio2Face exports it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import first_names
from facepipe.parts import Animation, Skeleton
from facepipe.rig.animation import local_transforms
from facepipe.rig.conventions import shape_key
from facepipe.rig.trs import decompose, rotation_matrices
from facepipe.verbs.animate.face_clip import joint_of
from facepipe.verbs.animate.performance import PARTS, Take, turn_angles

_CARRIES_HEAD = ("head", "neck")  # what a joint above is called whose turns are the head's
_STILL = 1e-4  # radians: less is no turn


def read_stage_clip(path: Path) -> Take:
    """Weights and turns of head and eyes of a clip in a stage or glTF file.

    Of several clips that which a skeleton plays, else the first with weights, else the first.

    :raises InputError: no such file, no clip in it, or one that can't be read
    """
    from facepipe.stage.files import SUFFIXES

    stage = path.suffix.lower() in SUFFIXES
    clips, played, skeleton, up_axis = _of_usd(path) if stage else _of_file(path)
    moving = [clip for clip in clips if clip.times is not None and len(clip.times) > 1]
    if not moving:
        found = f"{len(clips)} poses" if clips else "no animation"
        raise InputError(path, f"{found}, expected a clip: time samples of weights or joints")
    first = next((clip for clip in moving if clip.shapes), moving[0])
    clip = next((clip for clip in moving if clip.name == played), first)
    take = _take(path, clip, skeleton, up_axis)
    if len(moving) > 1:
        others = first_names([one.name for one in moving if one is not clip], 4)
        take.warnings.append(f"the clip '{clip.name}' of {len(moving)}: {others} left out")
    return take


def _of_usd(path: Path) -> tuple[list[Animation], str | None, Skeleton, str]:
    from pxr import UsdGeom, UsdSkel

    from facepipe.stage.composition import check_arrays
    from facepipe.stage.files import open_stage
    from facepipe.stage.prims import check_kinds, distinct_names, prims_below
    from facepipe.stage.skeleton import read_animation, read_skeleton

    stage = open_stage(path, strict=False)
    prims = list(prims_below(stage.GetPseudoRoot(), path))
    check_kinds(prims, path)
    check_arrays(prims, path)
    animations = [prim for prim in prims if prim.IsA(UsdSkel.Animation)]
    names = distinct_names(animations, [str(prim.GetName()) for prim in animations])
    clips = [read_animation(prim, name) for prim, name in zip(animations, names, strict=True)]
    at = {str(prim.GetPath()): name for prim, name in zip(animations, names, strict=True)}
    skeletons = [prim for prim in prims if prim.IsA(UsdSkel.Skeleton)]
    up_axis = str(UsdGeom.GetStageUpAxis(stage))
    for prim in skeletons:
        sources = [str(target) for target in UsdSkel.BindingAPI(prim).GetAnimationSourceRel().GetForwardedTargets()]
        played = next((at[source] for source in sources if source in at), None)
        if played is not None:
            return clips, played, read_skeleton(prim), up_axis
    return clips, None, read_skeleton(skeletons[0]) if len(skeletons) == 1 else Skeleton(), up_axis


def _of_file(path: Path) -> tuple[list[Animation], str | None, Skeleton, str]:
    from facepipe.importers import kind_of, load

    parts = load(kind_of(path), path).parts
    return list(parts.animations), parts.played, parts.skeleton, parts.up_axis


def _take(path: Path, clip: Animation, skeleton: Skeleton, up_axis: str) -> Take:
    assert clip.times is not None
    times = np.asarray(clip.times, dtype=np.float64)
    columns: dict[str, FloatArray] = {}
    if clip.shape_weights is not None:
        columns = dict(zip(clip.shapes, np.asarray(clip.shape_weights, dtype=np.float64).T, strict=True))
    turned, rest, lost = _turns(path, clip, skeleton, up_axis)
    columns |= turned
    if not columns:
        raise InputError(path, f"the clip '{clip.name}' has no weights and moves no head or eye, expected some")
    form = f"clip '{clip.name}' of {'a stage' if path.suffix.lower().startswith('.usd') else path.suffix[1:]}"
    take = Take(
        form=form,
        where=[f"{path} -> {clip.name} -> sample {number}" for number in range(1, len(times) + 1)],
        names=list(columns),
        values=np.stack(list(columns.values()), axis=1),
        seconds=times,
        radians=True,
    )
    if rest:
        take.notes.append(rest)
    if lost:
        take.warnings.append(f"{len(lost)} joints that move beside head and eyes ({first_names(lost, 4)}): left out")
    return take


def _turns(
    path: Path, clip: Animation, skeleton: Skeleton, up_axis: str
) -> tuple[dict[str, FloatArray], str, Sequence[str]]:
    """Angles of head and eyes against rest, a word where the clip has no skeleton to say what rest is, and the names of
    other joints that move.

    The head's are those of the whole neck: one that turns by three joints looks where it looked.
    """
    if not clip.joints:
        return {}, "", ()
    note = ""
    if {*clip.joints} - {*skeleton.joints}:
        if clip.rotations is None or clip.translations is None:
            return {}, "", [joint.rpartition("/")[2] for joint in clip.joints]
        first = np.tile(np.eye(4), (len(clip.joints), 1, 1))
        first[:, :3, :3] = rotation_matrices(np.asarray(clip.rotations)[0])
        first[:, :3, 3] = np.asarray(clip.translations)[0]
        skeleton = Skeleton(joints=clip.joints, bind_transforms=first, rest_transforms=first)
        note = "turns from its first sample, as it has no skeleton"
    local = np.repeat(np.asarray(skeleton.rest_transforms, dtype=np.float64)[None], clip.samples, axis=0)
    used = [skeleton.joints.index(joint) for joint in clip.joints]
    local[:, used] = local_transforms(skeleton, clip)
    turned: dict[str, FloatArray] = {}
    kept: set[int] = set()
    for part in PARTS:
        joint = joint_of(str(path), skeleton, part, None)
        if joint is None:
            continue
        chain = [joint]
        while part == "Head" and (above := int(skeleton.parents[chain[0]])) >= 0:
            if not any(word in shape_key(skeleton.names[above]) for word in _CARRIES_HEAD):
                break
            chain.insert(0, above)
        kept.update(chain)
        stands, above = np.asarray(skeleton.transform, dtype=np.float64), int(skeleton.parents[chain[0]])
        over: list[int] = []
        while above >= 0:
            over.insert(0, above)
            above = int(skeleton.parents[above])
        for one in over:
            stands = stands @ skeleton.rest_transforms[one]
        rest, now = stands, np.repeat(stands[None], clip.samples, axis=0)
        for one in chain:
            rest, now = rest @ skeleton.rest_transforms[one], now @ local[:, one]
        world = rotation_matrices(decompose(now).rotation) @ rotation_matrices(decompose(rest).rotation).T
        if up_axis == "Z":  # what is (x, -z, y) is (x, y, z) with Y up
            axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
            world = axes @ world @ axes.T
        angles = turn_angles(world)
        if np.abs(angles).max() > _STILL:
            turned |= {f"{part}{angle}": angles[:, i] for i, angle in enumerate(("Yaw", "Pitch", "Roll"))}
    still = np.asarray(skeleton.rest_transforms, dtype=np.float64)[used]
    off = np.abs(local[:, used] - still).max(axis=(0, 2, 3)) > _STILL * max(1.0, float(np.abs(still).max()))
    lost = [skeleton.names[one] for one, moves in zip(used, off, strict=True) if moves and one not in kept]
    return turned, note if turned else "", lost
