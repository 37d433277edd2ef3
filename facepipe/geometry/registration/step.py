"""One step of registration: coefficients, the scan's place and the residual from given matches, solved together.

With modes C, a residual d, and a scan that turns by ω, moves by t and grows by s about its centre, the distance of a
point from the plane of its match p is linear in all of them:

    n . (base + C b + d - p - ω x p - t - s p)

The residual has three unknowns a point, b and the scan's place 60 to 70 in all. For fixed b, ω, t, s the residual
solves one sparse system; it is factored once and solved for a right-hand side of each of these (Schur complement).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.geometry.factor import factorise
from facepipe.geometry.registration.anchors import Anchors
from facepipe.geometry.registration.surface import DeformableSurface
from facepipe.geometry.registration.target import Matches
from facepipe.geometry.similarity import Similarity

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

_OPEN = 1e-9  # share of the system's trace that keeps what nothing determines from moving


@dataclass(frozen=True, kw_only=True)
class Pull:
    """What the scan says in one step."""

    matches: Matches  # of the points `surface.seen`
    weights: FloatArray  # (m,) of the matches
    anchors: Anchors
    anchor_weights: FloatArray  # (l,)
    spread: Any  # (l, n) sparse: the residual's part in the anchors, taken over the points around


@dataclass(frozen=True, kw_only=True)
class Step:
    """What a step found."""

    coefficients: FloatArray  # (k,)
    residual: FloatArray  # (n, 3)
    move: Similarity  # of the scan


def solve_step(surface: DeformableSurface, stiffness: Any, pull: Pull, *, scale: bool) -> Step:
    """The least-squares step.

    :param stiffness: (3n, 3n) sparse, of the residual, axes of a point side by side
    :param scale: whether the scan may grow
    """
    matches, seen = pull.matches, surface.seen
    centre = matches.places.mean(axis=0)
    count = len(surface.base)
    planes = np.einsum("mi,mi->m", matches.places - surface.base[seen], matches.normals)
    planes = np.column_stack([planes, _plane_columns(surface, matches, centre, scale)])
    fixed = _anchor_columns(surface, pull.anchors, centre, scale)  # (l, 3, 1 + q)
    right = np.zeros((count, 3, planes.shape[1]))
    right[seen] = matches.normals[:, :, None] * (pull.weights[:, None] * planes)[:, None, :]
    spread = pull.spread
    weighted = pull.anchor_weights[:, None, None] * fixed
    right += (spread.T @ weighted.reshape(len(weighted), -1)).reshape(right.shape)
    factor = factorise(stiffness + _data_matrix(pull, seen, spread))
    flat = right.reshape(3 * count, -1)
    solved = factor.solve(flat)
    normal = planes.T @ (pull.weights[:, None] * planes) - flat.T @ solved
    normal += np.einsum("lip,liq->pq", fixed, weighted)
    unknown = _reduced(surface, normal)
    residual = (solved[:, 0] - solved[:, 1:] @ unknown).reshape(count, 3)
    modes = len(surface.expected)
    return Step(coefficients=unknown[:modes], residual=residual, move=_similarity(unknown[modes:], centre))


def solve_model_step(surface: DeformableSurface, pull: Pull, *, scale: bool) -> Step:
    """The least-squares step of coefficients and place without a residual.

    :param scale: whether the scan may grow
    """
    matches = pull.matches
    centre = matches.places.mean(axis=0)
    planes = np.einsum("mi,mi->m", matches.places - surface.base[surface.seen], matches.normals)
    planes = np.column_stack([planes, _plane_columns(surface, matches, centre, scale)])
    fixed = _anchor_columns(surface, pull.anchors, centre, scale)
    normal = planes.T @ (pull.weights[:, None] * planes)
    normal += np.einsum("lip,l,liq->pq", fixed, pull.anchor_weights, fixed)
    unknown = _reduced(surface, normal)
    modes = len(surface.expected)
    return Step(
        coefficients=unknown[:modes],
        residual=np.zeros_like(surface.base),
        move=_similarity(unknown[modes:], centre),
    )


def _reduced(surface: DeformableSurface, normal: FloatArray) -> FloatArray:
    """Coefficients and the scan's place, from what is left when the residual is eliminated."""
    matrix, right = normal[1:, 1:].copy(), normal[1:, 0].copy()
    modes = np.arange(len(surface.expected))
    matrix[modes, modes] += surface.precision
    right[modes] += surface.precision * surface.expected
    place = np.arange(len(modes), len(matrix))
    matrix[place, place] *= 1.0 + _OPEN
    scales = np.sqrt(np.maximum(np.diag(matrix), np.finfo(np.float64).tiny))
    return np.asarray(np.linalg.solve(matrix / np.outer(scales, scales), right / scales) / scales)


def _plane_columns(surface: DeformableSurface, matches: Matches, centre: FloatArray, scale: bool) -> FloatArray:
    """(m, q) what each unknown but the residual moves the points and planes apart."""
    local, normals = matches.places - centre, matches.normals
    modes = np.einsum("kmi,mi->mk", surface.modes[:, surface.seen], normals)
    columns = [modes, -np.cross(local, normals), -normals]
    if scale:
        columns.append(-np.einsum("mi,mi->m", local, normals)[:, None])
    return np.concatenate(columns, axis=1)


def _anchor_columns(surface: DeformableSurface, anchors: Anchors, centre: FloatArray, scale: bool) -> FloatArray:
    """(l, 3, 1 + q) the anchors' offsets from the base, and what each unknown moves them by."""
    local = anchors.targets - centre
    offsets = anchors.targets - anchors.places(surface.base)
    axes = np.eye(3)
    columns = [offsets[:, :, None], anchors.places(surface.modes.transpose(1, 2, 0))]
    columns.append(-np.stack([np.cross(axis, local) for axis in axes], axis=2))
    columns.append(-np.broadcast_to(axes, (len(local), 3, 3)))
    if scale:
        columns.append(-local[:, :, None])
    return np.concatenate(columns, axis=2)


def _data_matrix(pull: Pull, seen: IntArray, spread: Any) -> Any:
    """(3n, 3n) sparse: what matches and anchors hold the residual with."""
    from scipy.sparse import csr_array, diags_array, identity, kron

    size = 3 * spread.shape[1]
    own = 3 * seen[:, None] + np.arange(3)
    rows, columns = np.repeat(own, 3, axis=1), np.tile(own, (1, 3))
    normals = pull.matches.normals
    values = pull.weights[:, None, None] * normals[:, :, None] * normals[:, None, :]
    planes = csr_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size))
    return planes + kron(spread.T @ diags_array(pull.anchor_weights) @ spread, identity(3))


def _similarity(unknown: FloatArray, centre: FloatArray) -> Similarity:
    """Of (ω, t, s) or (ω, t): about `centre`."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_rotvec(unknown[:3]).as_matrix()
    scale = float(np.exp(unknown[6])) if len(unknown) > 6 else 1.0
    return Similarity(rotation=rotation, translation=centre + unknown[3:6] - scale * rotation @ centre, scale=scale)
