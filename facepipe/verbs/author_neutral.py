"""An actor's neutral authored over the template, with its blendshapes and the joints that go with its points."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray, require_finite
from facepipe.core.errors import TopologyError
from facepipe.core.reports import Report
from facepipe.geometry.polygons import point_normals, point_triangles, touching
from facepipe.geometry.similarity import fit_similarities, fit_similarity
from facepipe.geometry.vectors import group_sums, transformed
from facepipe.parts import Blendshape, FaceParts, Inbetween, Mesh, Recipe, Skeleton
from facepipe.rig import build, mesh_spaces
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes
from facepipe.verbs.blend.result import blend_normals, normal_offsets
from facepipe.verbs.blend.rigs import blend_skeletons, rebase_animations
from facepipe.verbs.whole_faces import check_spaces, to_millimetres

_Shape = TypeVar("_Shape", Blendshape, Inbetween)

_STILL_MM = 1e-4  # points that a shape moves by less stay where they are
_STILL_SHARE = 1e-6  # the same of a face's size: one in a wrong unit may be smaller than a millimetre
_STILL = 1e-9  # of the face's size: rounding
_FAR = 3.0  # spreads of its points that a joint may be away from them and still turn about them


@dataclass(frozen=True, kw_only=True)
class AuthorNeutralReport(Report):
    """What was authored, one line per thing."""

    authored: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class AuthorNeutral:
    """Puts whole points on a face in place of its own: points, normals, joints, and clips on them.

    Joints go with the points that hang at them, so that skin and bind pose fit as before. Regions, landmarks, UVs,
    materials, sliders and limits stay; photos, which show someone else, go.

    :param shapes: blendshapes by name, (n, 3) whole deltas in millimetres, in place of those of the same name or
        beside them; the others keep their offsets
    :param primvars: (n,) values of whole points to author beside it all, by primvar name
    :param settled: the changed face with what else follows from its points
    """

    shapes: Mapping[str, FloatArray] = field(default_factory=dict)
    primvars: Mapping[str, FloatArray] = field(default_factory=dict)
    settled: Callable[[FaceParts], FaceParts] = lambda changed: changed

    def __call__(self, face: Face, points: FloatArray, *, recipe: Recipe | None = None) -> AuthorNeutralReport:
        """Author whole `points` (n, 3), millimetres and Y up, on `face`, which stands over the template.

        :raises TopologyError: another number of points than the face has, or a transform without inverse
        :raises InputError: NaN or infinity; nothing is authored then
        """
        parts = face.parts()
        check_spaces(face.where, parts)
        count = parts.point_count
        named = {"points": points, **{f"shape {name}": delta for name, delta in self.shapes.items()}}
        for name, values in named.items():
            if np.shape(values) != (count, 3):
                raise TopologyError(f"{face.where} -> {name}", f"shape {np.shape(values)}, expected ({count}, 3)")
            require_finite(values, face.where, name)
        changed = self.settled(self.changed(parts, points))
        authored = author_changes(face, replace(changed, recipe=recipe), self.primvars)
        own = (shape for mesh in parts.meshes for shape in mesh.blendshapes)
        lost = sorted({shape.name for shape in own if shape.inbetweens and shape.name in self.shapes})
        warnings = (f"inbetweens of {', '.join(lost)} are left out",) if lost else ()
        return AuthorNeutralReport(authored=authored, warnings=warnings)

    def changed(self, parts: FaceParts, points: FloatArray) -> FaceParts:
        """The face with whole `points` (n, 3), for who authors more beside them."""
        cuts = np.cumsum([len(mesh.points) for mesh in parts.meshes])[:-1]
        points_by_mesh = np.split(np.asarray(points, np.float64), cuts)
        size = float(np.ptp(points, axis=0).max(initial=0.0))
        moves = {name: _moves(np.asarray(delta, np.float64), size) for name, delta in self.shapes.items()}
        deltas = {name: np.split(delta, cuts) for name, delta in moves.items()}
        meshes, skeleton_space = [], []
        # shapes that move no point -> meshes that hold them all the same, so that what drives them finds them
        still: dict[str, list[str]] = {}
        for name, delta in moves.items():
            if not delta.any():
                holding = [mesh.name for mesh in parts.meshes if any(one.name == name for one in mesh.blendshapes)]
                still[name] = holding or [parts.meshes[0].name]
        spaces = zip(parts.meshes, to_millimetres(parts), mesh_spaces(parts), strict=True)
        for number, (mesh, to, space) in enumerate(spaces):
            back = np.linalg.inv(to)
            local, before = transformed(points_by_mesh[number], back), mesh.points
            if np.array_equal(local.astype(np.float32), np.asarray(before, np.float32)):
                local = before  # the same as files hold them: what hangs on the mesh's own points stays too
            new = {name: (one[number], mesh.name in still.get(name, ())) for name, one in deltas.items()}
            # deltas are differences of points: the translation cancels, so the linear part alone takes them back
            shapes = _mesh_shapes(mesh, local, new, back[:3, :3])
            meshes.append(replace(mesh, points=local, normals=_normals(mesh, local), blendshapes=shapes))
            skeleton_space.append(transformed(local, space))
        skeleton = carried_skeleton(parts, np.concatenate(skeleton_space))
        return replace(
            parts,
            meshes=tuple(meshes),
            skeleton=skeleton,
            animations=rebase_animations(parts.animations, parts.skeleton, skeleton),
            photos=(),
        )


def _normals(mesh: Mesh, points: FloatArray) -> FloatArray | None:
    """Normals of the new points, per point or corner as the mesh has them; what was put in by hand stays."""
    if mesh.normals is None or points is mesh.points:
        return mesh.normals
    triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
    rows = np.arange(len(points)) if len(mesh.normals) == len(points) else mesh.face_vertex_indices
    before, after = (point_normals(one, triangles)[rows] for one in (mesh.points, points))
    return blend_normals([mesh.normals], before[None], after, np.ones((len(rows), 1)))


def _moves(delta: FloatArray, size: float) -> FloatArray:
    """A delta (n, 3), millimetres, without the points that stay where they are.

    :param size: of the face
    """
    least = min(_STILL_MM, _STILL_SHARE * size)
    return np.where(np.linalg.norm(delta, axis=1, keepdims=True) >= least, delta, 0.0)


def _mesh_shapes(
    mesh: Mesh, points: FloatArray, deltas: Mapping[str, tuple[FloatArray, bool]], back: FloatArray
) -> tuple[Blendshape, ...]:
    """The shapes of a mesh with new points (n, 3): its own in their order, those in `deltas` anew, then what else is
    in there. Normal offsets are made again where a shape had some, unless `points` are the mesh's own.

    :param deltas: shape -> (n, 3) in millimetres of the world, and whether the mesh must hold it though nothing moves
    :param back: (3, 3) from those to mesh space
    """
    before = {shape.name: shape for shape in mesh.blendshapes}
    triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
    shapes = []
    for name in dict.fromkeys([*before, *deltas]):
        old = before.get(name)
        if name not in deltas and old is not None:
            # normal offsets are from the normals of the old points: on new ones they lead elsewhere
            if points is not mesh.points:
                between = tuple(_with_normals(one, old.point_indices, points, triangles) for one in old.inbetweens)
                old = replace(_with_normals(old, old.point_indices, points, triangles), inbetweens=between)
            shapes.append(old)
            continue
        delta, held = deltas[name]
        with_normals = old is not None and old.normal_offsets is not None
        moving = np.asarray(delta.any(axis=1), bool)
        indices = np.flatnonzero(moving)
        if with_normals:
            # neighbours of points that move are there too: their normals turn
            indices = np.union1d(indices, triangles[touching(triangles, moving)].ravel())
        if not len(indices) and held:
            indices = np.zeros(1, np.int64)  # USD reads a shape without indices as one over all points
        if len(indices):
            offsets = delta[indices] @ back.T
            shape = Blendshape(name=name, point_indices=indices.astype(np.int32), offsets=offsets)
            if with_normals:
                turned = _shape_normals(shape.point_indices, offsets, points, triangles)
                shape = replace(shape, normal_offsets=turned)
            shapes.append(shape)
    return tuple(shapes)


def _with_normals(shape: _Shape, indices: IntArray, points: FloatArray, triangles: IntArray) -> _Shape:
    """The shape with its offsets of normals as they are on `points`, where it had some."""
    if shape.normal_offsets is None:
        return shape
    return replace(shape, normal_offsets=_shape_normals(indices, shape.offsets, points, triangles))


def _shape_normals(indices: IntArray, offsets: FloatArray, points: FloatArray, triangles: IntArray) -> FloatArray:
    moved = np.array(points, np.float64)
    moved[indices] += offsets
    return normal_offsets(points, moved, triangles, indices)


def carried_skeleton(parts: FaceParts, moved: FloatArray) -> Skeleton:
    """The skeleton of a face whose points have moved to `moved` (n, 3), in skeleton space.

    Each joint goes to where the similarity that fits its points best, by their skin weights, takes it. One that lies
    far from them goes with their middle, turned and scaled as the whole face; one without points goes with the whole
    face. Joints keep their axes, and their rest pose stays to the bind pose what it is.

    :raises TopologyError: a singular transform
    """
    skeleton = parts.skeleton
    if not skeleton.joints:
        return skeleton
    rig, count = build(parts), len(skeleton.joints)
    binds = np.asarray(skeleton.bind_transforms, np.float64)
    places, whole = binds[:, :3, 3], fit_similarity(rig.points, moved)
    held = rig.influences[:, :count].tocoo()
    joints, of_point = np.unique(held.col, return_inverse=True)  # those with points
    positions = whole.apply(places)
    if len(joints):
        before, after = rig.points[held.row], moved[held.row]
        fitted = fit_similarities(before, after, of_point, weights=held.data)
        total = group_sums(of_point, held.data[:, None], len(joints))
        middle, then = (group_sums(of_point, one * held.data[:, None], len(joints)) / total for one in (before, after))
        apart = ((before - middle[of_point]) ** 2).sum(axis=1) * held.data
        spread = np.sqrt(group_sums(of_point, apart[:, None], len(joints)) / total)
        away = places[joints] - middle
        # an error of the fitted turn grows with the lever: far from its points a joint would be thrown about
        near = np.linalg.norm(away, axis=1, keepdims=True) <= _FAR * spread
        along = then + whole.scale * away @ whole.rotation.T
        positions[joints] = np.where(near, fitted.apply(places[joints], np.arange(len(joints))), along)
    if np.abs(positions - places).max() <= _STILL * np.ptp(rig.points, axis=0).max(initial=0.0):
        return skeleton
    return blend_skeletons([skeleton], binds[None], positions, np.ones((count, 1)))
