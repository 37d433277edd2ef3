"""The 68 landmarks of a face in its photos, by facepipe's own network, and from them in space."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.processors.scan_photos.camera import PhotoCamera
from facepipe.processors.scan_photos.photos import Photo
from facepipe.processors.scan_photos.triangulation import triangulate_all
from facepipe.scans import LANDMARK_COUNT, Scan, no_landmarks

_TOLERANCE = 0.012  # of a photo's longer side
_LEAST = 3  # photos
_OUTLINE = 17  # the first landmarks lie on the face's outline, another place of the skin in every photo


def landmark_sightings(photos: Sequence[Photo], step: Callable[[], None]) -> dict[str, dict[str, FloatArray]]:
    """Photo -> landmark number -> (2,) pixels, of photos that show a face; none where torch is not there.

    :param step: called before every photo
    """
    try:
        from facepipe.learn.networks import find_landmarks
    except ImportError:
        return {}
    found = {}
    for photo in photos:
        step()
        faces = find_landmarks(photo.pixels.astype(np.float32) / 255.0)
        if faces:
            places = faces[0].landmarks
            found[photo.name] = {f"{number:02d}": places[number] for number in range(_OUTLINE, LANDMARK_COUNT)}
    return found


def place_landmarks(
    sightings: Mapping[str, Mapping[str, FloatArray]], cameras: Mapping[str, PhotoCamera], scan: Scan
) -> FloatArray:
    """(68, 3) landmarks on the scan, NaN where photos don't agree; the outline of the face (0-16) is left out."""
    from scipy.spatial import cKDTree

    points = no_landmarks()
    if not sightings:
        return points
    size = float(np.median([max(one.width, one.height) for one in cameras.values()]))
    for name, place in triangulate_all(sightings, cameras, _TOLERANCE * size, _LEAST).items():
        points[int(name)] = place
    known = np.isfinite(points).all(axis=1)
    if known.any():
        reach = _TOLERANCE * size * float(np.median([_width(one, points[known]) for one in cameras.values()]))
        distance, near = cKDTree(scan.points).query(points[known])
        points[known] = np.where((distance <= reach)[:, None], scan.points[near], points[known])
    return points


def _width(camera: PhotoCamera, points: FloatArray) -> float:
    """How wide a pixel is at points (n, 3), at the median."""
    return float(np.median(camera.to_camera(points)[:, 2])) / camera.focal[0]
