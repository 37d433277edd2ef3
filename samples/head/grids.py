"""Grids of cards, and the skin that holds every point of them.

A set of cards is a number of layers of grids, all of a layer (rows, columns). Its arrays: three skin points and their
shares (two of them, in 255ths) that hold each point; the offset from there (STEP cm); texture coordinates (65535ths).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from skin_maps import BACK, FACE, Template

from facepipe.geometry.closest_points import closest_places, place_shares
from facepipe.heads.asset import STEP

Array = Any


@dataclass(frozen=True)
class Grids:
    """Cards of one set before they are bound: points and texture coordinates, (cards, rows, columns, ...)."""

    points: Array
    uv: Array
    held: Array  # where each point holds on to the skin


class Binder:
    """Finds what holds points."""

    def __init__(self, template: Template, allowed: Array) -> None:
        """:param allowed: (n,) points of the template that may hold any"""
        self._template = template
        self._triangles = template.triangles[allowed[template.triangles].all(axis=1)]

    def arrays(self, name: str, grids: Sequence[Grids]) -> dict[str, Array]:
        """The arrays of a set of layers."""
        points, held, uv = (
            np.concatenate([getattr(one, kind).reshape(-1, size) for one in grids])
            for kind, size in (("points", 3), ("held", 3), ("uv", 2))
        )
        found = closest_places(held, self._template.points, self._triangles)
        corners = self._triangles[found.triangles]
        shares = np.rint(255 * place_shares(found, self._template.points, self._triangles)[:, :2]).astype(np.uint8)
        exact = np.column_stack([shares / 255, 1 - shares.sum(axis=1) / 255])
        offsets = points - np.einsum("nk,nkc->nc", exact, self._template.points[corners])
        return {
            f"{name}_grids": np.array([one.points.shape[:3] for one in grids], np.int32),
            f"{name}_corners": corners.astype(np.uint16),
            f"{name}_shares": shares,
            f"{name}_offsets": np.rint(offsets / STEP).astype(np.int16),
            f"{name}_uv": np.rint(65535 * uv).astype(np.uint16),
        }


class Skin:
    """The head's outside, smooth."""

    def __init__(self, template: Template, without: Array | None = None) -> None:
        """:param without: (n,) points of the template that hair passes by, as it does ears"""
        used = np.unique(np.concatenate([template.used(FACE), template.used(BACK)]))
        if without is not None:
            used = used[~without[used]]
        self._points, self._normals = template.points[used], template.normals[used]
        self._tree = cKDTree(self._points)

    def under(self, at: Array) -> tuple[Array, Array]:
        """Heights (n,) of places above the skin, and the normals (n, 3) there."""
        away, near = self._tree.query(at, k=6)
        share = 1 / (away + 1e-3) ** 2
        share /= share.sum(axis=1, keepdims=True)
        normals = np.einsum("nk,nkc->nc", share, self._normals[near])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return np.einsum("nk,nkc,nc->n", share, at[:, None] - self._points[near], normals), normals
