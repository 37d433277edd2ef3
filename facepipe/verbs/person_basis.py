"""What a person's payload is relative to: the mean face and modes that a server and a device both have."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.geometry.point_levels import PointLevels
from facepipe.heads.asset import arrays, asset, unpacked
from facepipe.importers import read_face
from facepipe.parts import FaceParts
from facepipe.payload.person import DIGEST, PersonContent
from facepipe.registry import databases
from facepipe.rig.trs import rotation_matrices
from facepipe.verbs.whole_faces import Topology, in_order, whole_points

_CM = 10.0  # millimetres
_MOST = 1e5  # millimetres from the origin: beyond it whole numbers of `PointLevels` don't hold squares
MOUTH = slice(11248, 13294)  # points of the built-in head: the mouth's inside, which modes don't fit
_CARRIED = ("Teeth", "GumsAndTongue")  # by one placement, after modes
_BALLS = ("EyeballLeft", "EyeballRight")  # the mean's, moved


@dataclass(frozen=True, kw_only=True)
class RigidPart:
    """Points that keep their shape, or that of their modes."""

    rows: IntArray
    with_modes: bool  # moved after the modes; else it is the mean's


@dataclass(frozen=True, kw_only=True)
class Basis:
    """``points = mean + sum_k w_k modes_k``, then the placement of the whole, those of parts, and offsets of points."""

    name: str
    topology: Topology
    mean: FloatArray  # (n, 3) whole points, millimetres
    modes: FloatArray  # (k, n, 3) float32
    fitted: IntArray  # (m,) points that modes are fitted to
    rigid: tuple[RigidPart, ...] = ()

    @cached_property
    def digest(self) -> bytes:
        """DIGEST bytes that differ between bases."""
        sha = hashlib.sha256(self.topology.digest.encode())
        sha.update(self.mean.astype("<f4").tobytes() + self.modes.astype("<f4").tobytes())
        for part in self.rigid:
            sha.update(part.rows.astype("<i4").tobytes() + bytes([part.with_modes]))
        return sha.digest()[:DIGEST]

    @cached_property
    def sent(self) -> IntArray:
        """Points that may have offsets: all but those that stay the mean's."""
        still = [part.rows for part in self.rigid if not part.with_modes]
        return np.setdiff1d(np.arange(len(self.mean)), np.concatenate(still) if still else np.zeros(0, np.int64))

    @cached_property
    def levels(self) -> PointLevels:
        """Of the points that may have offsets."""
        number = np.full(len(self.mean), -1)
        number[self.sent] = np.arange(len(self.sent))
        triangles = number[self.topology.triangles]
        return PointLevels(points=self.mean[self.sent], triangles=triangles[(triangles >= 0).all(axis=1)])

    def known(self, parts: FaceParts, where: str) -> FaceParts:
        """The meshes of a face that the basis has, in its order.

        :raises TopologyError: a face of another topology
        """
        base = self.topology.parts(self.mean)
        return in_order(base, self.name, parts, where)

    def check(self, content: PersonContent, where: object) -> None:
        """:raises InputError: a person of another basis, with more modes, or with other parts"""
        if content.basis != self.digest:
            expected = f"expected {self.digest.hex()} of {self.name}"
            raise InputError(where, f"a person on another basis ({content.basis.hex()}), {expected}")
        if len(content.modes) > len(self.modes):
            raise InputError(where, f"{len(content.modes)} modes, expected at most the {len(self.modes)} of its basis")
        if len(content.parts) not in (0, len(self.rigid)):
            raise InputError(where, f"{len(content.parts)} parts, expected the {len(self.rigid)} of its basis or none")

    def rebuilt(self, content: PersonContent, where: object) -> FloatArray:
        """(n, 3) points of a person.

        :raises InputError: as `check`, or points that are not the basis's
        """
        self.check(content, where)
        points, mean = self.shaped(content.modes), self.mean
        if content.placement is not None:
            points, mean = (placed(content.placement, one, np.zeros(3)) for one in (points, mean))
        for part, placement in zip(self.rigid, content.parts, strict=False):
            own = (points if part.with_modes else mean)[part.rows]
            points[part.rows] = placed(placement, own, own.mean(axis=0))
        if content.points:
            points[self.sent] += self.levels.decode(content.points, f"{where} -> points")
        return points

    def shaped(self, weights: FloatArray) -> FloatArray:
        """(n, 3) points by weights of the first modes alone."""
        some = np.asarray(weights, np.float64)
        return np.asarray(self.mean + np.tensordot(some, self.modes[: len(some)], axes=1))


def placed(placement: FloatArray, points: FloatArray, about: FloatArray) -> FloatArray:
    """(n, 3) points turned and scaled about a point, then moved, as `PersonContent` says."""
    numbers = np.asarray(placement, np.float64)
    turn = numbers[3:6]
    quaternion = np.append(turn, np.sqrt(np.maximum(1.0 - (turn**2).sum(), 0.0)))
    turned = (points - about) @ rotation_matrices(quaternion).T
    return np.asarray(np.exp(numbers[6]) * turned + about + numbers[:3])


def basis_of(parts: FaceParts, where: str, *, template: Path | None = None, database: Path | None = None) -> Basis:
    """The basis for a face: that of a database or template, else the built-in head's.

    :raises InputError: a face of another topology than the built-in head, and nothing else given
    """
    if database is not None:
        return database_basis(database)
    if template is not None:
        return template_basis(read_face(template).parts(), str(template))
    if is_head(parts, where):
        return head_basis()
    raise InputError(where, "not the built-in head, expected --database of its topology, or the --template of devices")


def database_basis(path: Path) -> Basis:
    """That of a database: its modes.

    :raises InputError: no database
    """
    faces = databases().load(path)
    modes = faces.identity.components * faces.identity.deviations[:, None, None]
    return _plain(path.name, faces.topology, faces.identity.mean, modes)


def template_basis(parts: FaceParts, name: str) -> Basis:
    """That of a face that devices have: itself, without modes.

    :raises InputError: a face far from the origin
    """
    return _plain(name, Topology.of(parts), whole_points(parts), np.zeros((0, parts.point_count, 3)))


def is_head(parts: FaceParts, where: str) -> bool:
    """Whether a face has the topology of the built-in head."""
    basis = head_basis()
    if not set(basis.topology.names) <= {mesh.name for mesh in parts.meshes}:
        return False
    try:
        basis.known(parts, where)
    except TopologyError:
        return False
    return True


def _plain(name: str, topology: Topology, mean: FloatArray, modes: FloatArray) -> Basis:
    mean = np.asarray(mean, np.float32).astype(np.float64)
    if not np.abs(mean).max(initial=0.0) <= _MOST:
        raise InputError(name, f"points farther than {_MOST:g} mm from the origin, expected a face")
    fitted = np.arange(len(mean))
    return Basis(name=name, topology=topology, mean=mean, modes=modes.astype(np.float32), fitted=fitted)


@cache
def head_basis() -> Basis:
    """That of the built-in head."""
    head = asset()
    parts = head.parts
    topology = Topology(
        names=tuple(parts),
        points=tuple(part.points.stop - part.points.start for part in parts.values()),
        counts=tuple(np.asarray(head.counts[part.faces], np.int32) for part in parts.values()),
        indices=tuple(np.asarray(head.indices[part.corners] - part.points.start, np.int32) for part in parts.values()),
    )
    skin = np.arange(parts["Head"].points.start, parts["Head"].points.stop)
    return Basis(
        name="the built-in head",
        topology=topology,
        mean=_CM * head.points,
        modes=np.float32(_CM) * np.concatenate([head.modes, unpacked(arrays("person_modes")["modes"])]),
        fitted=np.setdiff1d(skin, np.arange(MOUTH.start, MOUTH.stop)),
        rigid=(
            RigidPart(rows=_rows(parts[name].points for name in _CARRIED), with_modes=True),
            *(RigidPart(rows=_rows([parts[name].points]), with_modes=False) for name in _BALLS),
        ),
    )


def _rows(slices: Iterable[slice]) -> IntArray:
    return np.concatenate([np.arange(one.start, one.stop) for one in slices])
