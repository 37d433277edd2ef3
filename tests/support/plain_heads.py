"""A face made of formulas, in millimetres, with almond eyes over balls, a slit for a mouth, and pieces beside it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import trimesh
from scipy.spatial import Delaunay

BALL, LID = 12.5, 1.0  # radius of an eyeball, and how far lids lie over it
EYES = {"Left": np.array([32.0, 35.0]), "Right": np.array([-32.0, 35.0])}
MOUTH = np.array([0.0, -30.0])
_DEEP = -12.0  # z of the middle of eyeballs
_ALMOND = np.array([11.0, 4.5])
_SLIT = np.array([22.0, 1.0])


@dataclass(frozen=True)
class PlainHead:
    """n points of skin and pieces, with the name of the piece of each."""

    points: np.ndarray  # (n, 3)
    triangles: np.ndarray  # (t, 3)
    landmarks: np.ndarray  # (68, 3)
    part: np.ndarray  # (n,) into names
    names: tuple[str, ...]

    def of(self, name: str) -> np.ndarray:
        """Points of a piece."""
        return np.flatnonzero(self.part == self.names.index(name))


def _rim(half: np.ndarray, count: int, grow: float = 0.0) -> np.ndarray:
    """(count, 2) places around an opening with two corners."""
    turn = 2 * np.pi * np.arange(count) / count
    x = half[0] * np.cos(turn)
    y = half[1] * np.sign(np.sin(turn)) * (1 - (x / half[0]) ** 2)
    outward = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return np.stack([x, y], axis=1) + grow * outward


def height(places: np.ndarray) -> np.ndarray:
    """(n,) z of the face over (n, 2) places: a dome, and over eyes a ball."""
    base = -(places[:, 0] ** 2) / 220.0 - places[:, 1] ** 2 / 400.0 + 8.0
    for centre in EYES.values():
        away = np.linalg.norm(places - centre, axis=1)
        over = _DEEP + np.sqrt(np.maximum((BALL + LID) ** 2 - away**2, 0.0))
        share = np.clip((18.0 - away) / 7.0, 0.0, 1.0)
        share = share * share * (3 - 2 * share)
        base = share * over + (1 - share) * base
    return base


@cache
def skin(*, spacing: float = 3.2, holes: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles of the face; `holes`: with openings for eyes and mouth, else they are sealed."""
    openings = [(EYES["Left"], _ALMOND, 40), (EYES["Right"], _ALMOND, 40), (MOUTH, _SLIT, 48)]
    x, y = np.meshgrid(np.arange(-66.0, 66.1, spacing), np.arange(-80.0, 75.1, spacing))
    grid = np.stack([x.ravel(), y.ravel()], axis=1)
    grid = grid[(grid[:, 0] / 66) ** 2 + ((grid[:, 1] + 2) / 78) ** 2 <= 1.0]
    rings = []
    for centre, half, count in openings:
        scaled = (grid - centre) / (half + 7.0)
        grid = grid[(scaled**2).sum(axis=1) > 1.0]
        rings += [centre + _rim(half, count, grow) for grow in (0.0, 0.8, 2.0, 3.6, 5.5)]
    places = np.concatenate([grid, *rings])
    triangles = Delaunay(places).simplices
    middle = places[triangles].mean(axis=1)
    for centre, half, _ in openings if holes else ():
        offset = np.abs(middle - centre) / half
        inside = (offset[:, 0] < 1) & (offset[:, 1] < 1 - offset[:, 0] ** 2)
        triangles, middle = triangles[~inside], middle[~inside]
    a, b, c = np.moveaxis(places[triangles], 1, 0)
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    turned = ux * vy - uy * vx < 0
    triangles[turned] = triangles[turned][:, ::-1]
    return np.column_stack([places, height(places)]), triangles.astype(np.int64)


def landmarks() -> np.ndarray:
    """(68, 3) of the face."""
    turn = np.linspace(np.pi, 2 * np.pi, 17)
    jaw = np.stack([60 * np.cos(turn), 10 + 75 * np.sin(turn)], axis=1)
    brow = np.stack([np.linspace(-16, 16, 5), 15.0 - np.linspace(-1, 1, 5) ** 2 * 3], axis=1)
    nose = [[0, y] for y in (28, 18, 8, 0)] + [[x, -6] for x in (-10, -5, 0, 5, 10)]
    eye = _rim(_ALMOND, 6)[[3, 2, 1, 0, 5, 4]]
    outer = _rim(_SLIT, 12, 4.0)[[6, 5, 4, 3, 2, 1, 0, 11, 10, 9, 8, 7]]
    inner = _rim(_SLIT, 8)[[4, 3, 2, 1, 0, 7, 6, 5]]
    flat = np.concatenate(
        [jaw, EYES["Right"] + brow, EYES["Left"] + brow, nose, EYES["Right"] + eye, EYES["Left"] + eye,
         MOUTH + outer, MOUTH + inner]
    )  # fmt: skip
    return np.column_stack([flat, height(flat)])


def _strip(places: np.ndarray, away: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A card along (k, 3) places whose other edge lies `away` from there."""
    k = len(places)
    number = np.arange(k - 1)
    triangles = np.concatenate(
        [np.stack([number, number + 1, number + k], 1), np.stack([number + 1, number + k + 1, number + k], 1)]
    )
    return np.concatenate([places, places + away]), triangles


def solids(bite: float = 0.0) -> dict[str, list[tuple[np.ndarray, np.ndarray]]]:
    """Pieces beside the skin by name; `bite`: mm that both rows of teeth lie higher than the slit's middle."""
    made: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}

    def put(
        name: str, mesh: trimesh.Trimesh | tuple[np.ndarray, np.ndarray], at: tuple[float, ...] = (0, 0, 0)
    ) -> None:
        points, triangles = mesh if isinstance(mesh, tuple) else (mesh.vertices, mesh.faces)
        made.setdefault(name, []).append((np.asarray(points, float) + at, np.asarray(triangles, np.int64)))

    for side, (x, y) in EYES.items():
        put(f"eye{side}", trimesh.creation.icosphere(subdivisions=3, radius=BALL), (x, y, _DEEP))
        rim = _rim(_ALMOND, 40)
        upper = rim[rim[:, 1] > 0.3] + (x, y)
        put(f"lashes{side}", _strip(np.column_stack([upper, height(upper) + 0.2]), np.array([0.0, 3.0, 6.0])))
        brow = np.stack([np.linspace(x - 16, x + 16, 9), np.full(9, y + 14.0)], axis=1)
        put(f"brow{side}", _strip(np.column_stack([brow, height(brow) + 0.6]), np.array([0.0, 4.0, 0.2])))
        put("glasses", trimesh.creation.annulus(20.0, 23.0, 3.0), (x, y, 24.0))
    for i, turn in enumerate(np.radians(np.linspace(20, 160, 10))):
        at = (22 * np.cos(turn), MOUTH[1] + bite, -26 + 18 * np.sin(turn))
        put("upper", trimesh.creation.box((4.5, 9.0, 4.0)), (at[0], at[1] + 4.8, at[2] + 1.0 + 0.01 * i))
        put("lower", trimesh.creation.box((4.5, 9.0, 4.0)), (at[0], at[1] - 4.8, at[2]))
    tongue = trimesh.creation.icosphere(subdivisions=2)
    put("tongue", (tongue.vertices * (13.0, 4.0, 20.0), tongue.faces), (0, MOUTH[1] + bite - 5.0, -32.0))
    put("hat", trimesh.creation.cylinder(40.0, 12.0), (0, 85.0, -40.0))
    return made


def head(*, names: tuple[str, ...] = (), bite: float = 0.0, holes: bool = True) -> PlainHead:
    """The skin and the pieces `names` (default all)."""
    pieces = {"skin": [skin(holes=holes)], **solids(bite)}
    kept = {name: pieces[name] for name in ("skin", *(names or tuple(pieces)[1:]))}
    points, triangles, part, count = [], [], [], 0
    for number, meshes in enumerate(kept.values()):
        for own, faces in meshes:
            points.append(own)
            triangles.append(faces + count)
            part.append(np.full(len(own), number))
            count += len(own)
    return PlainHead(np.concatenate(points), np.concatenate(triangles), landmarks(), np.concatenate(part), tuple(kept))
