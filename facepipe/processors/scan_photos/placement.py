"""The coordinates of a scan whose cameras were found: upright, seen from the front, about as large as a head."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.similarity import Similarity
from facepipe.processors.scan_photos.camera import PhotoCamera
from facepipe.processors.scan_photos.structure import Structure
from facepipe.processors.scan_photos.subject import Subject


def upright(structure: Structure, subject: Subject, radius: float) -> tuple[Structure, Subject]:
    """The same with Y up and Z towards the cameras, as most photos have it, and the subject's ball at the origin.

    :param radius: of the ball
    """
    cameras = list(structure.cameras.values())
    down = np.mean([one.rotation[1] for one in cameras], axis=0)
    backward = -np.mean([one.ahead for one in cameras], axis=0)
    if np.linalg.norm(down) < 1e-6 or np.linalg.norm(np.cross(down, backward)) < 1e-6:
        down, backward = cameras[0].rotation[1], -cameras[0].ahead
    up = -down / np.linalg.norm(down)
    z = backward - (backward @ up) * up
    z /= np.linalg.norm(z)
    rotation = np.stack([np.cross(up, z), up, z])
    scale = radius / subject.radius
    moved = Similarity(rotation=rotation, translation=-scale * rotation @ subject.center, scale=scale)
    return move(structure, moved), Subject(center=np.zeros(3), radius=radius)


def move(structure: Structure, by: Similarity) -> Structure:
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
