"""An actor's neutral authored over the template."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import FloatArray, require_finite
from facepipe.core.errors import TopologyError
from facepipe.core.reports import Report
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.parts import FaceParts, Mesh, Recipe
from facepipe.processors.blend.normals import blend_normals
from facepipe.processors.blend.rigs import rebase_animations
from facepipe.processors.database.whole_faces import to_millimetres
from facepipe.processors.rebuild.carried_joints import carried_skeleton
from facepipe.processors.rebuild.neutral_shapes import STILL_MM, mesh_shapes
from facepipe.processors.same_topology import check_spaces
from facepipe.rig import mesh_spaces
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes


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
    """

    shapes: Mapping[str, FloatArray] = field(default_factory=dict)
    primvars: Mapping[str, FloatArray] = field(default_factory=dict)

    def __call__(self, face: Face, points: FloatArray, *, recipe: Recipe | None = None) -> AuthorNeutralReport:
        """Author whole `points` (n, 3), millimetres and Y up, on `face`, which stands over the template.

        :raises TopologyError: another number of points than the face has, or a transform without inverse
        :raises InputError: NaN or infinity; nothing is authored then
        """
        parts = face.parts()
        self._check(face, parts, points)
        authored = author_changes(face, replace(self._result(parts, points), recipe=recipe), self.primvars)
        return AuthorNeutralReport(authored=authored, warnings=tuple(self._said(parts)))

    def _check(self, face: Face, parts: FaceParts, points: FloatArray) -> None:
        check_spaces(face.where, parts)
        count = sum(len(mesh.points) for mesh in parts.meshes)
        named = {"points": points, **{f"shape {name}": delta for name, delta in self.shapes.items()}}
        for name, values in named.items():
            if np.shape(values) != (count, 3):
                raise TopologyError(f"{face.where} -> {name}", f"shape {np.shape(values)}, expected ({count}, 3)")
            require_finite(values, face.where, name)

    def _result(self, parts: FaceParts, points: FloatArray) -> FaceParts:
        cuts = np.cumsum([len(mesh.points) for mesh in parts.meshes])[:-1]
        own = np.split(np.asarray(points, np.float64), cuts)
        deltas = {name: np.split(np.asarray(delta, np.float64), cuts) for name, delta in self.shapes.items()}
        meshes, skeleton_space, still = [], [], self._still(parts)
        spaces = zip(parts.meshes, to_millimetres(parts), mesh_spaces(parts), strict=True)
        for number, (mesh, to, space) in enumerate(spaces):
            back = np.linalg.inv(to)
            local = _unless_same(own[number] @ back[:3, :3].T + back[:3, 3], mesh.points)
            new = {name: (one[number], mesh.name in still.get(name, ())) for name, one in deltas.items()}
            shapes = mesh_shapes(mesh, local, new, back[:3, :3])
            meshes.append(replace(mesh, points=local, normals=_normals(mesh, local), blendshapes=shapes))
            skeleton_space.append(local @ space[:3, :3].T + space[:3, 3])
        skeleton = carried_skeleton(parts, np.concatenate(skeleton_space))
        return replace(
            parts,
            meshes=tuple(meshes),
            skeleton=skeleton,
            animations=rebase_animations(parts.animations, parts.skeleton, skeleton),
            photos=(),
        )

    def _still(self, parts: FaceParts) -> dict[str, tuple[str, ...]]:
        """Shapes that move no point -> meshes that hold them all the same, so that what drives them finds them."""
        found = {}
        for name, delta in self.shapes.items():
            if np.linalg.norm(delta, axis=1).max(initial=0.0) < STILL_MM:
                holding = [mesh.name for mesh in parts.meshes if any(one.name == name for one in mesh.blendshapes)]
                found[name] = tuple(holding or [parts.meshes[0].name])
        return found

    def _said(self, parts: FaceParts) -> Iterator[str]:
        own = (shape for mesh in parts.meshes for shape in mesh.blendshapes)
        lost = sorted({shape.name for shape in own if shape.inbetweens and shape.name in self.shapes})
        if lost:
            yield f"inbetweens are left out, of {', '.join(lost)}"


def _unless_same(points: FloatArray, before: FloatArray) -> FloatArray:
    """`before` itself where points (n, 3) are the same as files hold them: what hangs on them stays too."""
    return before if np.array_equal(points.astype(np.float32), np.asarray(before, np.float32)) else points


def _normals(mesh: Mesh, points: FloatArray) -> FloatArray | None:
    """Normals of the new points, per point or corner as the mesh has them; what was put in by hand stays."""
    if mesh.normals is None or points is mesh.points:
        return mesh.normals
    triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
    rows = np.arange(len(points)) if len(mesh.normals) == len(points) else mesh.face_vertex_indices
    before, after = (point_normals(one, triangles)[rows] for one in (mesh.points, points))
    return blend_normals([mesh.normals], before[None], after, np.ones((len(rows), 1)))
