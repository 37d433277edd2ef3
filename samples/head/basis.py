"""What persons as payloads are relative to: the average head, modes, levels of its points, parts that stay rigid."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from model import KEPT, Model
from packing import STEP
from skeleton import Skeleton

from facepipe.geometry.point_levels import PointLevels
from facepipe.payload.basis import BasisContent, JointPlace, MeshRun, RigidRows
from facepipe.verbs.whole_faces import Topology

_NAME = "the built-in head"
_CM = 10  # millimetres
_GRID = 100_000  # places in a millimetre, as many as ICT-FaceKit has
_CARRIED = ("Teeth", "GumsAndTongue")  # by one placement, after modes
_BALLS = ("EyeballLeft", "EyeballRight")  # the mean's, moved: they stay balls


def basis(model: Model, modes: npt.NDArray[np.int16], made: Skeleton) -> BasisContent:
    """The basis, with modes (k, 3, n) in steps."""
    topology = _topology(model)
    ends = np.cumsum(topology.points)
    points = {
        name: np.arange(end - count, end)
        for name, count, end in zip(topology.names, topology.points, ends, strict=True)
    }
    places = np.rint(_CM * _GRID * model.points.astype(np.float32).astype(np.float64)).astype(np.int64)
    carried = np.sort(np.concatenate([points[name] for name in _CARRIED]))
    balls = [points[name] for name in _BALLS]
    some = np.setdiff1d(np.arange(len(places)), np.concatenate(balls))
    levels = PointLevels.of(places / _GRID, topology.triangles, some)
    joints = []
    for path, rows, shares in zip(made.joints, made.points, made.shares.astype(np.float32), strict=True):
        joints.append(JointPlace(path, rows[shares != 0].astype(np.int64), shares[shares != 0].astype(np.float64)))
    return BasisContent(
        name=_NAME,
        meshes=tuple(map(MeshRun, topology.names, topology.points)),
        topology=bytes.fromhex(topology.digest.removeprefix("sha256:")),
        grid=_GRID,
        places=places,
        coarsest=levels.first,
        levels=levels.levels,
        step=float(np.float32(_CM * STEP)),
        modes=modes,
        parts=(RigidRows(carried, with_modes=True), *(RigidRows(rows, with_modes=False) for rows in balls)),
        joints=tuple(joints),
    )


def _topology(model: Model) -> Topology:
    names = list(dict.fromkeys(part.mesh for part in KEPT))
    first, last = {part.mesh: part for part in reversed(KEPT)}, {part.mesh: part for part in KEPT}
    corners = np.append(0, np.cumsum(model.counts, dtype=np.int64))
    points, counts, indices = [], [], []
    for name in names:
        start, end = first[name].points[0], last[name].points[1]
        face, after = first[name].faces[0], last[name].faces[1]
        points.append(end - start)
        counts.append(model.counts[face:after].astype(np.int32))
        indices.append((model.indices[corners[face] : corners[after]] - start).astype(np.int32))
    return Topology(names=tuple(names), points=tuple(points), counts=tuple(counts), indices=tuple(indices))
