"""Directions of measures: weights of the identity modes, within each mask, that change one measure and no other.

A direction c of weights minimises ``|c|^2`` (standard deviations squared), how far it moves the skin and how much it
bends it, under ``M c = its own standard deviation`` for its measure and 0 for all the others. Weights in masks that are
far from what is measured cost more. Directions are symmetric: modes are symmetric or antisymmetric, and an
antisymmetric one has opposite weights on the two sides.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from masks import MASKS, masks
from measure_table import MEASURES, SPOTS, Measure

from facepipe.geometry.gradient_system import cotangent_weights, incidence
from facepipe.geometry.polygons import point_areas, point_triangles
from facepipe.geometry.vectors import to_segment

SKIN = 11248  # points of face, head and neck, without the sockets
MM = 10.0  # of a centimetre
NORM, AWAY, MOTION, BENDING = 0.1, 10.0, 1.0, 1.0  # what a direction costs
LEAK = 0.06  # standard deviations that others may follow, where it makes a direction cheaper
SOFT = (1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4, 0.0)  # of their constraints
STEP = 1 / 2048  # of weights
EFFECT = 1 / 16384  # standard deviations of a measure: step of what modes do to it
LEAST_AREA = 2e-3  # cm^2 of a point, so that slivers do not rule the bending

Floats = npt.NDArray[np.float64]
Arrays = dict[str, npt.NDArray[Any]]


def spots(points: Floats, landmarks: npt.NDArray[np.int32]) -> dict[str, Floats]:
    """(SKIN,) shares of the points in every place, in sum 1."""
    found = {}
    for name, (spot, radius) in SPOTS.items():
        near = points[landmarks[spot]] if isinstance(spot, int) else np.array(spot)
        centre = points[np.linalg.norm(points[:SKIN] - near, axis=1).argmin()]
        away = np.linalg.norm(points[:SKIN] - centre, axis=1) / radius
        shares = np.where(away < 2.5, np.exp(-(away**2) / 2), 0.0)
        found[name] = shares / shares.sum()
    return found


def functionals(places: Mapping[str, Floats], side: float = 1.0) -> Floats:
    """(d, SKIN, 3) such that the sum of one times points in cm is a measure in mm, of the left side or of the right."""

    def along(shares: dict[str, float]) -> Floats:
        return sum((share * places[name] for name, share in shares.items()), np.zeros(SKIN))

    def one(measure: Measure) -> Floats:
        return np.stack([side * along(measure.x), along(measure.y), along(measure.z)], axis=1)

    return MM * np.stack([one(measure) for measure in MEASURES.values()])


def build(
    points: Floats,
    modes: npt.NDArray[np.float32],
    parts: Mapping[str, slice],
    faces: tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]],
    landmarks: npt.NDArray[np.int32],
) -> Arrays:
    """Names, groups and deviations of the measures, what each mode does to them, and the weights of their directions.

    :param points: (n, 3) of the average head, in cm
    :param modes: (100, n, 3) as they are packed
    :param faces: counts and indices
    """
    places = spots(points, landmarks)
    measured = functionals(places)
    own_modes = modes[:, :SKIN].astype(np.float64)
    effects = np.einsum("dnc,mnc->dm", measured, own_modes, optimize=True)
    deviations = np.sqrt((effects**2).sum(axis=1))
    parity = np.sign(_mirror_products(points, own_modes))
    basis = Basis(points, own_modes, parity, masks(points, parts), faces)
    weights = basis.directions(measured, deviations, _distances(points, places))
    return {
        "names": np.array(list(MEASURES)),
        "groups": np.array([measure.group for measure in MEASURES.values()]),
        "sided": np.array([measure.sided for measure in MEASURES.values()]),
        "deviations": np.round(deviations, 4).astype(np.float32),
        "effects": np.rint(effects / deviations[:, None] / EFFECT).astype(np.int16),
        "costs": np.round(np.sqrt((weights**2).sum(axis=(1, 2))), 3),
        "parity": parity.astype(np.int8),
        "weights": np.rint(weights / STEP).astype(np.int16),
    }


class Basis:
    """The symmetric offsets of all modes in all masks, and what they cost."""

    def __init__(
        self,
        points: Floats,
        modes: Floats,
        parity: Floats,
        shares: Floats,
        faces: tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]],
    ) -> None:
        laplacian, areas = _laplacian(points, faces)
        left = np.flatnonzero(points[:SKIN, 0] > -1e-4)
        scale = np.sqrt(areas[left] * np.where(points[left, 0] < 1e-4, 0.5, 1.0))[:, None]
        self.columns: list[tuple[int, int]] = []  # mask, mode
        offsets, bends = [], []
        for number, mask in enumerate(MASKS.values()):
            for sign in (1, -1) if mask.paired else (1,):
                own = np.flatnonzero(parity == sign)
                share = shares[0, number, :SKIN] + sign * shares[1, number, :SKIN]
                moved = (share[:, None] * modes[own]).transpose(1, 2, 0)
                offsets.append(moved)
                bent = laplacian @ moved.reshape(SKIN, -1)
                bends.append((scale * bent[left]).reshape(-1, len(own)))
                self.columns += [(number, int(mode)) for mode in own]
        self.offsets = np.concatenate(offsets, axis=2)
        motion = (scale[:, None] * self.offsets[left]).reshape(-1, len(self.columns))
        bend = np.concatenate(bends, axis=1)
        self.cost = MOTION * motion.T @ motion + BENDING * bend.T @ bend
        self.shape = (len(MASKS), len(modes))

    def directions(self, measured: Floats, deviations: Floats, distances: Floats) -> Floats:
        """(d, masks, modes) weights that change each measure by its deviation and no other."""
        system = measured.reshape(len(measured), -1) @ self.offsets.reshape(-1, len(self.columns))
        rows, modes = np.array(self.columns).T
        found = np.zeros((len(measured), *self.shape))
        for number in range(len(measured)):
            norm = NORM * (1 + AWAY * distances[number, rows] ** 2)
            free = np.linalg.solve(np.diag(norm) + self.cost, system.T)
            found[number, rows, modes] = free @ _least_strict(system @ free, number, deviations)
        return found


def _least_strict(effects: Floats, number: int, deviations: Floats) -> Floats:
    """(d,) multipliers that change a measure by its deviation, with constraints as soft as `LEAK` allows."""
    others = np.arange(len(deviations)) != number
    for soft in SOFT:
        found = np.linalg.inv(effects + np.diag(soft * others * deviations**2))[:, number]
        found *= deviations[number] / (effects[number] @ found)
        if np.abs(effects @ found / deviations)[others].max() <= LEAK:
            break
    return np.asarray(found)


def _laplacian(points: Floats, faces: tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]) -> tuple[Any, Floats]:
    """Cotangent Laplacian of the skin per area, and the areas (SKIN,) of its points."""
    from scipy.sparse import diags_array

    triangles = point_triangles(*faces)
    triangles = triangles[(triangles < SKIN).all(axis=1)]
    pairs, weights = cotangent_weights(points, triangles)
    across = incidence(pairs, SKIN)
    areas = point_areas(points[:SKIN], triangles)
    return diags_array(1 / np.maximum(areas, LEAST_AREA)) @ across.T @ diags_array(weights) @ across, areas


def _mirror_products(points: Floats, modes: Floats) -> Floats:
    """(m,) above 0 for symmetric modes, below for antisymmetric ones."""
    from scipy.spatial import cKDTree

    other = cKDTree(points[:SKIN]).query(points[:SKIN] * (-1, 1, 1))[1]
    return np.asarray((modes * modes[:, other] * (-1, 1, 1)).sum(axis=(1, 2)))


def _distances(points: Floats, places: Mapping[str, Floats]) -> Floats:
    """(d, masks) in cm from what is measured to each mask, less its fade."""
    centres = {name: shares @ (points[:SKIN]) for name, shares in places.items()}
    found = np.zeros((len(MEASURES), len(MASKS)))
    for row, measure in enumerate(MEASURES.values()):
        own = np.stack([centres[name] for name in {**measure.x, **measure.y, **measure.z}])
        for column, mask in enumerate(MASKS.values()):
            away = min(to_segment(own, np.array(a), np.array(b)).min() for a, b in mask.segments)
            found[row, column] = max(away - mask.radius - mask.fade, 0.0)
    return found
