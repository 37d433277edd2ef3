"""Triangles of every style of hair, and how much scalp shows through it: `python benchmarks/hair_cover.py [STYLE ...]`.

Parallel rays from the front, the side and behind end in places of the average head's scalp that face them: the share of
them that no texel of a card stops, at the threshold of the material.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.spatial import cKDTree

from facepipe.core.images import open_image
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.heads.assembly import average
from facepipe.heads.asset import arrays
from facepipe.heads.people import STYLES
from facepipe.heads.skin import TILES, masks
from facepipe.heads.surfaces import CUT, Cards, card_triangles, cards, picture_of
from facepipe.parts import Mesh

VIEWS = {"front": (0.0, 0.0, 1.0), "side": (1.0, 0.0, 0.0), "back": (0.0, 0.0, -1.0)}
_FACING = 0.3  # cosine to the ray
_INSIDE = 0.99  # of the mask of the scalp, which fades out at the hairline
_EVERY = 5  # texel


def scalp(head: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 3) on the scalp behind the hairline and the normals there."""
    maps, found = arrays("skin_maps"), []
    for number, tile in enumerate(TILES):
        found.append(maps[f"{tile}_places"][masks(number, 2)["scalp"] > _INSIDE][::_EVERY].astype(float))
    places = np.concatenate(found)
    triangles = point_triangles(head.face_vertex_counts, head.face_vertex_indices)
    return places, point_normals(head.points, triangles)[cKDTree(head.points).query(places)[1]]


def _cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]


def seen(style: str, head: Mesh, points: np.ndarray, towards: np.ndarray) -> float:
    """Share of the points (n, 3) that no card hides on the way towards a viewer."""
    held: Cards = cards(style)
    picture = open_image(picture_of(STYLES[style][1]).image(), style).convert("RGBA").getchannel("A")
    alpha = np.asarray(picture) / 255
    across = np.linalg.svd(towards[None])[2][1:]
    places = held.carry(head.points) + held.offsets
    triangles = card_triangles(held)
    a, b, c = ((places @ across.T)[triangles[:, i]] for i in range(3))
    depth, uv = (places @ towards)[triangles], held.uv[triangles]
    area = _cross(b - a, c - a)
    hidden = np.zeros(len(points), bool)
    for number, (at, height) in enumerate(zip(points @ across.T, points @ towards, strict=True)):
        second, third = _cross(at - a, c - a) / area, _cross(b - a, at - a) / area
        hit = np.flatnonzero((second >= 0) & (third >= 0) & (second + third <= 1))
        shares = np.column_stack([1 - second[hit] - third[hit], second[hit], third[hit]])
        before = np.einsum("tk,tk->t", shares, depth[hit]) > height
        u, v = np.einsum("tk,tkc->ct", shares, uv[hit])
        row, column = ((1 - v) * len(alpha)).astype(int), (u * alpha.shape[1]).astype(int)
        hidden[number] = bool((before & (alpha[row, column] > CUT)).any())
    return float(1 - hidden.mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("styles", nargs="*", default=[style for style, (_, picture) in STYLES.items() if picture])
    arguments = parser.parse_args()
    head = average().meshes[0]
    points, normals = scalp(head)
    print("| style | triangles | " + " | ".join(f"scalp seen, {view}" for view in VIEWS) + " |")
    print("|---|---|" + "---|" * len(VIEWS))
    for style in arguments.styles:
        shares = []
        for towards in map(np.array, VIEWS.values()):
            facing = normals @ towards > _FACING
            shares.append(f"{seen(style, head, points[facing], towards):.1%}")
        print(f"| {style} | {len(card_triangles(cards(style)))} | " + " | ".join(shares) + " |")


if __name__ == "__main__":
    main()
