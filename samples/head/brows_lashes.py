"""Cards of brows and lashes."""

from __future__ import annotations

from typing import Any

import numpy as np
from grids import Grids, Skin
from skin_maps import Template, brow_curve

from facepipe.heads.asset import STEP

Array = Any
LASHES = {"Left": (25351, 26035), "Right": (26035, 26719)}  # points of ICT-FaceKit's lashes: six grids of 6 by 19
LASH_SHAPE = (6, 19)
LASH_BANDS = {"lower": (24, 232), "upper": (280, 488)}  # rows of their picture, of 512 from the bottom, gaps between
EYE_SHAPES = ("eyeBlink", "eyeLookDown", "eyeLookUp", "eyeLookIn", "eyeLookOut", "eyeSquint", "eyeWide", "cheekSquint")


def brow_grids(template: Template, skin: Skin) -> Grids:
    """Two layers for each brow; the right one mirrored."""
    rows, columns = 7, 24
    line, _ = brow_curve(template.points)
    at = np.interp(np.linspace(-0.06, 1.08, columns), np.linspace(0, 1, len(line)), np.arange(len(line)))
    middle = np.column_stack([np.interp(at, np.arange(len(line)), line[:, c]) for c in range(3)])
    middle[0], middle[-1] = 2 * middle[1] - middle[2], 2 * middle[-2] - middle[-3]
    across = np.linspace(-1, 1, rows)[:, None, None]
    along = np.gradient(middle, axis=0)
    points = []
    for layer in (0.025, 0.07):
        flat = (
            middle + across * 0.62 * np.cross(skin.under(middle)[1], along / np.linalg.norm(along, axis=1)[:, None])
        ).reshape(-1, 3)
        for _ in range(3):
            height, normals = skin.under(flat)
            flat = flat + (layer - height)[:, None] * normals
        points.append(flat.reshape(rows, columns, 3))
    u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    uv = np.stack([u, v], axis=-1)
    left, right = np.array(points), np.array(points)[:, :, ::-1] * [-1, 1, 1]
    both = np.concatenate([left, right])
    return Grids(both, np.concatenate([[uv] * 2, [uv[:, ::-1]] * 2]), both)


def lash_grids(data: Any) -> Grids:
    """ICT-FaceKit's own strips: three of the upper and three of the lower lid of each eye, roots first."""
    points, uv = _lashes(data, data["neutral"])
    return Grids(points, uv, np.broadcast_to(points[:, :1], points.shape))


def _lashes(data: Any, values: Array) -> tuple[Array, Array]:
    corners = int(data["face_vertex_counts"].sum()) - 4 * (26384 - 25304)
    place = np.zeros((len(data["neutral"]), 2))
    place[data["face_vertex_indices"][corners:]] = data["uv"][data["face_uv_indices"][corners:]]
    grids, uvs = [], []
    for first, last in LASHES.values():
        for start in range(first, last, np.prod(LASH_SHAPE)):
            one = slice(start, start + int(np.prod(LASH_SHAPE)))
            rank = np.round(18 * _unit(place[one, 0])) - 100 * np.round(5 * _unit(place[one, 1]))
            order = start + np.argsort(rank)
            grids.append(values[order].reshape(*LASH_SHAPE, 3))
            low, high = LASH_BANDS["lower" if (start - first) // int(np.prod(LASH_SHAPE)) >= 3 else "upper"]
            u, v = np.meshgrid(np.linspace(0, 1, 19), np.linspace(low, high, 6) / 512)
            uvs.append(np.stack([u, v], axis=-1))
    return np.array(grids, float), np.array(uvs)


def _unit(values: Array) -> Array:
    return (values - values.min()) / np.ptp(values)


def lash_motion(data: Any, arrays: dict[str, Array]) -> dict[str, Array]:
    """How the shapes of the eyes move lashes beside what holds them."""
    names, found = list(data["expression_names"]), {}
    corners = arrays["lashes_corners"].astype(int)
    shares = arrays["lashes_shares"] / 255
    shares = np.column_stack([shares, 1 - shares.sum(axis=1)])
    for name in EYE_SHAPES:
        for side in ("Left", "Right"):
            move = data["expression_deltas"][names.index(f"{name}_{side[0]}")].astype(float)
            own = _lashes(data, move)[0].reshape(-1, 3) - np.einsum("nk,nkc->nc", shares, move[corners])
            own[np.linalg.norm(own, axis=1) < 3 * STEP] = 0.0  # rounding noise of the source
            found[f"lashes_{name}{side}"] = np.rint(own / STEP).astype(np.int16)
    return found
