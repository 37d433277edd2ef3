"""Animation stacks of an FBX file, sampled at whole frames and at all keys between them.

FBX curves turn by Euler angles along cubics, with layers and pivots on top: ufbx evaluates them, frame by frame, and
between two samples lines stand for them, as game engines import them too.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.names import first_names, handles, numbered
from facepipe.importers.fbx.joints import Joints
from facepipe.importers.fbx.scene import Rows, Scene
from facepipe.parts import Animation, identity
from facepipe.rig.animation import ON_FRAME, TICK, whole_frames, with_exact_scales
from facepipe.rig.trs import Trs, decompose

_RATE = 24.0  # frames per second where the file has none
_AT_ONCE = 64  # samples
_ALIKE = 1e-4  # weights of channels that play one shape
_STILL = 1e-6  # of the size of a matrix


@dataclass(frozen=True)
class Track:
    """One stack, sampled."""

    name: str
    times: FloatArray  # (t,) seconds
    worlds: Mapping[int, FloatArray]  # (t, 4, 4) by node, in the axes of the face
    weights: FloatArray  # (t, channels)


def frame_rate(scene: Scene, fps: float | None) -> float:
    """Frames per second that animations are sampled at."""
    own = float(scene.settings["frames_per_second"])
    return fps or (own if 1.0 <= own <= 1000.0 else _RATE)


def moved_nodes(scene: Scene) -> set[int]:
    """The nodes that curves of any stack move."""
    count = len(scene.tables["nodes"])
    found: set[int] = set()
    for stack in scene.tables["stacks"]:
        found.update(np.flatnonzero(scene.array(stack["moved"], "u1")[:count]).tolist())
    return found


def read_tracks(scene: Scene, turn: FloatArray, nodes: Collection[int], fps: float | None) -> list[Track]:
    """All stacks that have keys.

    :param turn: (4, 4) world of the file -> world of the face
    :param nodes: whose places are wanted
    :raises InputError: times that are no span, or more samples than the file's size allows
    """
    tracks, chosen = [], sorted(nodes)
    for number, stack in enumerate(scene.tables["stacks"]):
        name = scene.text(stack["name"])
        if stack["others"]:
            like = f"{scene.text(stack['other_property'])} of {scene.text(stack['other_owner'])}"
            what = f"{stack['others']} animated properties are neither places nor weights of shapes"
            scene.warn(name, f"{what}, like {ascii(like)[1:-1][:80]}: left out")
        times = _times(scene, stack, frame_rate(scene, fps), only_frames=fps is not None)
        if not len(times):
            continue
        scene.budget.spend(128 * len(times) * len(chosen), scene.error)
        worlds, weights = np.zeros((len(times), len(chosen), 4, 4)), []
        for start in range(0, len(times), _AT_ONCE):
            found, some = scene.samples(number, times[start : start + _AT_ONCE])
            worlds[start : start + _AT_ONCE] = turn @ found[:, chosen]
            weights.append(some)
        by_node = {node: worlds[:, place] for place, node in enumerate(chosen)}
        tracks.append(Track(name, times, by_node, np.concatenate(weights)))
    return tracks


def _times(scene: Scene, stack: Rows, rate: float, *, only_frames: bool) -> FloatArray:
    """(t,) seconds to sample a stack at: whole frames and keys, and shortly before keys that change a value at once."""
    keys = scene.array(stack["times"], "<f8")
    if not len(keys):
        return np.zeros(0)
    begin, end = float(stack["begin"]), float(stack["end"])
    if not begin < end:  # a stack without a span of its own plays from its first key to its last
        begin, end = float(keys.min()), float(keys.max())
    scene.budget.spend(int(min(64.0 * rate * abs(end - begin), 1e15)), scene.error)
    frames = whole_frames(begin, end, rate)
    frames = frames[(frames > begin - ON_FRAME / rate) & (frames < end + ON_FRAME / rate)]
    if only_frames:
        return frames
    held = scene.array(stack["held"], "<f8", 2)
    before = held[:, 1] - np.minimum(TICK, (held[:, 1] - held[:, 0]) / 2)
    every = np.concatenate([keys, before])
    every = np.concatenate([frames, every[(every >= begin) & (every <= end)], [begin, end]])
    on_frame = np.abs(every * rate - np.rint(every * rate)) < ON_FRAME
    every = np.where(on_frame, np.rint(every * rate) / rate, every)
    return every[np.unique(every.astype(np.float32), return_index=True)[1]]  # float32 of files holds no closer ones


def animations(
    scene: Scene, tracks: Sequence[Track], joints: Joints, shapes: Mapping[int, str]
) -> tuple[Animation, ...]:
    """What the tracks play on the face; one without change is named and left out, one of a single sample is a pose.

    :param shapes: shape of each channel that a mesh of the face has
    """
    made = []
    for track in tracks:
        moving = _joint_motion(scene, track, joints) | _shape_motion(track, shapes)
        if moving:
            made.append(Animation(name=track.name, times=track.times if len(track.times) > 1 else None, **moving))
        else:
            scene.warn(track.name, "the animation moves neither a joint nor a shape: left out")
    if (pose := _default_pose(scene, shapes)) is not None:
        made.append(pose)
    names = handles([one.name for one in made], "Animation")
    found = []
    for name, one in zip(names, made, strict=True):
        called = replace(one, name=name, label=one.name if one.name != name else None)
        exact, lost = with_exact_scales(joints.skeleton, called)
        if lost:
            scene.warn(one.name, lost)
        found.append(exact)
    return tuple(found)


def _joint_motion(scene: Scene, track: Track, joints: Joints) -> dict[str, Any]:
    """Tracks of the joints that do not stand at rest throughout."""
    rest = np.asarray(joints.skeleton.rest_transforms)
    moving: dict[str, Trs] = {}  # matrices of all of them at once would take several times the memory
    for joint, node in enumerate(joints.nodes):
        parent = joints.parents[joint]
        local = track.worlds[node] @ joints.shrink
        if parent >= 0:
            above = track.worlds[joints.nodes[parent]] @ joints.shrink
            flat = np.abs(np.linalg.det(above)) < 1e-30
            if flat.any():
                scene.warn(track.name, "joints shrink to nothing: those below are held there")
                above = np.where(flat[:, None, None], identity(), above)
            local = np.linalg.inv(above) @ local
        size = max(float(np.abs(rest[joint]).max()), 1e-30)
        if np.abs(local - rest[joint]).max() > _STILL * size:
            moving[joints.skeleton.joints[joint]] = decompose(local)
    if not moving:
        return {}
    translations, rotations, scales, sheared = (np.stack(part, axis=1) for part in zip(*moving.values(), strict=True))
    if sheared.any():
        scene.warn(track.name, f"scaled joints shear {int(sheared.any(axis=0).sum())} others: lost")
    # q and -q turn alike: lines between samples go the short way
    turns = np.where((rotations[:-1] * rotations[1:]).sum(axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
    rotations[1:] *= np.cumprod(turns, axis=0)
    return {
        "joints": tuple(moving),
        "translations": translations.astype(np.float32),
        "rotations": rotations.astype(np.float32),
        "scales": scales.astype(np.float32),
    }


def _shape_motion(track: Track, shapes: Mapping[int, str]) -> dict[str, Any]:
    """Weights of the shapes that are ever shown."""
    columns: dict[str, FloatArray] = {}
    for channel, shape in shapes.items():
        if track.weights[:, channel].any():
            columns.setdefault(shape, track.weights[:, channel])
    if not columns:
        return {}
    return {"shapes": tuple(columns), "shape_weights": np.stack([*columns.values()], axis=1).astype(np.float32)}


def _default_pose(scene: Scene, shapes: Mapping[int, str]) -> Animation | None:
    """The weights that the file's channels have where nothing plays, as a pose; None where all are 0."""
    weights = scene.tables["channels"]["weight"]
    shown = {shape: float(weights[channel]) for channel, shape in shapes.items() if weights[channel]}
    if not shown:
        return None
    return Animation(name="default", shapes=tuple(shown), shape_weights=np.array([[*shown.values()]], np.float32))


def channels_apart(scene: Scene, tracks: Sequence[Track], channels: Mapping[int, str]) -> dict[int, str]:
    """What each channel's shape is called: its own name, unless an earlier channel of that name plays otherwise.

    :param channels: name of each channel of a mesh, mesh after mesh
    """
    rest = scene.tables["channels"]["weight"][None, :]
    played = np.concatenate([rest, *(track.weights for track in tracks)])
    called: dict[int, str] = {}
    ways: dict[str, list[int]] = {}  # name -> channels of that name, each of which plays otherwise
    taken = set(channels.values())
    apart = []
    for channel, name in channels.items():
        known = ways.setdefault(name, [])
        scene.budget.spend(8 * len(played) * len(known), scene.error)
        alike = np.abs(played[:, known] - played[:, [channel]]).max(axis=0) <= _ALIKE
        if alike.any():
            called[channel] = called[known[int(alike.argmax())]]
            continue
        called[channel] = numbered([name], taken)[0] if known else name
        apart += [f"{name} is {called[channel]}"] if known else []
        taken.add(called[channel])
        known.append(channel)
    if apart:
        what = f"{len(apart)} shapes are played otherwise than those of their name on an earlier mesh"
        scene.warn("", f"{what}: {first_names(apart, 4)}")
    return called
