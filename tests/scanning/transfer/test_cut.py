"""A mouth that triangles or quads seal is cut along edges of its own, and all that is known by point goes along."""

from dataclasses import replace

import numpy as np
import pytest

from facepipe.core.errors import FitError
from facepipe.geometry.polygons import components, point_triangles
from facepipe.parts import Blendshape, FaceParts, Landmarks, Mesh, Skeleton, Skin, UvSet
from facepipe.scanning.transfer.cut import with_cut_mouth
from facepipe.scanning.transfer.head import Head
from facepipe.scans import ScanLandmarks
from facepipe.verbs.skin.surface import surface_of
from facepipe.verbs.whole_faces import whole_points

_ROWS, _COLUMNS = 9, 13  # a sheet of quads, 10 mm apart, that bulges towards +Z


def _sheet(*, quads: bool = True, seam: bool = False) -> FaceParts:
    x, y = np.meshgrid(np.arange(_COLUMNS) - 6.0, np.arange(_ROWS) - 4.0)
    points = np.stack([x.ravel(), y.ravel(), 3.0 - 0.05 * (x**2 + y**2).ravel()], axis=1)
    number = np.arange(_ROWS * _COLUMNS).reshape(_ROWS, _COLUMNS)
    corners = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], axis=-1).reshape(-1, 4)
    if not quads:
        corners = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    if seam:  # as files of triangles have it: points beyond a seam of UVs are others at the same places
        other = points[corners].mean(axis=1)[:, 0] > 0
        used, again = np.unique(corners[other], return_inverse=True)
        points, start = np.concatenate([points, points[used]]), len(points)
        corners[other] = start + again.reshape(-1, corners.shape[1])
    shape = Blendshape(
        name="up", point_indices=np.arange(len(points)), offsets=np.tile([0.0, 0.1, 0.0], (len(points), 1))
    )
    mesh = Mesh(
        name="Sheet",
        points=points,
        face_vertex_counts=np.full(len(corners), corners.shape[1], np.int32),
        face_vertex_indices=corners.ravel().astype(np.int32),
        uv_sets=(UvSet(values=points[:, :2]),),
        colors=np.abs(points) / 10,
        skin=Skin(joint_indices=np.zeros((len(points), 1), np.int32), joint_weights=np.ones((len(points), 1))),
        blendshapes=(shape,),
        regions={"mouth": np.ones(len(points))},
        point_subsets={"all": np.arange(len(points), dtype=np.int32)},
    )
    eye = np.eye(4)[None]
    joint = Skeleton(joints=("head",), bind_transforms=eye, rest_transforms=eye)
    return FaceParts(meshes=(mesh,), skeleton=joint)


def _head(parts: FaceParts, *, reach: float = 30.0) -> Head:
    """With lips from -`reach` to `reach` mm, and a nose above."""
    marks = np.full((68, 3), np.nan)
    for number, x in {60: -1.0, 61: -0.5, 62: 0.0, 63: 0.5, 64: 1.0, 65: 0.5, 66: 0.0, 67: -0.5}.items():
        off = 0.0 if number in (60, 64) else 1.0 if number < 64 else -1.0
        marks[number] = [x * reach, off, 30.0]
    marks[27:36], marks[48:55], marks[55:60] = [0.0, 30.0, 30.0], [0.0, 10.0, 30.0], [0.0, -10.0, 30.0]
    landmarks = ScanLandmarks(points=marks)
    surface = surface_of(parts, "sheet")
    return Head(
        where="sheet",
        parts=parts,
        points=whole_points(parts),
        surface=surface,
        turned=np.zeros(len(surface.triangles), bool),
        landmarks=landmarks,
        source="",
        notes=(),
    )


@pytest.mark.parametrize("quads", [True, False])
@pytest.mark.parametrize("seam", [True, False])
def test_faces_above_and_below_share_no_inner_point_of_the_slit(quads: bool, seam: bool) -> None:
    parts = _sheet(quads=quads, seam=seam)
    (mesh,) = with_cut_mouth(_head(parts)).meshes
    before = parts.meshes[0]
    middles = np.add.reduceat(
        before.points[before.face_vertex_indices],
        np.cumsum(before.face_vertex_counts) - before.face_vertex_counts[0],
        axis=0,
    )
    middles /= before.face_vertex_counts[0]
    faces = mesh.face_vertex_indices.reshape(len(before.face_vertex_counts), -1)
    near = np.abs(middles[:, 0]) < 3
    above, below = faces[near & (middles[:, 1] > 0)], faces[near & (middles[:, 1] < 0)]
    ends = np.flatnonzero(np.isclose(np.abs(mesh.points[:, 0]), 3.0))
    assert set(np.intersect1d(above, below)) <= set(ends)
    # every copy lies a little under the point above it, at most 0.02 mm, and nothing else has moved
    count = len(before.points)
    assert len(mesh.points) > count
    moved = np.linalg.norm(mesh.points[:count] - before.points, axis=1)
    assert moved.max() * 10 < 0.02
    assert (mesh.points[count:, 1] < 0).all()
    # corner to corner at the ends one surface still hangs together
    pairs = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
    pieces = components(len(mesh.points), np.concatenate([pairs[:, :2], pairs[:, 1:]]))
    assert len(np.unique(pieces[mesh.face_vertex_indices])) == (2 if seam else 1)


def test_what_is_known_of_a_point_is_known_of_its_copy() -> None:
    parts = _sheet()
    marks = Landmarks(indices=np.full(68, 4 * _COLUMNS + 6, np.int32))
    parts = replace(parts, meshes=(replace(parts.meshes[0], landmarks={"multipie68": marks}),))
    (mesh,) = with_cut_mouth(_head(parts)).meshes
    before = parts.meshes[0]
    count, total = len(before.points), len(mesh.points)
    originals = [int(np.linalg.norm(before.points - point, axis=1).argmin()) for point in mesh.points[count:]]
    np.testing.assert_array_equal(mesh.uv_sets[0].values[count:], before.uv_sets[0].values[originals])
    np.testing.assert_array_equal(mesh.colors[count:], before.colors[originals])
    assert len(mesh.skin.joint_weights) == len(mesh.regions["mouth"]) == total
    np.testing.assert_array_equal(mesh.blendshapes[0].point_indices, np.arange(total))
    np.testing.assert_array_equal(mesh.point_subsets["all"], np.arange(total))
    indices = mesh.landmarks["multipie68"].indices
    assert indices[66] >= count
    assert indices[62] == 4 * _COLUMNS + 6


def test_a_mouth_within_one_face_is_refused() -> None:
    with pytest.raises(FitError, match="no edges at the mouth"):
        with_cut_mouth(_head(_sheet(), reach=4.0))


def test_unknown_lips_are_refused() -> None:
    head = _head(_sheet())
    points = np.array(head.landmarks.points)
    points[62] = np.nan
    with pytest.raises(FitError, match="landmarks of nose and lips"):
        with_cut_mouth(replace(head, landmarks=ScanLandmarks(points=points)))
