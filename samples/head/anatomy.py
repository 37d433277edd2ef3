"""What the model says of the head's mechanics: the jaw's hinge, the eyes' centres, the tongue."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from model import KEPT, Floats, Ints, Model
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from facepipe.geometry.balls import fit_ball

GUMS = next(part for part in KEPT if part.mesh == "GumsAndTongue")
TEETH = next(part for part in KEPT if part.mesh == "Teeth")
_MOVED = 1.0  # cm: lower teeth move further in jawOpen, upper ones not at all


@dataclass(frozen=True, kw_only=True)
class Jaw:
    """The rotation about x that jawOpen is for the lower teeth."""

    hinge: Floats  # (3,) a point of the axis
    angle: float  # radians

    def turned(self, points: Floats) -> Floats:
        """(n, 3) offsets of points that turn with the jaw."""
        start = (points - self.hinge)[:, 1:]
        sine, cosine = np.sin(self.angle), np.cos(self.angle)
        end = start @ np.array([[cosine, sine], [-sine, cosine]])
        return np.pad(end - start, ((0, 0), (1, 0)))

    def share(self, points: Floats, offsets: Floats) -> Floats:
        """(n,) how much of the rotation there is in the offsets of points, from 0 to 1."""
        whole = self.turned(points)
        return np.clip((offsets * whole).sum(axis=1) / np.maximum((whole**2).sum(axis=1), 1e-9), 0.0, 1.0)


def jaw_of(model: Model) -> Jaw:
    """The rotation that takes the lower teeth nearest to where jawOpen has them."""
    teeth = slice(*TEETH.points)
    opened = model.shapes["jawOpen"][teeth]
    lower = np.linalg.norm(opened, axis=1) > _MOVED
    start, end = model.points[teeth][lower][:, 1:], (model.points[teeth] + opened)[lower][:, 1:]
    middles = start.mean(axis=0), end.mean(axis=0)
    u, _, v = np.linalg.svd((start - middles[0]).T @ (end - middles[1]))
    turn = (u @ np.diag([1.0, np.linalg.det(u @ v)]) @ v).T
    centre = np.linalg.solve(np.eye(2) - turn, middles[1] - turn @ middles[0])
    return Jaw(hinge=np.array([0.0, *centre]), angle=float(np.arctan2(turn[1, 0], turn[0, 0])))


def eye_centre(model: Model, side: str) -> Floats:
    """(3,) of the ball of an eye, whatever its cornea does."""
    part = next(part for part in KEPT if part.mesh == f"Eyeball{side}")
    return fit_ball(model.points[slice(*part.points)]).centre


@dataclass(frozen=True, kw_only=True)
class Tongue:
    """The k points of the tongue, which is an island of texture coordinates on the mesh of the gums."""

    points: Ints  # (k,)
    along: Floats  # (k,) 0 at the root, 1 at the tip
    free: Floats  # (k,) 0 where it has grown to the floor of the mouth, 1 from a centimetre on


def tongue_of(model: Model) -> Tongue:
    """The island that the last point of the gums' mesh is on."""
    corners = slice(*np.cumsum(model.counts)[np.array(GUMS.faces) - 1])
    points, uvs = model.indices[corners], model.uv_indices[corners]
    counts = model.counts[slice(*GUMS.faces)]
    following = np.arange(1, len(points) + 1)
    following[np.cumsum(counts) - 1] = np.cumsum(counts) - counts
    size = len(model.uvs)
    links = coo_array((np.ones(len(uvs)), (uvs, uvs[following])), shape=(size, size))
    island = connected_components(links, directed=False)[1][uvs]
    mine = island == island[points == GUMS.points[1] - 1][0]
    own = np.unique(points[mine])
    seam = np.intersect1d(own, points[~mine])
    depth = model.points[own, 2]
    away = cKDTree(model.points[seam]).query(model.points[own])[0]
    return Tongue(points=own, along=(depth - depth.min()) / np.ptp(depth), free=smooth(away))


def smooth(values: Floats) -> Floats:
    """0 up to 0, 1 from 1 on, smooth between."""
    t = np.clip(values, 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))
