"""Landmarks of a template that lies on a head, put on the head's own points; and templates that have none yet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.threads import one_thread
from facepipe.parts import FaceParts, Landmarks, Mesh
from facepipe.scanning.transfer.fit import HeadFit, fit_head
from facepipe.scanning.transfer.head import Head, held_landmarks
from facepipe.scanning.transfer.people import built_in
from facepipe.scans import LANDMARK_SCHEME
from facepipe.verbs.whole_faces import whole_points

_CANDIDATES = 30  # points of the head that may stand for a landmark: enough that no two take the same


@one_thread()
def with_landmarks(parts: FaceParts, where: str) -> tuple[FaceParts, tuple[str, ...]]:
    """A face with multipie68 landmarks, its own or found on it, and what is to be said of those.

    Some that are found may be missing, and others are off by 3 to 4 mm along the jaw; so the built-in head is fitted
    to them and to the face, and its own, 0.3 to 1.7 mm off there, are taken, for 10 to 20 s more.

    :raises FitError: no face found on it, or several
    :raises InputError: no surface, more points than can be fitted, or no torch
    """
    if held_landmarks(parts, whole_points(parts)) is not None:
        return parts, ()
    head = Head.of(parts, where, None)
    skin = head.skin()
    surface = head.sewn[skin], head.surface.part_triangles(skin), head.landmarks
    body, people = built_in()
    fit = fit_head(body, people, *surface, name=where)
    meshes = with_marks(parts.meshes, head, skin, body.parts, fit)
    line = f"{where}: has no multipie68 landmarks: found on it (facepipe transfer puts them on it to be mended)"
    return replace(parts, meshes=tuple(meshes)), (line, *(f"{where}: {note}" for note in head.notes))


def with_marks(
    meshes: Sequence[Mesh], head: Head, skin: IntArray, body: FaceParts, fit: HeadFit, *, anew: bool = False
) -> list[Mesh]:
    """The meshes of `head` with the landmarks of the template that lies on it, and its anchor.

    :param skin: (m,) sewn points of the head
    :param body: the template
    :param anew: put its anchor in place of the head's own
    """
    chosen, own, points = face_mesh(head, skin)
    mesh = replace(meshes[chosen], anchor=None) if anew else meshes[chosen]
    marked = _marked(mesh, body, fit.points, fit.place.apply(points), own)
    return [marked if number == chosen else one for number, one in enumerate(meshes)]


def face_mesh(head: Head, skin: IntArray) -> tuple[int, IntArray, FloatArray]:
    """The mesh that has most of the skin, its points (k,) of that, and their places (k, 3).

    Landmarks of a scheme lie on one mesh.

    :param skin: (m,) sewn points of the head
    """
    ends = np.cumsum([len(mesh.points) for mesh in head.parts.meshes])[:-1]
    on_skin = np.split(np.isin(head.surface.group, skin), ends)
    chosen = int(np.argmax([part.sum() for part in on_skin]))
    own = np.flatnonzero(on_skin[chosen])
    return chosen, own, np.split(head.points, ends)[chosen][own]


def _marked(mesh: Mesh, body: FaceParts, points: FloatArray, places: FloatArray, own: IntArray) -> Mesh:
    """The mesh with the template's landmarks, and its anchor where the mesh has none.

    :param points: (n, 3) whole points of the template, lying on the head
    :param places: (k, 3) of the mesh's points `own` (k,), in the same space
    """
    landmarks, anchor, start = dict(mesh.landmarks), mesh.anchor, 0
    for part in body.meshes:
        for scheme, marks in part.landmarks.items():
            chosen = own[own_points(points[start + marks.indices], places)]
            if scheme == LANDMARK_SCHEME:
                landmarks[scheme] = Landmarks(indices=chosen.astype(np.int32), names=marks.names)
        if part.anchor is not None and mesh.anchor is None:
            nearest = np.linalg.norm(places - points[start + part.anchor], axis=1).argmin()
            anchor = int(own[nearest])
        start += len(part.points)
    return replace(mesh, landmarks=landmarks, anchor=anchor)


def own_points(marks: FloatArray, places: FloatArray) -> IntArray:
    """(l,) the points of `places` (m, 3) that stand for `marks` (l, 3), no two the same: those that are nearest in all.

    On coarse meshes one point is the nearest to two landmarks; either would then move the other's.
    """
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial import cKDTree

    count = min(max(_CANDIDATES, len(marks)), len(places))
    near = np.unique(cKDTree(places).query(marks, k=np.arange(1, count + 1))[1])
    distances = np.linalg.norm(marks[:, None] - places[near][None], axis=2)
    rows, columns = linear_sum_assignment(distances**2)
    chosen = np.full(len(marks), -1)
    chosen[rows] = near[columns]
    return chosen
