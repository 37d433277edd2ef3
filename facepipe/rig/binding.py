"""Skins of other formats on one skeleton, and meshes brought into its space.

Formats have a matrix of each joint in each skin, ``inverse_j`` (mesh space -> joint space at bind). A skin's
``world_j inverse_j`` becomes ``world_j inverse(bind_j) geomBind`` (DESIGN section 7): where the joints stand in bind
pose that product is the same matrix for all joints, and this is geomBind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.names import identifier, unique_identifiers
from facepipe.geometry.vectors import transformed, unit_vectors
from facepipe.parts import Mesh, Skeleton, identity

_SAME = 1e-5
_LONGEST = 80  # characters of a part of a joint's path


@dataclass(frozen=True)
class BoundSkin:
    """A skin on the skeleton: the skeleton joint of each of its joints, and mesh space -> skeleton space at bind."""

    slots: IntArray
    geom_bind: FloatArray


@dataclass
class Bindings:
    """How skins bind the joints of a skeleton, skin after skin."""

    binds: dict[int, FloatArray] = field(default_factory=dict)  # by joint
    twins: list[tuple[int, FloatArray]] = field(default_factory=list)  # joints that a later skin binds otherwise

    def add(self, slots: IntArray, inverses: FloatArray, worlds: FloatArray) -> tuple[BoundSkin, int]:
        """A skin on the skeleton, and how many joints it binds otherwise than an earlier one: each gets a twin.

        :param slots: (k,) joints
        :param inverses: (k, 4, 4) mesh space -> joint space
        :param worlds: (k, 4, 4) where the joints stand, in bind pose as far as the file knows
        """
        bound = np.array([slot in self.binds for slot in slots.tolist()], dtype=bool)
        slots = slots.copy()
        if bound.any():
            # inverse_j = B_j^-1 G: where an earlier skin gave B_j, B_j inverse_j is the G of this one, the same for all
            # but joints that this one binds otherwise; the median is no such joint's, whichever comes first
            factors = np.array([self.binds[slot] for slot in slots[bound].tolist()]) @ inverses[bound]
            usual = _apart(factors, np.median(factors, axis=0))
            geom_bind = _snapped(factors[np.argmax(usual <= max(_SAME, 1.001 * usual.min()))])
            other = np.flatnonzero(bound)[_apart(factors, geom_bind) > _SAME]
        else:
            # in a file at rest in bind pose world_j inverse_j is G; at another pose they differ, and G is the identity
            factors = worlds @ inverses
            geom_bind = _snapped(factors[0]) if _apart(factors, factors[0]).max() <= 10 * _SAME else identity()
            if abs(np.linalg.det(geom_bind[:3, :3])) < 1e-30:
                geom_bind = identity()
            other = np.zeros(0, np.int64)
        for place, inverse in enumerate(inverses):
            joint = int(slots[place])
            if place in other:
                slots[place] = -1 - len(self.twins)  # numbered from behind until the number of joints is known
                self.twins.append((joint, geom_bind @ np.linalg.inv(inverse)))
            elif joint not in self.binds:
                self.binds[joint] = geom_bind @ np.linalg.inv(inverse)
        return BoundSkin(slots, geom_bind), len(other)

    def skeleton(
        self, given: Sequence[str | None], parents: Sequence[int], rest: FloatArray, spend: Callable[[int], None]
    ) -> Skeleton:
        """The skeleton of all joints, then their twins: below the joint, still against it, bound as the skin says.

        :param given: the source's name of each joint, None where it has none
        :param parents: joint above each, -1 for roots; joints come after their parents
        :param rest: (j, 4, 4) local to the parent
        :param spend: takes the bytes of each joint from what the file may ask for: the paths of a chain grow with the
            square of its length
        """
        for joint, parent in enumerate(parents):  # bound by no skin: as they rest below those that are
            if joint not in self.binds:
                at_rest = rest[joint] if parent < 0 else self.binds[parent] @ rest[joint]
                self.binds[joint] = unless_flat(at_rest)
        above = [*parents, *(joint for joint, _ in self.twins)]
        wanted = [(one or "")[:_LONGEST] for one in given]
        wanted += [f"{identifier(given[joint] or 'joint')[:_LONGEST]}_bind" for joint, _ in self.twins]
        siblings: dict[int, list[int]] = {}
        for joint, parent in enumerate(above):
            siblings.setdefault(parent, []).append(joint)
        leaves: dict[int, str] = {}
        for joints in siblings.values():
            leaves |= zip(joints, unique_identifiers((wanted[joint] for joint in joints), "joint"), strict=True)
        paths: list[str] = []
        for joint, parent in enumerate(above):
            path = leaves[joint] if parent < 0 else f"{paths[parent]}/{leaves[joint]}"
            spend(len(path) + 128)
            paths.append(path)
        skeleton = Skeleton(
            joints=tuple(paths),
            bind_transforms=np.array(
                [*(self.binds[joint] for joint in range(len(parents))), *(bind for _, bind in self.twins)]
            ).reshape(-1, 4, 4),
            rest_transforms=np.concatenate([rest.reshape(-1, 4, 4), np.tile(identity(), (len(self.twins), 1, 1))]),
        )
        own = zip([*given, *[None] * len(self.twins)], skeleton.names, strict=True)
        return skeleton.called([leaf if name is None else name for name, leaf in own])

    def numbered(self, skin: BoundSkin, joints: int) -> BoundSkin:
        """A skin with the numbers that its twins have behind `joints` joints."""
        return replace(skin, slots=np.where(skin.slots < 0, joints - 1 - skin.slots, skin.slots))


def placed(mesh: Mesh, matrix: FloatArray) -> Mesh:
    """A skinned `mesh` with its points moved by `matrix` (mesh space -> skeleton space at bind).

    A matrix that mirrors or flattens would turn faces inside out: it becomes the geomBind instead.
    """
    if mesh.skin is None or np.array_equal(matrix, identity()):
        return mesh
    determinant = float(np.linalg.det(matrix[:3, :3]))
    if not 1e-30 < determinant < 1e30:
        return replace(mesh, skin=replace(mesh.skin, geom_bind_transform=matrix))
    return moved(mesh, matrix)


def moved(mesh: Mesh, matrix: FloatArray) -> Mesh:
    """A mesh with points, normals and shapes moved by a `matrix` that does not mirror."""
    determinant = float(np.linalg.det(matrix[:3, :3]))
    # det(A)^(1/3) A^-T is the rotation of a scaled rotation: normal offsets are not normalised, and keep their length
    turn: FloatArray = np.linalg.inv(matrix[:3, :3]).T * np.cbrt(determinant)

    def offset(values: FloatArray) -> FloatArray:
        return (np.asarray(values, np.float64) @ matrix[:3, :3].T).astype(np.float32)

    def normal(values: FloatArray) -> FloatArray:
        return (np.asarray(values, np.float64) @ turn.T).astype(np.float32)

    return replace(
        mesh,
        points=transformed(mesh.points, matrix).astype(np.float32),
        normals=None if mesh.normals is None else unit_vectors(normal(mesh.normals)),
        blendshapes=tuple(shape.changed(offset, normal) for shape in mesh.blendshapes),
    )


def unless_flat(matrix: FloatArray) -> FloatArray:
    """`matrix`, or the identity where that has no inverse, as of what grows from nothing: either binds meshes."""
    return matrix if abs(np.linalg.det(matrix)) > 1e-30 else identity()


def _apart(matrices: FloatArray, reference: FloatArray) -> FloatArray:
    """(k,) largest differences of (k, 4, 4) from (4, 4), relative to the size of that."""
    return np.asarray(np.abs(matrices - reference).max(axis=(1, 2)) / max(float(np.abs(reference[:3]).max()), 1e-30))


def _snapped(matrix: FloatArray) -> FloatArray:
    """`matrix`, or the identity where it is that but for float32 noise."""
    return identity() if np.abs(matrix - identity()).max() <= 1e-5 else matrix
