"""A face with all that lower levels keep: lips that touch, a UV seam, materials that meet, an eyeball, an inbetween."""

from __future__ import annotations

import numpy as np
from solids import ball

from facepipe.parts import (
    Blendshape,
    FaceParts,
    Inbetween,
    Landmarks,
    Material,
    MaterialFaces,
    Mesh,
    Skeleton,
    Skin,
    UvSet,
)

SIDE = 33  # points across the face, which is 64 units wide
OPEN = 12.0  # that the lower lip drops
MILLIMETRES = 3.0  # in a unit


def face_with_lips() -> FaceParts:
    """A dome, its mouth closed: the points of both lips lie on one another, and are two."""
    grid = np.arange(-(SIDE // 2), SIDE // 2 + 1) * 2.0
    x, y = (one.ravel() for one in np.meshgrid(grid, grid))
    number = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    corners = [number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]]
    quads = np.stack([corner.ravel() for corner in corners], axis=1)
    lips = np.flatnonzero((y == 0) & (np.abs(x) < 16))
    lower = np.concatenate([np.arange(SIDE * SIDE), SIDE * SIDE + np.arange(len(lips))])
    x, y = np.concatenate([x, x[lips]]), np.concatenate([y, y[lips]])
    below = y[quads].mean(axis=1) < 0
    doubles = dict(zip(lips.tolist(), lower[SIDE * SIDE :].tolist(), strict=True))
    quads[below] = [[doubles.get(point, point) for point in quad] for quad in quads[below].tolist()]
    points = np.stack([x, y, 20 - (x**2 + y**2) / 60], axis=1).astype(np.float32)
    is_lower = (y < 0) | (lower >= SIDE * SIDE)
    drop = np.where(is_lower, OPEN * np.exp(-(y**2) / 200) * np.clip(1 - (x / 16) ** 2, 0, 1), 0.0)
    return FaceParts(
        name="Lips",
        meters_per_unit=MILLIMETRES / 1000,
        meshes=(_skin(points, quads, drop), _eyeball()),
        skeleton=Skeleton(
            joints=("head", "head/jaw"),
            bind_transforms=np.stack([np.eye(4)] * 2),
            rest_transforms=np.stack([np.eye(4)] * 2),
        ),
        materials=tuple(Material(name=name) for name in ("left", "right", "white", "iris")),
        attribution="(c) nobody",
    )


def _skin(points: np.ndarray, quads: np.ndarray, drop: np.ndarray) -> Mesh:
    moved = np.flatnonzero(drop > 0).astype(np.int32)
    offsets = -drop[moved, None] * np.float32([0, 1, 0])
    half = Inbetween(name="half", weight=0.5, offsets=(0.5 * offsets + np.float32([0, 0, 2])).astype(np.float32))
    middle = points[quads].mean(axis=1)
    left = middle[:, 0] > 0
    plain = points[:, :2] / 64 + 0.5
    uvs = np.concatenate([plain, plain + np.float32([1, 0])])  # the right half has a tile of its own
    jaw = np.clip(-points[:, 1] / 32, 0, 1)
    return Mesh(
        name="Face",
        points=points,
        face_vertex_counts=np.full(len(quads), 4, np.int32),
        face_vertex_indices=quads.astype(np.int32).ravel(),
        uv_sets=(
            UvSet(values=uvs, indices=(quads + np.where(left, 0, len(points))[:, None]).astype(np.int32).ravel()),
        ),
        skin=Skin(
            joint_indices=np.tile(np.int32([0, 1]), (len(points), 1)), joint_weights=np.stack([1 - jaw, jaw], axis=1)
        ),
        blendshapes=(
            Blendshape(name="open", point_indices=moved, offsets=offsets.astype(np.float32), inbetweens=(half,)),
        ),
        regions={"jaw": jaw, "rest": 1 - jaw},
        point_subsets={"lips": moved},
        landmarks={"marks": Landmarks(indices=np.int32([3, 200, 700]), names=("a", "b", "c"))},
        anchor=5,
        material_faces=tuple(
            MaterialFaces(material=name, faces=np.flatnonzero(faces).astype(np.int32))
            for name, faces in (("left", left), ("right", ~left))
        ),
    )


def _eyeball() -> Mesh:
    points, triangles = ball(16, 8.0)
    points = np.float32(points + np.array([20, 20, 16]))
    iris = points[triangles].mean(axis=1)[:, 2] > 16 + 8 * np.cos(0.6)
    return Mesh(
        name="Eye",
        points=points,
        face_vertex_counts=np.full(len(triangles), 3, np.int32),
        face_vertex_indices=triangles.astype(np.int32).ravel(),
        skin=Skin(joint_indices=np.zeros((len(points), 1), np.int32), joint_weights=np.ones((len(points), 1))),
        material_faces=tuple(
            MaterialFaces(material=name, faces=np.flatnonzero(faces).astype(np.int32))
            for name, faces in (("white", ~iris), ("iris", iris))
        ),
    )
