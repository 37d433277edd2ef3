"""Joints and weights that are learnt from faces of one topology: who people are, as bones within limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.similarity import Similarity, fit_similarity
from facepipe.geometry.vectors import transformed
from facepipe.importers import read_face
from facepipe.parts import BoneLimits, FaceParts
from facepipe.registry import databases
from facepipe.rig.bone_coefficients import coefficient_matrices, matrix_coefficients, rest_coefficients
from facepipe.rig.identity_joints import IdentityJoints
from facepipe.rig.joint_learning import LearntJoints, fitted_coefficients, learn_joints
from facepipe.verbs.skin.options import SkinOptions
from facepipe.verbs.skin.skinning import LearntReport, Skinning, skeleton_of
from facepipe.verbs.skin.surface import Surface
from facepipe.verbs.whole_faces import Topology, check_spaces, in_order, whole_points, world_to_world

LEARNING_ROUNDS = 12  # unseen people of MakeHuman's lose less than 1 % in six more
_ROOT = "head"  # above the learnt joints, which engines want one joint for; it moves no point by itself
_TURN = 0.7  # radians, its limit
_MARGIN = 0.25  # of what the examples needed, beyond it at both ends
_LEAST_SCALE = 0.01  # no joint turns inside out
_SAME_MM = 1e-3  # no point differs by more: what float32 leaves of faces that are the same
_OTHER_SIZE = 4.0  # times as large, or as small: other units, and no scale that a joint should have
_DATABASE = ".fpdb"


def read_examples(paths: Sequence[Path]) -> dict[str, FaceParts]:
    """Name -> face without anything but its points: the neutrals of a database, or those of face stages.

    :raises FacepipeError: a file that can't be used, or a database among others
    """
    if any(path.suffix.lower() == _DATABASE for path in paths):
        if len(paths) > 1:
            raise InputError("--learn-from", f"a database among {len(paths)} files, expected it alone")
        database = databases().load(paths[0])
        pairs = zip(database.entries, database.neutrals(), strict=True)
        return {f"{paths[0]} -> {entry.name}": database.topology.parts(points) for entry, points in pairs}
    found = {}
    for path in paths:
        parts = read_face(path).parts()
        check_spaces(str(path), parts)
        found[str(path)] = Topology.of(parts).parts(whole_points(parts))
    return found


def learnt_paths(count: int) -> tuple[str, ...]:
    """Joints with so many learnt ones, the root first."""
    return (_ROOT, *(f"{_ROOT}/learnt{number:03d}" for number in range(count)))


def from_examples(
    parts: FaceParts,
    surface: Surface,
    examples: Mapping[str, FaceParts],
    options: SkinOptions,
    step: Callable[[], object],
) -> Skinning:
    """Joints, weights and limits with which bones come nearest to the examples.

    Along the axes of the skeleton: in those of the stage, coefficients would turn with its transform.

    :raises InputError: examples that are all as the face is, or one of another size
    :raises TopologyError: one of another topology
    """
    check_spaces(surface.where, parts)
    millimetres, transform = parts.meters_per_unit * 1000.0, np.asarray(parts.skeleton.transform, np.float64)
    to = millimetres * (np.linalg.inv(transform) @ world_to_world(0.001, "Y", parts))[:3]
    to = np.vstack([to, [0.0, 0.0, 0.0, 1.0]])
    first = np.unique(surface.group, return_index=True)[1]
    rest = transformed(whole_points(parts), to)[first]
    faces = [in_order(parts, "the face", other, name) for name, other in examples.items()]
    given = np.array([transformed(whole_points(face), to)[first] for face in faces])
    # people stand higher and nearer than others, and are larger: no joint learns that, and every one does it exactly
    placements = [fit_similarity(rest, points) for points in given]
    for name, one in zip(examples, placements, strict=True):
        if not 1 / _OTHER_SIZE <= one.scale <= _OTHER_SIZE:
            what = f"{one.scale:.3g} times as large as the face"
            raise InputError(name, f"{what}, expected at most {_OTHER_SIZE:g} (is its metersPerUnit right?)")
    offsets = np.array([one.undo(points) for one, points in zip(placements, given, strict=True)]) - rest
    if np.abs(offsets).max() <= _SAME_MM:
        raise InputError("--learn-from", "all faces are as the face itself, expected some that differ")
    found = learn_joints(
        rest,
        surface.edges,
        offsets,
        count=options.count,
        influences=options.influences,
        rounds=LEARNING_ROUNDS,
        step=step,
    )
    joints = IdentityJoints(rows=np.arange(len(rest)), points=rest, **vars(found))
    coefficients = fitted_coefficients(joints, offsets)
    left = np.array([own - joints.offsets(one) for own, one in zip(offsets, coefficients, strict=True)])
    left *= np.array([one.scale for one in placements])[:, None, None]
    root = rest.mean(axis=0)
    whole = np.array([_placed(one, found.places, own) for one, own in zip(placements, coefficients, strict=True)])
    positions = transformed(np.vstack([root, found.places]) / millimetres, transform)
    return Skinning(
        skeleton=skeleton_of(
            parts.skeleton, learnt_paths(options.count), positions, np.tile([0.0, 0.0, 0.0, 1.0], (len(positions), 1))
        ),
        weights=_whole_weights(found, len(positions)),
        limits=_limits(whole, millimetres),
        learnt=_report((given - rest) @ transform[:3, :3].T, left @ transform[:3, :3].T, whole),
    )


def _report(apart: FloatArray, left: FloatArray, coefficients: FloatArray) -> LearntReport:
    """Of how points (s, n, 3) are apart, what coefficients (s, j, 9) leave, and what they need."""
    off = np.linalg.norm(left, axis=2)
    return LearntReport(
        faces=len(left),
        apart_mm=float(np.linalg.norm(apart, axis=2).mean()),
        mean_mm=float(off.mean()),
        p95_mm=float(np.percentile(off, 95)),
        max_mm=float(off.max()),
        translation_mm=float(np.abs(coefficients[..., :3]).max()),
        rotation=float(np.abs(coefficients[..., 3:6]).max()),
        scale=(float(coefficients[..., 6:].min()), float(coefficients[..., 6:].max())),
    )


def _whole_weights(found: LearntJoints, count: int) -> FloatArray:
    """(n, count) weights of all points, the learnt joints after the root."""
    whole = np.zeros((len(found.weights), count))
    np.add.at(whole, (np.arange(len(whole))[:, None], found.indices + 1), found.weights)
    return whole


def _placed(placement: Similarity, places: FloatArray, coefficients: FloatArray) -> FloatArray:
    """(j, 9) bone coefficients of joints at places (j, 3) that do what others do, then the placement.

    It scales all axes alike, so that nothing shears.
    """
    matrices = coefficient_matrices(coefficients)
    matrices[:, :3, 3] = placement.apply(places + matrices[:, :3, 3]) - places
    matrices[:, :3, :3] = placement.scale * placement.rotation @ matrices[:, :3, :3]
    return matrix_coefficients(matrices)


def _limits(coefficients: FloatArray, millimetres: float) -> BoneLimits:
    """What (s, j, 9) coefficients in millimetres needed, and a margin, in stage units of so many; the root turns."""
    rest = rest_coefficients(coefficients.shape[1])
    lower, upper = np.minimum(coefficients.min(axis=0), rest), np.maximum(coefficients.max(axis=0), rest)
    margin = _MARGIN * (upper - lower)
    lower, upper = lower - margin, upper + margin
    lower[:, :3], upper[:, :3] = lower[:, :3] / millimetres, upper[:, :3] / millimetres
    lower[:, 6:] = np.maximum(lower[:, 6:], _LEAST_SCALE)
    root, turn = rest_coefficients(1), np.repeat([0.0, _TURN, 0.0], 3)
    return BoneLimits(lower=np.vstack([root - turn, lower]), upper=np.vstack([root + turn, upper]))
