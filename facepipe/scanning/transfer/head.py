"""A head of others: the surface of all its meshes, the landmarks on it, and the piece that is its skin."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.geometry.closest_points import closest_places
from facepipe.geometry.polygons import point_triangles
from facepipe.geometry.scan_surface import outward_triangles
from facepipe.geometry.vectors import transformed
from facepipe.importers.scan_file import USD, scan_of
from facepipe.importers.scan_hints import hints_of
from facepipe.parts import FaceParts, Mesh, exact
from facepipe.rig.joint_names import human_joint
from facepipe.rig.plausibility import in_usual_unit
from facepipe.scanning.rebuild.declared import UNITS
from facepipe.scanning.transfer.pieces import LAYERED, SKIN_MARKS, Hints
from facepipe.scans import LANDMARK_SCHEME, Scan, ScanLandmarks
from facepipe.verbs.skin.surface import Surface, surface_of
from facepipe.verbs.whole_faces import MILLIMETRES, to_millimetres, whole_points, world_to_world

_BARE = (".ply", ".stl", ".off")  # of meshes without names or materials, which no importer reads as faces
_FEWEST = 6  # landmarks
_MOST = 300_000  # points of skin: 225,000 take 43 s and 1.6 GB
_SKIN_POINTS = 100  # pieces of fewer are no skin
_LEVEL = 0.005  # of the size of the landmarks: how far apart levels of detail are
_REACH = 0.05  # of the size of the landmarks: a mesh so far from one has it
_OFF = 0.15  # of the size of the landmarks: those of the head itself, found or by hand, are 0.001 to 0.03 off


def made_head(path: Path) -> tuple[FaceParts, tuple[str, ...]] | None:
    """The head of a file that says no unit, in the first usual one that gives it a plausible size, and of a USD file
    that no facepipe made, and what its import warns of; None: another, which is read as any face is.

    :raises FacepipeError: a file that can't be used, or a cloud of points
    """
    suffix, warnings = path.suffix.lower(), tuple[str, ...]()
    if suffix == ".obj":
        from facepipe.importers import load

        imported = load("obj", path)
        parts, warnings = imported.parts, imported.warnings
    elif suffix in _BARE:
        from facepipe.importers.scan_file import read_scan

        scan = read_scan(path)
        if scan.is_cloud:
            raise InputError(path, "a cloud of points, expected a mesh")
        mesh = Mesh(
            name="Head",
            points=scan.points,
            face_vertex_counts=np.full(len(scan.triangles), 3, np.int32),
            face_vertex_indices=scan.triangles.ravel(),
            colors=scan.colors,
        )
        parts = FaceParts(name=path.stem, meshes=(mesh,))
    else:
        return _of_other_stage(path) if suffix in USD else None
    return in_usual_unit(parts), warnings


def _of_other_stage(path: Path) -> tuple[FaceParts, tuple[str, ...]] | None:
    """What is imported of a stage without a face."""
    from facepipe.core import tokens
    from facepipe.importers import load
    from facepipe.stage.files import open_stage
    from facepipe.stage.prims import is_applied

    stage = open_stage(path)
    if any(is_applied(prim, tokens.FACE_API) for prim in stage.Traverse()):
        return None
    imported = load("usd", path)
    return imported.parts, imported.warnings


def read_head(path: Path) -> tuple[FaceParts, tuple[str, ...]]:
    """The head in any file, and what its import warns of.

    :raises FacepipeError: a file that can't be used
    """
    from facepipe.importers import read_face

    made = made_head(path)
    if made is not None:
        return made
    face = read_face(path)
    return face.parts(), face.warnings


@dataclass(frozen=True, kw_only=True)
class Head:
    """n whole points of a head of others, m of them sewn, and the 68 landmarks in the same space."""

    where: str
    parts: FaceParts
    points: FloatArray  # (n, 3) whole points, millimetres and Y up if the file's unit and axis are true
    surface: Surface  # points that a file splits at seams are one; triangles face outward, each once
    turned: BoolArray  # (t,) of these the ones that face inward in the file
    landmarks: ScanLandmarks
    source: str  # of the landmarks
    notes: tuple[str, ...]

    @classmethod
    def of(cls, parts: FaceParts, where: str, given: Path | None) -> Head:
        """A head with landmarks from a file, else its own, else found on it.

        :raises FacepipeError: a file that can't be used, or no landmarks found
        """
        points, source, notes = whole_points(parts), "the head's own", tuple[str, ...]()
        own = held_landmarks(parts, points)
        if given is not None:
            from facepipe.importers.scan_landmarks import read_scan_landmarks

            # of points alone: pictures of a head may be lost
            read = read_scan_landmarks(given, Scan(name=where, points=points, hints=hints_of(parts)))
            to = world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES)
            landmarks, source = ScanLandmarks(points=transformed(read.points, to), sigma_mm=read.sigma_mm), given.name
        elif own is not None:
            landmarks = own
        else:
            _check_size(parts, where)
            from facepipe.pictures.surface_view import draw_surface
            from facepipe.scanning.landmarks import FindScanLandmarks

            found = FindScanLandmarks(draw=draw_surface)(_scan(parts, where))
            landmarks, source, notes = found.landmarks, "found on the head", found.report.warnings
        if landmarks.known.sum() < _FEWEST:
            what = f"{int(landmarks.known.sum())} of 68 are known, expected {_FEWEST} or more"
            raise InputError(f"{where} -> landmarks", what)
        surface = surface_of(parts, where, _layers(parts, points, landmarks))
        triangles, turned = outward_triangles(surface.points, surface.triangles)
        head = cls(
            where=where,
            parts=parts,
            points=points,
            surface=replace(surface, triangles=triangles),
            turned=turned,
            landmarks=landmarks,
            source=source,
            notes=notes,
        )
        head.check_landmarks()
        return head

    def check_landmarks(self) -> None:
        """Check that landmarks lie about on the head: in another unit or place they would be fitted for nothing.

        :raises InputError: most don't
        """
        marks, mm = self.landmarks.points[self.landmarks.known], 1000.0 * self.parts.meters_per_unit
        size = float(np.linalg.norm(np.ptp(marks, axis=0)))

        def off(scale: float) -> float:
            """Median distance from the head, of the landmarks' size, if they are taken as so much larger."""
            nearest = closest_places(marks * scale, self.sewn, self.surface.triangles)
            return float(np.median(nearest.distances)) / max(size * scale, np.finfo(np.float64).tiny)

        if (away := off(1.0)) > _OFF:
            meant = [f"; taken in {name} they would" for name, unit in UNITS.items() if off(unit / mm) <= _OFF]
            what = f"they lie {away * size:.3g} mm from it, expected on it, in its own coordinates (units of {mm:g} mm)"
            raise InputError(f"{self.where} -> landmarks", what + "".join(meant[:1]))

    @cached_property
    def sewn(self) -> FloatArray:
        """(m, 3) where the points of the surface lie among whole points: a surface keeps the up axis of its stage."""
        return self.points[np.unique(self.surface.group, return_index=True)[1]]

    def skin(self) -> IntArray:
        """Sewn points of the piece that carries nose, mouth and jaw: most landmarks are nearest to it.

        :raises InputError: more than can be fitted and carried to within a minute
        """
        known = self.landmarks.points[self.landmarks.known]
        of_triangle = self.surface.component[self.surface.triangles[:, 0]]
        nearest = closest_places(known, self.sewn, self.surface.triangles)
        chosen = int(np.bincount(of_triangle[nearest.triangles]).argmax())
        # of levels of detail, on which landmarks lie by chance, the finest
        sizes = np.bincount(of_triangle)
        near = nearest.distances + _LEVEL * float(np.linalg.norm(np.ptp(known, axis=0)))
        for other in np.flatnonzero(sizes > sizes[chosen]):
            level = closest_places(known, self.sewn, self.surface.triangles[of_triangle == other])
            if (level.distances < near).mean() > LAYERED and sizes[other] > sizes[chosen]:
                chosen = int(other)
        found = np.flatnonzero(self.surface.component == chosen)
        if len(found) > _MOST:
            raise _too_many(self.where, len(found))
        return found

    def whole(self, values: FloatArray) -> FloatArray:
        """(n, 3) of whole points, of values (m, 3) of the sewn ones."""
        return np.asarray(values[self.surface.group])

    def carried_by(self, part: str) -> FloatArray | None:
        """(m,) weight of the joint of a part, as `human_joint` finds it, at the sewn points; None: no such joint."""
        joint = human_joint(self.parts, part)
        if joint is None:
            return None
        weights, start = np.zeros(len(self.sewn)), 0
        for mesh in self.parts.meshes:
            group = self.surface.group[start : start + len(mesh.points)]
            start += len(mesh.points)
            if mesh.skin is not None:
                weights[group] = (mesh.skin.joint_weights * (mesh.skin.joint_indices == joint)).sum(axis=1)
        return weights

    def hints(self) -> Hints:
        """What names of meshes and a jaw's joint say of the sewn points."""
        names, mesh = tuple(exact(mesh) for mesh in self.parts.meshes), self.surface.mesh
        # what the mesh with the skin is called says nothing of its pieces: "Brown Man", "head_hair"
        of_skin = np.isin(mesh, mesh[self.skin()])
        return Hints(names=names, name=np.where(of_skin, -1, mesh), jaw=self.carried_by("Jaw"))

    def scan_of_skin(self) -> Scan:
        """The piece that carries the face as a scan, with its colours."""
        scan = _scan(self.parts, self.where)
        is_skin = np.zeros(len(self.surface.points), bool)
        is_skin[self.skin()] = True
        start, kept = 0, []
        for mesh in self.parts.meshes:
            group = self.surface.group[start : start + len(mesh.points)]
            kept.append(is_skin[group][point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)].all(axis=1))
            start += len(mesh.points)
        shown = np.concatenate(kept)
        used, corners = np.unique(scan.triangles[shown], return_inverse=True)
        return replace(
            scan,
            points=scan.points[used],
            triangles=corners.reshape(-1, 3).astype(np.int32),
            normals=None if scan.normals is None else scan.normals[used],
            colors=None if scan.colors is None else scan.colors[used],
            texture=None if scan.texture is None else scan.texture.on_triangles(shown),
        )


def _check_size(parts: FaceParts, where: str) -> None:
    """Refuse, before its landmarks are searched for 10 to 40 s, a head each piece of which has too many points.

    Meshes are not sewn to one another here, as of levels of detail only one counts.

    :raises InputError: more than can be fitted and carried to within a minute, whichever piece is the skin
    """
    if parts.point_count > _MOST:
        sizes = np.bincount(surface_of(parts, where, range(len(parts.meshes))).component)
        fewest = int(sizes[sizes >= _SKIN_POINTS].min(initial=parts.point_count))
        if fewest > _MOST:
            raise _too_many(where, fewest)


def _too_many(where: str, count: int) -> InputError:
    what = f"its skin has {count:,} points, expected at most {_MOST:,}: lower its resolution first"
    return InputError(where, what)


def _scan(parts: FaceParts, where: str) -> Scan:
    """All meshes as one scan, in the space of whole points."""
    pairs = zip(parts.meshes, to_millimetres(parts), strict=True)
    meshes = tuple(replace(mesh, transform=to) for mesh, to in pairs)
    hints = hints_of(replace(parts, meshes=meshes, meters_per_unit=0.001, up_axis="Y"))
    return replace(scan_of(meshes, {one.name: one for one in parts.materials}, where), hints=hints)


def _layers(parts: FaceParts, points: FloatArray, landmarks: ScanLandmarks) -> list[int]:
    """A number for each mesh: others for those after the first that have the whole face again, such as coarser levels
    of detail, whose borders must not be sewn to the first's.

    :param points: (n, 3) whole points
    """
    known = landmarks.points[landmarks.known]
    marks = landmarks.points[SKIN_MARKS][landmarks.known[SKIN_MARKS]]
    reach, layers, start = _REACH * float(np.linalg.norm(np.ptp(known, axis=0))), [], 0
    for mesh in parts.meshes:
        own = points[start : start + len(mesh.points)]
        triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
        start += len(mesh.points)
        near = closest_places(marks, own, triangles).distances < reach if len(triangles) and len(marks) else np.zeros(1)
        layers.append(bool(near.mean() > LAYERED))
    return [0 if not layer else sum(layers[:number]) for number, layer in enumerate(layers)]


def held_landmarks(parts: FaceParts, points: FloatArray) -> ScanLandmarks | None:
    """Those of a face at its whole points (n, 3); None: it has none."""
    start = 0
    for mesh in parts.meshes:
        own = mesh.landmarks.get(LANDMARK_SCHEME)
        if own is not None and len(own.indices) == 68:
            return ScanLandmarks(points=points[start + np.asarray(own.indices, np.int64)])
        start += len(mesh.points)
    return None
