"""Places in space from their pixels in several photos, some of them wrong: markers and landmarks.

Document S11: painted markers follow the skin from expression to expression. The 68 landmarks are those of
facepipe's own network.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.reading import read_json_object
from facepipe.geometry.pinhole import nearest_to_lines
from facepipe.scanning.photos.cameras import PhotoCamera
from facepipe.scanning.photos.photos import Photo
from facepipe.scans import LANDMARK_COUNT, Scan, no_landmarks

Sightings = Mapping[str, Mapping[str, FloatArray]]  # photo -> what -> (2,) pixels of the upright photo, full size

_WIDE = np.cos(np.radians(3.0))  # rays closer together than this say little about depth
_LARGEST_FILE = 64_000_000  # bytes
_LARGEST = 1e9  # pixels
_TOLERANCE = 0.012  # of a photo's longer side
_LEAST = 3  # photos
_OUTLINE = 17  # the first landmarks lie on the face's outline, another place of the skin in every photo


def read_markers(path: Path) -> dict[str, dict[str, FloatArray]]:
    """``{"photos": {"front.jpg": {"chin": [x, y], ...}, ...}}``: pixels of the upright photo, from its top left corner.

    :raises InputError: not readable, or another content
    """
    photos = read_json_object(path, _LARGEST_FILE).get("photos")
    if not isinstance(photos, dict):
        raise InputError(f"{path} -> photos", "expected an object of markers by the names of photos")
    sightings: dict[str, dict[str, FloatArray]] = {}
    for photo, markers in photos.items():
        if not isinstance(markers, dict):
            raise InputError(f"{path} -> {photo[:80]}", "expected an object of places by the names of markers")
        sightings[photo] = {
            name: _pixel(one, f"{path} -> {photo[:80]} -> {name[:80]}") for name, one in markers.items()
        }
    return sightings


def _pixel(value: object, where: str) -> FloatArray:
    found: list[Any] = value if isinstance(value, list) else []
    # NaN fails the comparison
    if len(found) != 2 or not all(type(one) in (int, float) and abs(one) <= _LARGEST for one in found):
        raise InputError(where, f"{str(value)[:40]}, expected [x, y] in pixels")
    return np.array(value, dtype=np.float64)


def triangulate_all(
    sightings: Sightings, cameras: Mapping[str, PhotoCamera], tolerance: float, least: int
) -> dict[str, FloatArray]:
    """Name -> (3,) place of what `least` photos or more agree on, by name.

    :param sightings: in pixels of the cameras' photos
    :param tolerance: pixels
    """
    names = sorted({name for sighting in sightings.values() for name in sighting})
    places = {}
    for name in names:
        photos = [camera for camera in sorted(cameras) if name in sightings.get(camera, {})]
        pixels = np.array([sightings[photo][name] for photo in photos])
        place = triangulate([cameras[photo] for photo in photos], pixels, tolerance, least)
        if place is not None:
            places[name] = place
    return places


def triangulate(
    cameras: Sequence[PhotoCamera], pixels: FloatArray, tolerance: float, least: int = 2
) -> FloatArray | None:
    """(3,) the place that shows within `tolerance` pixels of most `pixels` (k, 2); None: fewer than `least` agree.

    Every two photos propose a place (all of them, so that nothing is left to chance); that of most agreement, and
    then of the smallest error, wins and is fitted to the photos that agree.
    """
    if len(cameras) < max(least, 2):
        return None
    eyes = np.array([camera.eye for camera in cameras])
    rays = np.concatenate([_ray(one, pixel) for one, pixel in zip(cameras, pixels, strict=True)])
    best: tuple[int, float] = (0, 0.0)
    chosen = None
    for pair in itertools.combinations(range(len(cameras)), 2):
        # a place's error along its rays is that across them over the sine of their angle: 19 times at 3 degrees
        if rays[pair[0]] @ rays[pair[1]] > _WIDE:
            continue
        error = _errors(cameras, pixels, nearest_to_lines(eyes[list(pair)], rays[list(pair)]))
        agree = error <= tolerance
        rank = (int(agree.sum()), -float(error[agree].sum()))
        if rank > best:
            best, chosen = rank, agree
    if chosen is None or best[0] < least:
        return None
    return nearest_to_lines(eyes[chosen], rays[chosen])


def _ray(camera: PhotoCamera, pixel: FloatArray) -> FloatArray:
    """(1, 3) unit vector in scan coordinates."""
    ray = np.append(camera.rays(pixel[None])[0], 1.0) @ camera.rotation
    return np.asarray(ray / np.linalg.norm(ray))[None]


def _errors(cameras: Sequence[PhotoCamera], pixels: FloatArray, place: FloatArray) -> FloatArray:
    """(k,) pixels between where a place shows and where it was seen; infinite behind a camera."""
    shown = np.concatenate([camera.project(place[None]) for camera in cameras])
    return np.asarray(np.nan_to_num(np.linalg.norm(shown - pixels, axis=1), nan=np.inf))


def landmark_sightings(photos: Sequence[Photo], step: Callable[[], None]) -> dict[str, dict[str, FloatArray]]:
    """Photo -> landmark number -> (2,) pixels, of photos that show a face; none where torch is not there.

    :param step: called before every photo
    """
    try:
        from facepipe.networks import find_landmarks
    except ImportError:
        return {}
    sightings = {}
    for photo in photos:
        step()
        faces = find_landmarks(photo.pixels.astype(np.float32) / 255.0)
        if faces:
            places = faces[0].landmarks
            sightings[photo.name] = {f"{number:02d}": places[number] for number in range(_OUTLINE, LANDMARK_COUNT)}
    return sightings


def place_landmarks(
    sightings: Mapping[str, Mapping[str, FloatArray]], cameras: Mapping[str, PhotoCamera], scan: Scan
) -> FloatArray:
    """(68, 3) landmarks on the scan, NaN where photos don't agree; the outline of the face (0-16) is left out."""
    from scipy.spatial import cKDTree

    points = no_landmarks()
    if not sightings:
        return points
    size = float(np.median([max(camera.width, camera.height) for camera in cameras.values()]))
    for name, place in triangulate_all(sightings, cameras, _TOLERANCE * size, _LEAST).items():
        points[int(name)] = place
    known = np.isfinite(points).all(axis=1)
    if known.any():
        reach = (
            _TOLERANCE * size * float(np.median([_pixel_width(camera, points[known]) for camera in cameras.values()]))
        )
        # by the same tolerance as the photos' agreement: farther off, the nearest point is another place of the face
        distance, near = cKDTree(scan.points).query(points[known])
        points[known] = np.where((distance <= reach)[:, None], scan.points[near], points[known])
    return points


def _pixel_width(camera: PhotoCamera, points: FloatArray) -> float:
    """How wide a pixel is at points (n, 3), at the median."""
    return float(np.median(camera.to_camera(points)[:, 2])) / camera.focal[0]
