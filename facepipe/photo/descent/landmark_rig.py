"""The few points of a face that its landmarks need, and how they fall onto a photo.

Landmarks 0 to 16 of the Multi-PIE scheme lie on the contour of the face. Where that turns away from the viewer, the
contour that a photo shows is another line on the skin, nearer to the front: such a landmark slides there, along the
row of points that it lies in (after Zhu et al., "High-Fidelity Pose and Expression Normalization", CVPR 2015).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.parts import FaceParts
from facepipe.photo.descent.subject import Subject
from facepipe.photo.renderer.camera import Camera
from facepipe.rig import Rig
from facepipe.rig.torch.rig import DifferentiableRig

SCHEME, DENSE = "multipie68", "dense"
COUNT = 68
CONTOUR = slice(0, 17)
_ROW = 0.012  # of the head height: half the width of a row
_STATIONS = 24  # at which a row may have a point
_INWARD = 0.22  # of the head height that a row reaches towards the middle and the front


@dataclass(frozen=True, kw_only=True)
class LandmarkRig:
    """Points of the landmarks, of the contour's rows, and of dense landmarks, as a rig of its own in float64."""

    rig: DifferentiableRig
    rows: tuple[IntArray, ...]  # 17 rows of numbers among the rig's points, each with the landmark itself
    dense: slice  # of the rig's points: those that are landmarks beside the 68

    @classmethod
    def from_subject(cls, subject: Subject, *, dense: bool = False) -> LandmarkRig:
        """
        :param dense: whether the points of the scheme `DENSE` are landmarks too
        :raises InputError: the face lacks the 68 landmarks
        """
        parts = subject.parts
        points, mesh = landmark_points(parts)
        rows = [_row(subject, points, number, mesh) for number in range(CONTOUR.stop)]
        first = np.cumsum([COUNT, *map(len, rows)])
        more = dense_points(parts) if dense else points[:0]
        chosen = np.concatenate([points, *rows, more])
        numbers = tuple(
            np.concatenate([[k], np.arange(first[k], first[k + 1])]).astype(np.int64) for k in range(CONTOUR.stop)
        )
        rig = DifferentiableRig(
            subject.rig.part(chosen), parts.sliders, network=parts.slider_network, dtype=torch.float64
        )
        return cls(rig=rig, rows=numbers, dense=slice(int(first[-1]), int(first[-1]) + len(more)))

    def landmarks(self, points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
        """(..., l, 2) pixels of the 68 landmarks, and the dense ones, of the rig's points (..., m, 3), and (..., 17, 2)
        directions across the contour, outwards; landmarks with gradients, but not of the directions and the choice of
        points."""
        screen = camera.project(points)[..., :2]
        labelled = screen[..., :COUNT, :]
        outward = contour_normals(labelled[..., CONTOUR, :].detach())
        places = screen.detach()[..., self.stations, :]
        reach = (places * outward[..., None, :]).sum(dim=-1)
        # of stations that reach as far, the first, as rows are filled up by theirs
        chosen = self.stations.expand_as(reach).gather(-1, reach.argmax(dim=-1, keepdim=True))[..., 0]
        contour = screen.gather(-2, chosen[..., None].expand(*chosen.shape, 2))
        return torch.cat([contour, labelled[..., CONTOUR.stop :, :], screen[..., self.dense, :]], dim=-2), outward

    @cached_property
    def stations(self) -> Tensor:
        """(17, k) `rows`, each filled up by its first number to the length of the longest."""
        longest = max(map(len, self.rows))
        return torch.as_tensor(np.stack([np.append(row, np.full(longest - len(row), row[0])) for row in self.rows]))


def landmark_points(parts: FaceParts) -> tuple[IntArray, int]:
    """(68,) points of the face's landmarks, meshes concatenated, and the number of the mesh that has them.

    :raises InputError: no mesh has them, or not all of them
    """
    start = 0
    for number, mesh in enumerate(parts.meshes):
        if SCHEME in mesh.landmarks:
            indices = np.asarray(mesh.landmarks[SCHEME].indices, dtype=np.int64)
            if len(indices) != COUNT or indices.min() < 0 or indices.max() >= len(mesh.points):
                raise InputError(
                    f"{mesh.name} -> landmarks {SCHEME}", f"{len(indices)}, expected {COUNT} of its points"
                )
            return indices + start, number
        start += len(mesh.points)
    raise InputError(
        f"{parts.name} -> landmarks", f"no scheme {SCHEME}, expected its {COUNT} (`facepipe landmarks --help`)"
    )


def dense_points(parts: FaceParts) -> IntArray:
    """(d,) points of the face's landmarks of the scheme `DENSE`, meshes concatenated; none where it has none."""
    start, found = 0, [np.zeros(0, np.int64)]
    for mesh in parts.meshes:
        if DENSE in mesh.landmarks:
            found.append(start + np.asarray(mesh.landmarks[DENSE].indices, dtype=np.int64))
        start += len(mesh.points)
    return np.concatenate(found)


def contour_normals(contour: Tensor) -> Tensor:
    """(..., 17, 2) unit directions across a contour (..., 17, 2) in pixels, away from its middle."""
    along = torch.cat(
        [
            contour[..., 1:2, :] - contour[..., :1, :],
            contour[..., 2:, :] - contour[..., :-2, :],
            contour[..., -1:, :] - contour[..., -2:-1, :],
        ],
        dim=-2,
    )
    across = torch.stack([-along[..., 1], along[..., 0]], dim=-1)
    across = across / torch.linalg.vector_norm(across, dim=-1, keepdim=True).clamp(min=1e-9)
    middle = contour.mean(dim=-2, keepdim=True)
    outer = ((contour - middle) * across).sum(dim=-1, keepdim=True)
    return torch.where(outer < 0, -across, across)


def _row(subject: Subject, points: IntArray, number: int, mesh: int) -> IntArray:
    """Points of the skin that contour landmark `number` may slide to: inwards and to the front of where it is."""
    parts, rig = subject.parts, subject.rig
    x, y, z = front_axes(parts, rig)
    first, last = rig.mesh_offsets[mesh : mesh + 2]
    contour = torch.as_tensor(np.stack([x[points[CONTOUR]], -y[points[CONTOUR]]], axis=1))
    nx, ny = contour_normals(contour)[number].numpy() * (1, -1)
    at = points[number]
    row = np.arange(first, last)
    dx, dy, dz = x[row] - x[at], y[row] - y[at], z[row] - z[at]
    size = float(np.ptp(y[np.unique(points)])) / 0.5  # brow to chin is about half of a head
    across, outward = np.abs(dx * ny - dy * nx), dx * nx + dy * ny
    near = (across < _ROW * size) & (outward > -_INWARD * size) & (outward < 0.02 * size)
    near &= (dz > 0) & (dz < _INWARD * size)
    chosen: IntArray = row[near]
    forward = dz[near]
    if not len(chosen):
        return chosen
    # at most `_STATIONS` points, spread towards the front, those nearest to the middle of the row
    station = np.minimum((forward / forward.max() * _STATIONS).astype(np.int64), _STATIONS - 1)
    order = np.lexsort((across[near], station))
    _, nearest = np.unique(station[order], return_index=True)
    return np.asarray(chosen[order[nearest]])


def front_axes(parts: FaceParts, rig: Rig) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The rest points' right, up and front coordinates as the face looks at the viewer, in world space."""
    world = rig.points @ rig.parent_world[:3, :3].T + rig.parent_world[:3, 3]
    if parts.up_axis == "Z":
        return world[:, 0], world[:, 2], -world[:, 1]
    return world[:, 0], world[:, 1], world[:, 2]
