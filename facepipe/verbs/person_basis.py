"""What a person's payload is relative to: the mean face and modes that a server and a device both have."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.reading import read_bytes
from facepipe.geometry.point_levels import PointLevels
from facepipe.heads.asset import asset
from facepipe.importers import read_face
from facepipe.parts import FaceParts
from facepipe.payload.basis import MOST_BYTES, BasisContent, MeshRun, RigidRows, basis_body, decode_basis, digest_of
from facepipe.payload.person import PersonContent
from facepipe.registry import databases
from facepipe.rig.identity_joints import IdentityJoints, coefficients_of_steps
from facepipe.rig.trs import rotation_matrices
from facepipe.verbs.whole_faces import Topology, in_order, whole_points

if TYPE_CHECKING:
    from facepipe.verbs.person_joints import JointFit
    from facepipe.verbs.person_modes import ModeFit
    from facepipe.verbs.person_rig import RigChange

BASIS_SUFFIX = ".fpbasis"
_STEP = 0.01  # millimetres of a database's modes, at least
_MOST = 1e5  # millimetres from the origin: beyond it whole numbers of `PointLevels` don't hold squares
_BLOCK = 4096  # numbers of a mode that are summed up at once
_GRID = 1000  # places in a millimetre of the mean, where it is none of facepipe's own
MOUTH = slice(11248, 13294)  # points of the built-in head: the mouth's inside, which modes don't fit


@dataclass(frozen=True, kw_only=True)
class Basis:
    """``points = mean + sum_k w_k modes_k``, what identity joints add, placements of the whole and of parts, offsets.

    Identity joints are about the mean and come before the placement of the whole: who is turned has the same ones.
    """

    topology: Topology
    content: BasisContent  # of n points, k modes
    fitted: IntArray  # (m,) points that modes are fitted to
    digest: bytes  # DIGEST bytes that differ between bases

    @property
    def name(self) -> str:
        """What it is called."""
        return self.content.name

    @cached_property
    def mean(self) -> FloatArray:
        """(n, 3) whole points, millimetres."""
        return self.content.mean

    @cached_property
    def joints(self) -> IdentityJoints | None:
        """Those that carry what modes leave of people."""
        own = self.content.identity_joints
        if own is None:
            return None
        rows = np.arange(own.first, own.first + len(own.indices))
        weights = own.weights / own.weights.sum(axis=1, keepdims=True, dtype=np.float64)
        return IdentityJoints(
            rows=rows,
            points=self.mean[rows],
            places=own.places.astype(np.float64),
            indices=own.indices.astype(np.int64),
            weights=weights,
        )

    @cached_property
    def modes(self) -> npt.NDArray[np.float32]:
        """(k, n, 3) millimetres."""
        return np.ascontiguousarray(self.content.modes.transpose(0, 2, 1)) * np.float32(self.content.step)

    @property
    def rigid(self) -> tuple[RigidRows, ...]:
        """Parts that keep their shape, or that of their modes."""
        return self.content.parts

    @cached_property
    def levels(self) -> PointLevels:
        """Of the points that may have offsets: all but those that stay the mean's."""
        return PointLevels(count=len(self.mean), first=self.content.coarsest, levels=self.content.levels)

    @cached_property
    def mode_fit(self) -> ModeFit:
        """What fits modes."""
        from facepipe.verbs.person_modes import ModeFit

        return ModeFit(self.mean, self.modes, self.fitted)

    @cached_property
    def joint_fit(self) -> JointFit | None:
        """What fits identity joints, if there are any."""
        if self.joints is None:
            return None
        from facepipe.verbs.person_joints import JointFit

        return JointFit(self.mean, self.modes, self.fitted, self.joints)

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
        count = 0 if self.joints is None else len(self.joints.places)
        if len(content.joints) > count:
            raise InputError(where, f"{len(content.joints)} joints, expected at most the {count} of its basis")
        rests, count = 0 if content.rig is None else len(content.rig.steps), len(self.content.joints)
        if rests > count:
            raise InputError(f"{where} -> rig", f"{rests} joints, expected at most the {count} of its basis")

    def rebuilt(self, content: PersonContent, where: object, shaped: FloatArray | None = None) -> FloatArray:
        """(n, 3) points of a person.

        :param shaped: (n, 3) what `shaped` gives of the content's modes, where it is at hand
        :raises InputError: as `check`, or points that are not the basis's
        """
        self.check(content, where)
        points, mean = self.shaped(content.modes) if shaped is None else shaped.copy(), self.mean
        if self.joints is not None and len(content.joints):
            points[self.joints.rows] += self.joints.offsets(coefficients_of_steps(content.joints, content.step))
        if content.placement is not None:
            points, mean = (placed(content.placement, one, np.zeros(3)) for one in (points, mean))
        for part, placement in zip(self.rigid, content.parts, strict=False):
            own = (points if part.with_modes else mean)[part.rows]
            points[part.rows] = placed(placement, own, own.mean(axis=0))
        if content.points:
            points += self.levels.decode(content.points, f"{where} -> points")
        return points

    def rig_change(self, content: PersonContent) -> RigChange:
        """How joints rest and shapes go of a person whom `check` passed."""
        from facepipe.verbs.person_rig import RigChange

        return RigChange.of(content.rig, len(self.content.joints))

    def shaped(self, weights: FloatArray) -> FloatArray:
        """(n, 3) points by weights of the first modes alone."""
        some = np.asarray(weights, np.float64)
        rows, moves = self.modes[: len(some)].reshape(len(some), self.mean.size), np.empty(self.mean.size)
        for first in range(0, len(moves), _BLOCK):  # all at once as float64 they leave the cache: three times as long
            own = slice(first, first + _BLOCK)
            moves[own] = some @ rows[:, own].astype(np.float64)
        return np.asarray(self.mean + moves.reshape(self.mean.shape))


def placed(placement: FloatArray, points: FloatArray, about: FloatArray) -> FloatArray:
    """(n, 3) points turned and scaled about a point, then moved, as `PersonContent` says."""
    numbers = np.asarray(placement, np.float64)
    turn = numbers[3:6]
    quaternion = np.append(turn, np.sqrt(np.maximum(1.0 - (turn**2).sum(), 0.0)))
    turned = (points - about) @ rotation_matrices(quaternion).T
    return np.asarray(np.exp(numbers[6]) * turned + about + numbers[:3])


def unplaced(placement: FloatArray, points: FloatArray) -> FloatArray:
    """Points (n, 3) as they were before a placement about the origin."""
    axes = placed(placement, np.eye(3), np.zeros(3)) - placement[:3]
    return np.asarray((points - placement[:3]) @ np.linalg.inv(axes))


def basis_of(
    parts: FaceParts | None, where: str, *, template: Path | None = None, database: Path | None = None
) -> Basis:
    """The basis for a face: that of a database or template, else the built-in head's.

    :param parts: None: no face is to be on it
    :raises InputError: a face of another topology than the built-in head, and nothing else given
    """
    if database is not None:
        return database_basis(database, parts, where)
    if template is not None:
        return template_basis(read_face(template).parts(), str(template))
    if parts is None or is_head(parts, where):
        return head_basis()
    raise InputError(where, "not the built-in head, expected --database of its topology, or the --template of devices")


def database_basis(path: Path, parts: FaceParts | None, where: str) -> Basis:
    """That of a database, which is its modes, or of a file that `facepipe basis` wrote.

    :param parts: a face of its topology, of which the file has names and a digest alone
    :raises InputError: no database, no basis
    :raises TopologyError: a face of another topology
    """
    if path.suffix.lower() != BASIS_SUFFIX:
        faces = databases().load(path)
        modes = faces.identity.components * faces.identity.deviations[:, None, None]
        return _plain(path.name, faces.topology, faces.identity.mean, modes)
    content, digest = decode_basis(read_bytes(path, MOST_BYTES), path)
    meshes = {mesh.name: mesh for mesh in (() if parts is None else parts.meshes)}
    names = [mesh.name for mesh in content.meshes]
    own = FaceParts(name=path.name, meshes=tuple(meshes[name] for name in names if name in meshes))
    topology = Topology.of(own)
    if topology.digest != f"sha256:{content.topology.hex()}":
        raise TopologyError(where, f"not the meshes that {path} is of, expected {', '.join(names)} with its faces")
    return Basis(topology=topology, content=content, fitted=np.arange(len(content.places)), digest=digest)


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
    if not np.abs(mean).max(initial=0.0) <= _MOST:
        raise InputError(name, f"points farther than {_MOST:g} mm from the origin, expected a face")
    step = np.float32(max(_STEP, np.abs(modes).max(initial=0.0) / np.iinfo(np.int16).max))
    whole = np.rint(_GRID * np.asarray(mean, np.float64)).astype(np.int64)
    levels = PointLevels.of(whole / _GRID, topology.triangles)
    content = BasisContent(
        name=name,
        meshes=tuple(map(MeshRun, topology.names, topology.points)),
        topology=bytes.fromhex(topology.digest.removeprefix("sha256:")),
        grid=_GRID,
        places=whole,
        coarsest=levels.first,
        levels=levels.levels,
        step=float(step),
        modes=np.rint(np.asarray(modes, np.float64) / step).transpose(0, 2, 1).astype(np.int16),
    )
    digest = digest_of(basis_body(content))
    return Basis(topology=topology, content=content, fitted=np.arange(len(mean)), digest=digest)


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
    fitted = np.setdiff1d(skin, np.arange(MOUTH.start, MOUTH.stop))
    return Basis(topology=topology, content=head.basis, fitted=fitted, digest=head.basis_digest)
