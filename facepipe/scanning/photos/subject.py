"""What the cameras look at: which photos go together, and an upright scan about as large as a head."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import FitError, InputError
from facepipe.geometry.pinhole import nearest_to_lines
from facepipe.geometry.similarity import Similarity
from facepipe.scanning.photos.cameras import PhotoCamera
from facepipe.scanning.photos.structure import Structure

_ANGLES = np.radians((3.0, 35.0))  # between two photos whose depth is found together
_BEST_ANGLE = np.radians(13.0)
_FEWEST_SHARED = 16  # matched points
_ACROSS = 0.5  # least share of the line between two cameras that is across the view
_CROP = 1.25  # of the ball around the middle half of the points, and more, what counts as the person


@dataclass(frozen=True, kw_only=True)
class Subject:
    """The ball that the person is in."""

    center: FloatArray  # (3,)
    radius: float

    def holds(self, points: FloatArray) -> BoolArray:
        """(n,) which points are in it."""
        return np.asarray(np.linalg.norm(points - self.center, axis=1) <= self.radius)


def find_subject(structure: Structure) -> tuple[Subject, Structure]:
    """The ball around the place that the cameras look at, as large as the photos show there; and what is in it.

    :raises FitError: no matched point is in it
    """
    cameras = list(structure.cameras.values())
    center = _look_at(cameras)
    reach = [
        0.5 * max(camera.width, camera.height) / camera.focal[0] * float(np.linalg.norm(camera.eye - center))
        for camera in cameras
    ]
    subject = Subject(center=center, radius=_CROP * float(np.median(reach)))
    inside = subject.holds(structure.points)
    if np.count_nonzero(inside) < _FEWEST_SHARED:
        found = f"{np.count_nonzero(inside)} of {len(inside)} matched points lie where the cameras look"
        raise FitError("photos", f"{found}, expected {_FEWEST_SHARED} or more: photos taken around one person")
    return subject, replace(structure, points=structure.points[inside], seen=structure.seen[:, inside])


def _look_at(cameras: list[PhotoCamera]) -> FloatArray:
    """(3,) the point nearest to the axes of all cameras."""
    return nearest_to_lines(
        np.array([camera.eye for camera in cameras]), np.array([camera.ahead for camera in cameras])
    )


def choose_pairs(structure: Structure, subject: Subject, neighbours: int) -> list[tuple[int, int]]:
    """Pairs of cameras, lower number first: those of each camera's best neighbours.

    Best is a turn of some 13 degrees, and many matched points in common.

    :raises FitError: no two cameras go together
    """
    cameras = list(structure.cameras.values())
    shared = structure.seen.astype(np.int64) @ structure.seen.T.astype(np.int64)
    score = np.zeros(shared.shape)
    for i, a in enumerate(cameras):
        for j, b in enumerate(cameras):
            if i != j and shared[i, j] >= _FEWEST_SHARED:
                score[i, j] = _fitness(a, b, subject) * np.sqrt(shared[i, j])
    pairs = set()
    for i, row in enumerate(score):
        best = np.argsort(-row, kind="stable")[:neighbours]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in best if row[j] > 0}
    if not pairs:
        low, high = np.degrees(_ANGLES)
        raise FitError(
            "photos", f"no two are {low:g} to {high:g} degrees apart and show the same: photos closer together"
        )
    return sorted(pairs)


def _fitness(a: PhotoCamera, b: PhotoCamera, subject: Subject) -> float:
    """How well depth can be found with two cameras, 0..1; 0: not at all."""
    to_a, to_b = a.eye - subject.center, b.eye - subject.center
    line = b.eye - a.eye
    length = float(np.linalg.norm(line))
    cosine = float(to_a @ to_b / np.linalg.norm(to_a) / np.linalg.norm(to_b))
    angle = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    if not _ANGLES[0] <= angle <= _ANGLES[1]:
        return 0.0
    view = a.ahead + b.ahead
    along = abs(float(line @ view)) / length / float(np.linalg.norm(view))
    if np.sqrt(max(0.0, 1.0 - along**2)) < _ACROSS:
        return 0.0
    return float(np.exp(-(np.log(angle / _BEST_ANGLE) ** 2)))


def upright(structure: Structure, subject: Subject, radius: float) -> tuple[Structure, Subject]:
    """The same with Y up and Z towards the cameras, as most photos have it, and the subject's ball at the origin.

    :param radius: of the ball
    """
    cameras = list(structure.cameras.values())
    down = np.mean([camera.rotation[1] for camera in cameras], axis=0)
    backward = -np.mean([camera.ahead for camera in cameras], axis=0)
    if np.linalg.norm(down) < 1e-6 or np.linalg.norm(np.cross(down, backward)) < 1e-6:
        down, backward = cameras[0].rotation[1], -cameras[0].ahead
    up = -down / np.linalg.norm(down)
    z = backward - (backward @ up) * up
    z /= np.linalg.norm(z)
    rotation = np.stack([np.cross(up, z), up, z])
    scale = radius / subject.radius
    moved = Similarity(rotation=rotation, translation=-scale * rotation @ subject.center, scale=scale)
    return _moved(structure, moved), Subject(center=np.zeros(3), radius=radius)


def _moved(structure: Structure, by: Similarity) -> Structure:
    """The structure in other coordinates."""
    cameras = {name: move_camera(one, by) for name, one in structure.cameras.items()}
    return replace(structure, cameras=cameras, points=by.apply(structure.points))


def move_camera(camera: PhotoCamera, by: Similarity) -> PhotoCamera:
    """The camera that sees moved points as it saw them."""
    rotation = camera.rotation @ by.rotation.T
    return replace(camera, rotation=rotation, translation=by.scale * camera.translation - rotation @ by.translation)


def scale_of_markers(markers: Mapping[str, FloatArray], between: tuple[str, str, float]) -> float:
    """The factor that makes two markers the given distance apart.

    :raises InputError: one of them has no place, or they are at one place
    """
    first, second, distance = between
    for name in (first, second):
        if name not in markers:
            raise InputError(f"marker {name}", "two photos or more must show it at one place")
    apart = float(np.linalg.norm(markers[first] - markers[second]))
    if not apart > 0:
        raise InputError(f"markers {first} and {second}", "are at one place, expected some distance")
    return distance / apart
