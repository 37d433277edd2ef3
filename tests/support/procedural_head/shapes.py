"""The blendshapes of all meshes, with ARKit's names."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.parts import Blendshape, Inbetween, Mesh
from procedural_head import expressions, eyes, fields, lids, topology
from procedural_head.lids import LidMotion
from procedural_head.meshes import Neutral

_SMALLEST = 1e-5  # cm: offsets below are left out
_LOOK = {"Up": (-22.0, 0.0), "Down": (26.0, 0.0), "In": (0.0, -28.0), "Out": (0.0, 28.0)}  # degrees about X, Y


@dataclass(frozen=True)
class Motion:
    """Offsets of one shape on every mesh, at weight 1 and, where the path is curved, half way."""

    full: dict[str, FloatArray]  # mesh -> (n, 3)
    half: dict[str, FloatArray]


def build(neutral: Neutral, masks: fields.Fields) -> dict[str, list[Blendshape]]:
    """Blendshapes of every mesh, in the same order on each."""
    motions = _motions(neutral, masks)
    meshes = (neutral.head, *neutral.eyeballs, neutral.teeth[1], neutral.tongue, neutral.brows, neutral.lashes)
    made: dict[str, list[Blendshape]] = {}
    for mesh in meshes:
        shapes = (_sparse(name, mesh, motion) for name, motion in sorted(motions.items()))
        made[mesh.name] = [shape for shape in shapes if shape is not None]
    return made


def _motions(neutral: Neutral, masks: fields.Fields) -> dict[str, Motion]:
    motions = {name: _skin_motion(neutral, make(masks), name) for name, make in expressions.BOTH.items()}
    left = {name: _skin_motion(neutral, make(masks), name) for name, make in expressions.LEFT.items()}
    left |= _eye_motions(neutral, left)
    for name, motion in left.items():
        motions[name] = motion
        motions[name.replace("Left", "Right")] = _mirrored(motion, neutral)
    motions["tongueOut"] = Motion({"Tongue": _tongue_out(neutral.tongue.points)}, {})
    return motions


def _skin_motion(neutral: Neutral, head: FloatArray, name: str) -> Motion:
    """A shape of the skin; lower teeth and tongue follow the jaw, brows and lashes the skin."""
    full = {"Head": head}
    if name.startswith("brow"):
        full["Brows"] = neutral.brow_strips.attachment.carry(head)
    if name.startswith("browDown"):
        full["Lashes"] = head[neutral.lash_strips.rim]
    for mesh in (neutral.teeth[1], neutral.tongue):
        everywhere = np.ones(len(mesh.points))
        if name == "jawOpen":
            full[mesh.name] = expressions.open_jaw(mesh.points, everywhere)
        elif name in ("jawForward", "jawLeft"):
            full[mesh.name] = everywhere[:, None] * ((0.0, 0.0, 0.7) if name == "jawForward" else (0.7, 0.0, 0.0))
    return Motion(full, {})


def _eye_motions(neutral: Neutral, left: dict[str, Motion]) -> dict[str, Motion]:
    shape = eyes.eye(neutral.who)
    lid = {
        "eyeBlinkLeft": lids.motion(shape, close=1.0),
        "eyeWideLeft": lids.motion(shape, upper=8.0, lower=-3.0),
        "eyeSquintLeft": lids.motion(shape, upper=-4.0, lower=8.0),
        "eyeLookUpLeft": lids.motion(shape, upper=9.0, lower=3.0),
        "eyeLookDownLeft": lids.motion(shape, upper=-15.0, lower=-4.0),
        "eyeLookInLeft": lids.motion(shape, turn=-2.5),
        "eyeLookOutLeft": lids.motion(shape, turn=2.5),
    }
    motions = {name: _lid_motion(neutral, move) for name, move in lid.items()}
    motions["eyeSquintLeft"] = _added(motions["eyeSquintLeft"], left["cheekSquintLeft"], 0.3)
    for direction, (about_x, about_y) in _LOOK.items():
        points = neutral.eyeballs[0].points
        motion = motions[f"eyeLook{direction}Left"]
        motion.full["EyeLeft"] = _turned(points, shape.center, about_x, about_y) - points
        motion.half["EyeLeft"] = _turned(points, shape.center, about_x / 2, about_y / 2) - points
    return motions


def _lid_motion(neutral: Neutral, move: LidMotion) -> Motion:
    shape = eyes.eye(neutral.who)
    strips = neutral.lash_strips
    is_left = strips.side > 0
    stages = []
    for share in (1.0, 0.5):
        lash = np.zeros_like(strips.solid.points)
        points, spoke = strips.solid.points[is_left], strips.spoke[is_left]
        lash[is_left] = lids.lash_offsets(points, spoke, shape, move, share)
        stages.append({"Head": lids.head_offsets(neutral.head.points, shape, move, share), "Lashes": lash})
    return Motion(stages[0], stages[1])


def _added(motion: Motion, other: Motion, share: float) -> Motion:
    def mixed(offsets: dict[str, FloatArray], amount: float) -> dict[str, FloatArray]:
        return {key: value + amount * other.full[key] if key in other.full else value for key, value in offsets.items()}

    return Motion(mixed(motion.full, share), mixed(motion.half, share / 2))


def _turned(points: FloatArray, center: FloatArray, about_x: float, about_y: float) -> FloatArray:
    a, b = np.radians(about_x), np.radians(about_y)
    turn_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    turn_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    return np.asarray(center + (points - center) @ (turn_y @ turn_x).T)


def _tongue_out(points: FloatArray) -> FloatArray:
    z = points[:, 2]
    share = np.clip((z - z.min()) / (z.max() - z.min()), 0, 1)
    return np.stack([0 * z, -0.55 * share**2 + 0.25 * share, 3.6 * share], axis=1)


def mirror_maps(neutral: Neutral) -> dict[str, tuple[str, IntArray]]:
    """For every mesh the mesh on the other side and, for each of its points, the point there (mirrored in x)."""
    from scipy.spatial import cKDTree

    maps = {"Head": ("Head", topology.build().mirror)}
    left, right = neutral.eyeballs
    pairs = [(left, right), (right, left)]
    pairs += [(mesh, mesh) for mesh in (neutral.teeth[1], neutral.tongue, neutral.brows, neutral.lashes)]
    for mesh, other in pairs:
        maps[mesh.name] = (other.name, cKDTree(other.points * (-1, 1, 1)).query(mesh.points)[1])
    return maps


def _mirrored(motion: Motion, neutral: Neutral) -> Motion:
    maps = mirror_maps(neutral)

    def flip(offsets: dict[str, FloatArray]) -> dict[str, FloatArray]:
        flipped = {}
        for name, (other, points) in maps.items():
            if other in offsets:
                flipped[name] = offsets[other][points] * (-1, 1, 1)
        return flipped

    return Motion(flip(motion.full), flip(motion.half))


def _sparse(name: str, mesh: Mesh, motion: Motion) -> Blendshape | None:
    if mesh.name not in motion.full:
        return None
    full, half = motion.full[mesh.name], motion.half.get(mesh.name)
    full = np.where(np.abs(full).max(axis=1, keepdims=True) < _SMALLEST, 0.0, full)
    normals = _normal_change(mesh, full) if mesh.name == "Head" else np.zeros_like(full)
    size = np.maximum(np.abs(full).max(axis=1), np.abs(normals).max(axis=1))
    if half is not None:
        size = np.maximum(size, np.abs(half).max(axis=1))
    moved = np.nonzero(size >= _SMALLEST)[0].astype(np.int32)
    shape = Blendshape(name=name, point_indices=moved, offsets=_rounded(full[moved]))
    is_head = mesh.name == "Head"
    if is_head:
        shape = replace(shape, normal_offsets=_rounded(normals[moved]))
    if half is not None and np.abs(half - full / 2).max() > 1e-3:
        change = _rounded(_normal_change(mesh, half)[moved]) if is_head else None
        inbetween = Inbetween(name="half", weight=0.5, offsets=_rounded(half[moved]), normal_offsets=change)
        shape = replace(shape, inbetweens=(inbetween,))
    return shape


def _rounded(offsets: FloatArray) -> FloatArray:
    """To a tenth of a micrometre: the last bits of a double differ between machines, files should not."""
    return np.round(offsets, 5) + 0.0


def _normal_change(mesh: Mesh, offsets: FloatArray) -> FloatArray:
    triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
    return np.asarray(point_normals(mesh.points + offsets, triangles) - point_normals(mesh.points, triangles))
