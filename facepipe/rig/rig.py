"""The rig of one face as flat arrays, its evaluation, and how it is built from parts.

``point = sum_i w_i world_i inverse(bind_i) geomBind (point_0 + sum_k b_k delta_k)`` (DESIGN section 7): blendshapes
first, then linear blend skinning, in float64; dual quaternions where a mesh has them as its method: L. Kavan, S.
Collins, J. Zara, C. O'Sullivan, "Skinning with Dual Quaternions" (2007), with scale and shear of each joint apart,
before the rigid motion, as UsdSkel has it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.names import unknown
from facepipe.geometry.vectors import transformed, transformed_each
from facepipe.parts import FaceParts, Mesh
from facepipe.rig.bone_coefficients import coefficient_matrices

if TYPE_CHECKING:  # 0.13 s, which a face that is only opened does not need: functions import it
    from scipy import sparse

_FLAT_VOLUME = 1e-9  # of a volume: less, and there is no way back


@dataclass(frozen=True)
class Curve:
    """A piecewise-linear curve through `knots` (weight, activation), its end pieces extended without end.

    UsdSkel interpolates between neutral (0), the inbetweens and the shape (1) and extrapolates beyond them
    (`UsdSkelBlendShapeQuery::ComputeSubShapeWeights`).
    """

    knots: tuple[tuple[float, float], ...]

    def __call__(self, weight: FloatArray | float) -> FloatArray:
        """Activation at `weight`, of the same shape."""
        weight = np.asarray(weight, dtype=np.float64)
        base, slope, bends = self.hinges()
        result = base + slope * weight
        for at, change in bends:
            result = result + change * np.maximum(weight - at, 0.0)
        return np.asarray(result)

    def hinges(self) -> tuple[float, float, tuple[tuple[float, float], ...]]:
        """The curve as ``base + slope * w + sum(change * relu(w - at))``: base, slope, ((at, change), ...)."""
        x, y = np.array(self.knots, dtype=np.float64).T
        slopes = np.diff(y) / np.diff(x)
        bends = tuple((float(x[i]), float(slopes[i] - slopes[i - 1])) for i in range(1, len(slopes)))
        return float(y[0] - slopes[0] * x[0]), float(slopes[0]), bends

    @property
    def is_identity(self) -> bool:
        """Whether the activation is the weight itself."""
        return all(abs(x - y) == 0 for x, y in self.knots)


def curves(inbetween_weights: tuple[float, ...]) -> dict[float, Curve]:
    """The curve of every sculpt of a shape, by its weight: each inbetween's and 1 for the shape itself.

    `inbetween_weights` are distinct and neither 0 nor 1.
    """
    knots = sorted({0.0, 1.0, *inbetween_weights})
    return {sculpt: Curve(tuple((knot, float(knot == sculpt)) for knot in knots)) for sculpt in knots if sculpt != 0.0}


@dataclass(frozen=True, kw_only=True)
class Target:
    """One sculpt: a shape or one of its inbetweens, over all meshes that have it at that weight."""

    name: str  # the shape's name, or <shape>_<inbetween>
    shape: int  # index into Rig.shapes
    curve: Curve  # shape weight -> activation
    point_indices: IntArray  # (k,) into Rig.points, ascending
    offsets: FloatArray  # (k, 3) in the space of Rig.points


class SkinWeights:
    """(n, j + 1) how much each joint moves each point, most of them 0.

    A few products are numpy's own; more are those of a matrix of scipy, to load which takes as long as 20 of them.
    """

    _FEW = 5

    def __init__(self, starts: IntArray, columns: IntArray, values: FloatArray, shape: tuple[int, int]) -> None:
        """As `scipy.sparse.csr_array` has them: starts (n + 1,), columns and values (e,)."""
        self.starts, self.columns, self.values, self.shape = starts, columns, values, shape
        self._products = 0

    @classmethod
    def of(cls, rows: IntArray, columns: IntArray, values: FloatArray, shape: tuple[int, int]) -> SkinWeights:
        """Of entries (e,) in any order; those of one point and joint are summed: a joint twice is one influence."""
        places = rows * shape[1] + columns
        order = np.argsort(places, kind="stable")
        places = places[order]
        first = np.flatnonzero(np.diff(places, prepend=-1))
        summed = np.add.reduceat(values[order], first) if len(first) else values
        kept = summed != 0
        rows, columns = np.divmod(places[first][kept], shape[1])
        starts = np.append(0, np.cumsum(np.bincount(rows, minlength=shape[0])))
        return cls(starts.astype(np.int32), columns.astype(np.int32), summed[kept], shape)

    @classmethod
    def from_sparse(cls, matrix: sparse.csr_array) -> SkinWeights:
        """Those of a matrix of scipy."""
        return cls(matrix.indptr, matrix.indices, matrix.data, matrix.shape)

    @cached_property
    def sparse(self) -> sparse.csr_array:
        """The same as a matrix of scipy."""
        from scipy import sparse

        return sparse.csr_array((self.values, self.columns, self.starts), shape=self.shape)

    def dense(self, rows: IntArray) -> FloatArray:
        """(m, j + 1) those of some points."""
        counts = self.starts[rows + 1] - self.starts[rows]
        row = np.repeat(np.arange(len(rows)), counts)
        entries = np.arange(len(row)) + np.repeat(self.starts[rows] - np.cumsum(counts) + counts, counts)
        result = np.zeros((len(rows), self.shape[1]))
        result[row, self.columns[entries]] = self.values[entries]
        return result

    def __matmul__(self, table: FloatArray) -> FloatArray:
        """(n, k) weighted sums of the rows of a table (j + 1, k)."""
        self._products += 1
        if self._products > self._FEW or "sparse" in self.__dict__:
            return np.asarray(self.sparse @ table)
        counts = np.diff(self.starts)
        result = np.zeros((self.shape[0], table.shape[1]))
        for number in range(counts.max(initial=0)):  # in the order of scipy's sums
            rows = np.flatnonzero(counts > number)
            entries = self.starts[rows] + number
            added = table[self.columns[entries]]
            added *= self.values[entries, None]
            if len(rows) == len(result):
                result += added
            else:
                result[rows] += added
        return result


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Everything that moves the points of a face, meshes concatenated in stage order.

    `points` are in skeleton space at bind time (geomBindTransform applied). The last column of `skinning` stands
    for the skeleton itself: meshes without skin follow it rigidly.
    """

    name: str
    mesh_names: tuple[str, ...]
    mesh_offsets: IntArray  # (meshes + 1,) first point of each mesh, and the count
    points: FloatArray  # (n, 3)
    shapes: tuple[str, ...]
    targets: tuple[Target, ...]
    joints: tuple[str, ...]  # paths, parent first
    parents: IntArray  # (j,) -1 for a root
    rest: FloatArray  # (j, 4, 4) local
    inverse_bind: FloatArray  # (j, 4, 4)
    parent_world: FloatArray  # (4, 4) skeleton space -> world, what roots hang under by default
    skinning: SkinWeights
    dual: BoolArray | None = None  # (n,) points skinned by dual quaternions, others linearly; None: none

    def part(self, points: IntArray) -> Rig:
        """The rig of some of the points only, as one mesh, each as often as it is named."""
        from facepipe.geometry.rasterise import expand

        order = np.argsort(points, kind="stable")
        first, after = (np.searchsorted(points[order], np.arange(len(self.points)), side) for side in ("left", "right"))
        targets: list[Target] = []
        moved: IntArray = np.zeros(0, np.int64)
        row = places = moved
        for target in self.targets:
            if not np.array_equal(target.point_indices, moved):  # many move the same points, as identity modes do
                moved = target.point_indices
                row, step = expand(after[moved] - first[moved])
                places = order[first[moved][row] + step]
                sorting = np.argsort(places, kind="stable")
                row, places = row[sorting], places[sorting]
            targets.append(replace(target, point_indices=places, offsets=np.take(target.offsets, row, axis=0)))
        return replace(
            self,
            points=self.points[points],
            targets=tuple(targets),
            skinning=SkinWeights.from_sparse(self.influences[points]),
            dual=None if self.dual is None else self.dual[points],
            mesh_names=("part",),
            mesh_offsets=np.array([0, len(points)]),
        )

    @property
    def influences(self) -> sparse.csr_array:
        """(n, j + 1) its skin weights as a matrix of scipy."""
        return self.skinning.sparse

    @cached_property
    def deltas(self) -> sparse.csr_array:
        """(3 n, targets) point offsets of every target, rows x y z point by point."""
        return self.delta_columns.tocsr()

    @property
    def delta_columns(self) -> sparse.csc_array:
        """The same by columns, made anew each time: rows take as long again to sort."""
        from scipy import sparse

        shape = (3 * len(self.points), len(self.targets))
        if not self.targets:
            return sparse.csc_array(shape)
        rows = np.concatenate([3 * target.point_indices for target in self.targets])[:, None] + np.arange(
            3, dtype=np.int32
        )
        ends = 3 * np.cumsum([0, *(len(target.point_indices) for target in self.targets)], dtype=np.int32)
        values = np.concatenate([target.offsets for target in self.targets])
        return sparse.csc_array((values.ravel(), rows.ravel(), ends), shape=shape)

    def weight_vector(self, weights: Mapping[str, float] | None) -> FloatArray:
        """(shapes,) weights by name; shapes not named are 0.

        :raises InputError: a name that is no shape of this face, or a weight that is not finite
        """
        vector = np.zeros(len(self.shapes))
        index = {name: i for i, name in enumerate(self.shapes)}
        for name, weight in (weights or {}).items():
            if name not in index:
                raise InputError(self.name, unknown(name, self.shapes, "shape"))
            if not np.isfinite(weight):
                raise InputError(f"{self.name} -> {name}", f"weight {weight}, expected a finite number")
            vector[index[name]] = weight
        return vector

    def activations(self, weights: FloatArray) -> FloatArray:
        """(..., targets) activations of (..., shapes) shape weights."""
        shapes, (base, slope), bends = self._hinges
        own = weights[..., shapes]
        result = base + slope * own
        for at, change in bends:
            result += change * np.maximum(own - at, 0.0)
        return np.asarray(result)

    @cached_property
    def _hinges(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Hinges of all targets' curves: shapes (t,), bases and slopes (2, t), bends (b, 2, t) padded by 0."""
        curves = [target.curve.hinges() for target in self.targets]
        bends = np.zeros((max((len(each) for _, _, each in curves), default=0), 2, len(curves)))
        for number, (_, _, each) in enumerate(curves):
            bends[: len(each), :, number] = np.reshape(each, (-1, 2))
        lines = np.array([line for *line, _ in curves], dtype=np.float64).reshape(-1, 2).T
        return np.array([target.shape for target in self.targets], dtype=np.int64), lines, bends

    def morph(self, weights: FloatArray) -> FloatArray:
        """(n, 3) points of (shapes,) weights, in skeleton space at bind time, before skinning."""
        return self.points + self.offsets(weights)

    def offsets(self, weights: FloatArray) -> FloatArray:
        """(n, 3) how far (shapes,) weights move the points, as `morph` has them."""
        moved = np.zeros_like(self.points)
        for target, activation in zip(self.targets, self.activations(weights), strict=True):
            if activation:
                moved[target.point_indices] += activation * target.offsets
        return moved

    def joint_worlds(self, local: FloatArray, parent_world: FloatArray | None = None) -> FloatArray:
        """(..., j, 4, 4) world matrices of (..., j, 4, 4) local ones."""
        root = self.parent_world if parent_world is None else np.asarray(parent_world, dtype=np.float64)
        worlds = root @ local
        for joints in self.generations[1:]:
            worlds[..., joints, :, :] = worlds[..., self.parents[joints], :, :] @ local[..., joints, :, :]
        return np.asarray(worlds)

    @cached_property
    def generations(self) -> list[IntArray]:
        """Joints by how many others are above them."""
        above = np.zeros(len(self.joints), dtype=np.int64)
        for joint, parent in enumerate(self.parents):
            above[joint] = 0 if parent < 0 else above[parent] + 1
        return [np.flatnonzero(above == depth) for depth in range(above.max(initial=0) + 1)]

    def skinning_matrices(self, local: FloatArray, parent_world: FloatArray | None = None) -> FloatArray:
        """(..., j + 1, 4, 4) matrices from bind-time skeleton space to world, the skeleton's own last."""
        root = self.parent_world if parent_world is None else np.asarray(parent_world, dtype=np.float64)
        moved = self.joint_worlds(local, root) @ self.inverse_bind
        return np.concatenate([moved, np.broadcast_to(root, (*moved.shape[:-3], 1, 4, 4))], axis=-3)

    def skin(self, points: FloatArray, matrices: FloatArray) -> FloatArray:
        """(n, 3) world points of (n, 3) morphed points under (j + 1, 4, 4) skinning matrices."""
        return transformed_each(points, self.blended(matrices))

    def blended(self, matrices: FloatArray, rows: IntArray | None = None) -> FloatArray:
        """(n, 3, 4) transforms of points under (j + 1, 4, 4) skinning matrices.

        :param rows: (n,) points; None: all
        """
        dual = self.dual if rows is None or self.dual is None else self.dual[rows]
        table = matrices[:, :3, :].reshape(-1, 12)
        blended = (self.skinning @ table if rows is None else self.influences[rows] @ table).reshape(-1, 3, 4)
        if dual is not None:
            from facepipe.rig.dual_quaternions import dual_quaternion_blend

            influences = self.influences if rows is None else self.influences[rows]
            root = matrices[-1]  # quaternions blend in skeleton space: what scales the skeleton scales them all
            within = dual_quaternion_blend(influences[dual], np.linalg.inv(root) @ matrices)
            blended[dual] = root[:3, :3] @ within
            blended[dual, :, 3] += root[:3, 3]
        return np.asarray(blended)

    def require_linear(self, reader: str) -> None:
        """:raises InputError: points that are skinned by dual quaternions, which `reader` does not support"""
        if self.dual is None:
            return
        bounds = zip(self.mesh_names, self.mesh_offsets[:-1], self.mesh_offsets[1:], strict=True)
        names = [name for name, start, end in bounds if self.dual[start:end].any()]
        raise InputError(
            f"{self.name} -> {names[0]}",
            f"skinned by dual quaternions, which {reader} does not support; expected skel:skinningMethod classicLinear",
        )

    def unskin(self, points: FloatArray, matrices: FloatArray) -> FloatArray:
        """(n, 3) morphed points of (n, 3) world points under (j + 1, 4, 4) skinning matrices: the inverse of `skin`.

        Where the matrices flatten a point's surroundings it is the one nearest to its place at bind time.
        """
        blended = self.blended(matrices)
        linear, off = blended[:, :, :3], points - blended[:, :, 3]
        crossed = np.stack([np.cross(linear[:, (i + 1) % 3], linear[:, (i + 2) % 3]) for i in range(3)], axis=1)
        volume = np.einsum("ni,ni->n", linear[:, 0], crossed[:, 0])
        flat = np.abs(volume) < _FLAT_VOLUME
        solved = np.einsum("nij,ni->nj", crossed, off) / np.where(flat, 1.0, volume)[:, None]  # Cramer's rule
        for point in np.flatnonzero(flat):
            rest = self.points[point]
            solved[point] = rest + np.linalg.pinv(linear[point], rcond=_FLAT_VOLUME) @ (
                off[point] - linear[point] @ rest
            )
        return np.asarray(solved)

    def evaluate(
        self,
        weights: Mapping[str, float] | FloatArray | None = None,
        *,
        coefficients: FloatArray | None = None,
        joint_transforms: FloatArray | None = None,
        parent_world: FloatArray | None = None,
    ) -> FloatArray:
        """(n, 3) world points in stage units.

        :param weights: shape weights by name, or a (shapes,) vector in the order of `shapes`
        :param coefficients: (j, 9) bone coefficients relative to rest
        :param joint_transforms: (j, 4, 4) local joint transforms instead of coefficients
        :param parent_world: (4, 4) what root joints hang under, a body's attach joint; default the skeleton's place
        :raises InputError: wrong names, counts or non-finite values, or both coefficients and transforms
        """
        vector = weights if isinstance(weights, np.ndarray) else self.weight_vector(weights)
        if vector.shape != (len(self.shapes),) or not np.isfinite(vector).all():
            raise InputError(self.name, f"shape weights {vector.shape}, expected {len(self.shapes)} finite numbers")
        local = self.local_transforms(coefficients, joint_transforms)
        if parent_world is not None:
            parent_world = self._checked(np.asarray(parent_world, dtype=np.float64), (4, 4), "parent matrix")
        return self.skin(self.morph(vector), self.skinning_matrices(local, parent_world))

    def local_transforms(
        self, coefficients: FloatArray | None = None, joint_transforms: FloatArray | None = None
    ) -> FloatArray:
        """(j, 4, 4) local joint transforms: rest, or those of coefficients or transforms."""
        if coefficients is not None and joint_transforms is not None:
            raise InputError(self.name, "bone coefficients and joint transforms, expected only one of them")
        if joint_transforms is not None:
            return self._checked(joint_transforms, (len(self.joints), 4, 4), "joint transforms")
        if coefficients is not None:
            return np.asarray(self.rest @ coefficient_matrices(self.checked_coefficients(coefficients)))
        return self.rest

    def checked_coefficients(self, coefficients: FloatArray) -> FloatArray:
        """(j, 9) bone coefficients.

        :raises InputError: another shape, NaN or infinity
        """
        return self._checked(coefficients, (len(self.joints), 9), "bone coefficients")

    def split(self, points: FloatArray) -> dict[str, FloatArray]:
        """Per-mesh views of concatenated points (n, ...)."""
        bounds = self.mesh_offsets
        return {name: points[bounds[i] : bounds[i + 1]] for i, name in enumerate(self.mesh_names)}

    def _checked(self, values: FloatArray, shape: tuple[int, ...], name: str) -> FloatArray:
        array = np.asarray(values, dtype=np.float64)
        if array.shape != shape:
            raise InputError(self.name, f"{name} of shape {array.shape}, expected {shape}")
        if not np.isfinite(array).all():
            raise InputError(self.name, f"{name} hold NaN or infinity, expected finite numbers")
        return array


_Sculpt = tuple[str, int, Curve, npt.NDArray[np.int32], FloatArray]


def build(parts: FaceParts) -> Rig:
    """The rig of a face.

    :raises TopologyError: a singular bind transform, or indices and counts that don't fit
    """
    skeleton = parts.skeleton
    offsets = np.concatenate([[0], np.cumsum([len(mesh.points) for mesh in parts.meshes], dtype=np.int64)])
    spaces = mesh_spaces(parts)
    shapes = parts.shapes
    # geomBindTransform goes into the points, as each mesh has its own: one matrix a joint then serves all meshes
    points = [transformed(mesh.points, space) for space, mesh in zip(spaces, parts.meshes, strict=True)]
    by_mesh = [mesh.skin is not None and mesh.skin.dual_quaternion for mesh in parts.meshes]
    return Rig(
        name=parts.name,
        mesh_names=tuple(mesh.name for mesh in parts.meshes),
        mesh_offsets=offsets,
        points=np.concatenate(points) if points else np.zeros((0, 3)),
        shapes=shapes,
        targets=_targets(parts.meshes, offsets, spaces, shapes),
        joints=skeleton.joints,
        parents=skeleton.parents,
        rest=np.asarray(skeleton.rest_transforms, dtype=np.float64),
        inverse_bind=np.array(
            [
                inverse(bind, f"{parts.name} -> {skeleton.name} -> {joint}")
                for bind, joint in zip(skeleton.bind_transforms, skeleton.joints, strict=True)
            ]
        ).reshape(-1, 4, 4),
        parent_world=np.asarray(skeleton.transform, dtype=np.float64),
        skinning=_skinning(parts, offsets),
        dual=np.repeat(by_mesh, [len(mesh.points) for mesh in parts.meshes]) if any(by_mesh) else None,
    )


def mesh_spaces(parts: FaceParts) -> list[FloatArray]:
    """(4, 4) matrix of every mesh from its own space to skeleton space at bind time.

    :raises TopologyError: a singular skeleton transform
    """
    to_skeleton = inverse(parts.skeleton.transform, f"{parts.name} -> {parts.skeleton.name}")
    return [mesh.skin.geom_bind_transform if mesh.skin else to_skeleton @ mesh.transform for mesh in parts.meshes]


def inverse(matrix: FloatArray, where: str) -> FloatArray:
    """(4, 4) inverse.

    :raises TopologyError: there is none
    """
    try:
        result = np.linalg.inv(np.asarray(matrix, dtype=np.float64))
    except np.linalg.LinAlgError:
        result = np.full((4, 4), np.nan)
    if not np.isfinite(result).all():
        raise TopologyError(where, "singular matrix, expected an invertible one")
    return np.asarray(result)


def _skinning(parts: FaceParts, offsets: npt.NDArray[np.int64]) -> SkinWeights:
    """(n, j + 1) weights; a mesh without skin follows the last column."""
    joint_count = len(parts.skeleton.joints)
    rows, columns, values = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0)]
    for mesh, start in zip(parts.meshes, offsets[:-1], strict=True):
        numbers = np.arange(len(mesh.points)) + start
        indices = mesh.skin.joint_indices if mesh.skin else np.full((len(numbers), 1), joint_count)
        weights = mesh.skin.joint_weights if mesh.skin else np.ones((len(numbers), 1))
        limit = joint_count if mesh.skin else joint_count + 1
        if indices.size and not (indices.min() >= 0 and indices.max() < limit):
            raise TopologyError(f"{parts.name} -> {mesh.name}", f"joint index outside 0..{joint_count - 1}")
        kept = np.flatnonzero(weights)
        rows.append(np.repeat(numbers, indices.shape[1])[kept])
        columns.append(np.asarray(indices, dtype=np.int64).ravel()[kept])
        values.append(np.asarray(weights, dtype=np.float64).ravel()[kept])
    shape = (int(offsets[-1]), joint_count + 1)
    return SkinWeights.of(np.concatenate(rows), np.concatenate(columns), np.concatenate(values), shape)


def _targets(
    meshes: tuple[Mesh, ...], offsets: npt.NDArray[np.int64], spaces: list[FloatArray], shapes: tuple[str, ...]
) -> tuple[Target, ...]:
    """Sculpts of all meshes; those of one shape, name and activation curve are one target."""
    number = {name: i for i, name in enumerate(shapes)}
    by_curve: dict[tuple[str, str, Curve], list[_Sculpt]] = {}
    for mesh, start, space in zip(meshes, offsets[:-1], spaces, strict=True):
        linear = space[:3, :3]
        turned = not np.array_equal(linear, np.eye(3))  # offsets that are not are shared with the parts: they are large
        for shape in mesh.blendshapes:
            indices = np.asarray(shape.point_indices)
            if indices.size and not (indices.min() >= 0 and indices.max() < len(mesh.points)):
                raise TopologyError(f"{mesh.name} -> {shape.name}", f"point index outside 0..{len(mesh.points) - 1}")
            by_weight = curves(tuple(inbetween.weight for inbetween in shape.inbetweens))
            for name, weight, sculpt in shape.sculpts:
                moved, curve = np.asarray(sculpt.offsets, dtype=np.float64), by_weight[weight]
                if len(moved) != len(indices):
                    raise TopologyError(f"{mesh.name} -> {name}", f"{len(moved)} offsets, expected {len(indices)}")
                if turned:
                    moved = moved @ linear.T
                sculpted = (name, number[shape.name], curve, (indices + start).astype(np.int32), moved)
                by_curve.setdefault((shape.name, name, curve), []).append(sculpted)
    targets = []
    for sculpts in by_curve.values():
        name, shape_number, curve, indices, offset_rows = sculpts[0]
        if len(sculpts) > 1:
            indices = np.concatenate([each for *_, each, _ in sculpts])
            offset_rows = np.concatenate([each for *_, each in sculpts])
        targets.append(Target(name=name, shape=shape_number, curve=curve, point_indices=indices, offsets=offset_rows))
    return tuple(sorted(targets, key=lambda target: target.shape))
