"""Scan from photos: photos of one expression in, a coloured surface, its cameras and landmarks out."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import Float32Array, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.reports import Report, Watch, not_in_json
from facepipe.core.threads import one_thread
from facepipe.geometry.colors import from_srgb
from facepipe.geometry.rasterise import rasterise, screen_triangles
from facepipe.scanning.landmarks.find import found_sigmas
from facepipe.scanning.photos.cameras import (
    Cameras,
    PhotoCamera,
    Sightings,
    landmark_sightings,
    place_landmarks,
    triangulate_all,
)
from facepipe.scanning.photos.depth import depth_maps
from facepipe.scanning.photos.options import FEWEST_PHOTOS, ScanPhotosOptions
from facepipe.scanning.photos.photos import Photo, fitting, photo_files, read_photos
from facepipe.scanning.photos.structure import (
    Structure,
    choose_pairs,
    find_structure,
    find_subject,
    scale_of_markers,
    upright,
)
from facepipe.scanning.photos.surface import make_cloud, make_surface
from facepipe.scans import Scan, ScanLandmarks

_LARGEST = 1600  # pixels a side of the depth that decides what a photo sees
_BEHIND = 8.0  # widths of such a pixel: a place so far behind the surface still is on it
_EDGE = 5  # such pixels across, around what hides something
_FRAME = 4.0  # pixels off the photo's border
_TURNED = 0.2  # cosine to the viewer that a place needs
_AHEAD = 8  # power of the cosine: photos from ahead count most
_FINER = 1.5  # than the places: how much photos stay; less would blur, more would be noise
_CHUNK = 1 << 14  # places at a time: OpenCV takes no more than 32766
Step = Callable[[str, int], None]
_DOUBTFUL = 1.5  # pixels: mean distance of matched points from where photos show them
_MARKED = 0.006  # of a photo's longer side: how far a marker may be from where it was seen


@dataclass(frozen=True, kw_only=True)
class PhotoColors:
    """Photos around a scan."""

    folder: Path
    cameras: Mapping[str, PhotoCamera]  # by the photos' names
    points: FloatArray  # (n, 3) of the scan
    triangles: IntArray  # (t, 3)

    def __call__(self, points: FloatArray, normals: FloatArray, spacing: float) -> Float32Array:
        """(m, 3) linear colours at places (m, 3) of the scan's surface; NaN where no photo sees them.

        :param normals: (m, 3) unit, outward
        :param spacing: distance of the places; much finer photos are shrunk
        :raises InputError: a photo that can't be read
        """
        import cv2
        from scipy.ndimage import minimum_filter

        levels = from_srgb(np.arange(256) / 255).astype(np.float32)
        total, weights = np.zeros((len(points), 3), np.float32), np.zeros(len(points), np.float32)
        for name, camera in self.cameras.items():
            small = camera.scaled(*fitting((camera.width, camera.height), _LARGEST))
            ahead = small.to_camera(self.points)[:, 2]
            flat = np.nan_to_num(small.project(self.points)) * ahead[:, None]
            screen = screen_triangles(np.column_stack([flat, np.ones(len(ahead)), ahead]), self.triangles)
            with np.errstate(divide="ignore"):  # infinite where there is no surface; drawn out at edges
                depth = minimum_filter(1 / rasterise(screen, small.width, small.height).nearness, _EDGE)
            longer = max(camera.width, camera.height)
            width = float(np.median(camera.to_camera(self.points)[:, 2])) / camera.focal[0]
            most = int(np.ceil(longer * min(1.0, _FINER * width / spacing)))  # no pixels much finer than the places
            pixels = read_photos([self.folder / name], most)[0].pixels
            for start in range(0, len(points), _CHUNK):
                at = slice(start, start + _CHUNK)
                seen, weight, places = _seen(camera, depth, points[at], normals[at])
                if len(places):
                    where = (places * pixels.shape[1::-1] - 0.5).astype(np.float32)[:, None]
                    shown: Any = cv2.remap(pixels, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
                    total[start + seen] += weight[:, None] * levels[shown[:, 0]]
                    weights[start + seen] += weight
        with np.errstate(invalid="ignore"):
            return np.asarray(total / weights[:, None])


def _seen(
    camera: PhotoCamera, depth: FloatArray, points: FloatArray, normals: FloatArray
) -> tuple[IntArray, Float32Array, FloatArray]:
    """Which of the places (m, 3) a photo sees (s,), how much it counts there (s,), and where it shows them (s, 2).

    :param depth: (h, w) of the nearest surface
    """
    towards = camera.eye - points
    ahead = np.einsum("mc,mc->m", normals, towards) / np.linalg.norm(towards, axis=1)
    turned = np.flatnonzero(ahead > _TURNED)
    size = np.array([camera.width, camera.height])
    pixels, own = camera.project(points[turned]), camera.to_camera(points[turned])[:, 2]
    border = np.minimum(pixels, size - pixels).min(axis=1) / _FRAME
    column, row = (np.where(border[:, None] > 0, pixels / size, 0) * depth.shape[::-1]).astype(np.int64).T
    behind = _BEHIND * own / camera.focal[0] * camera.width / depth.shape[1]
    kept = np.flatnonzero((border > 0) & (own <= depth[row, column] + behind))
    seen = turned[kept]
    weight = ahead[seen] ** _AHEAD * np.minimum(border[kept], 1)
    return seen, weight.astype(np.float32), pixels[kept] / size


@dataclass(frozen=True, kw_only=True)
class ScanPhotosReport(Report):
    """How a scan came out of photos. Lengths are in `unit`; None: the scale is unknown, they are of the scan's own."""

    photos_used: tuple[str, ...] = ()
    photos_unused: tuple[str, ...] = ()  # could not be placed
    cameras: str = "found"  # or "given"
    unit: str | None = None  # mm, cm or m
    reprojection_px: float = 0.0  # mean distance of matched points from where photos show them
    matched_points: int = 0
    pairs: int = 0  # of photos, whose depth was found together
    spacing: float = 0.0  # distance of the dense points
    dense_points: int = 0  # after cleaning
    consistency: float = 0.0  # median distance between the surfaces that different photos give, along the view
    consistency_px: float = 0.0  # the same in widths of a pixel on the skin
    points: int = 0  # of the scan
    triangles: int = 0
    landmarks: int = 0  # of 68
    markers: int = 0
    seconds: float = 0.0
    used: Any = not_in_json()  # the `Cameras` of the photos that were used


@contextmanager
def bars(watch: Watch) -> Iterator[Step]:
    """A bar for each kind of work, one after the other."""
    with ExitStack() as stack:
        shown: dict[str, Any] = {}

        def step(name: str, total: int) -> None:
            if name not in shown:
                stack.close()
                shown[name] = stack.enter_context(watch(name, total))
            shown[name].update()

        yield step


@dataclass(frozen=True, kw_only=True)
class PhotoScan:
    """What photos gave."""

    scan: Scan
    cameras: Cameras  # of the photos that were used, full size
    landmarks: ScanLandmarks
    report: ScanPhotosReport


@dataclass(frozen=True, kw_only=True)
class ScanPhotos:
    """Makes a scan of a folder of photos, taken at one moment from around a face (document S11, S12).

    :raises InputError: the distance between two markers is not above 0
    """

    options: ScanPhotosOptions = field(default_factory=ScanPhotosOptions)
    cameras: Cameras | None = None  # known ones; None: found from the photos
    markers: Sightings = field(default_factory=dict)
    marker_distance: tuple[str, str, float] | None = None  # two markers and the millimetres between them
    masks: Path | None = None  # folder of masks

    def __post_init__(self) -> None:
        if self.marker_distance is not None:
            distance = self.marker_distance[2]
            if not (math.isfinite(distance) and distance > 0):
                raise InputError("marker distance", f"{distance} mm, expected a length above 0")
            if self.cameras is not None:
                raise InputError("marker distance", "given with cameras, which have a scale, expected one of them")

    @one_thread()
    def __call__(self, folder: Path, step: Step = lambda name, total: None) -> PhotoScan:
        """The scan of the photos in `folder`.

        :param step: called with the name of the work and its count of steps, before each one
        :raises InputError: too few photos, one that can't be read, masks or cameras that don't fit, a library missing
        :raises FitError: too few photos could be placed, or they don't agree on a surface
        """
        start = time.perf_counter()
        files, others = photo_files(folder)
        photos = read_photos(files, self.options.pixels, self.masks)
        warnings = [f"{name} is not a photo and was left out" for name in others if not name.endswith(".json")]
        step("cameras", 1)
        known: dict[str, PhotoCamera] | None = None
        if self.cameras is not None:  # as the photos are used
            known = {}
            for photo in photos:
                camera = self.cameras.cameras.get(photo.name)
                if camera is None:
                    continue
                if (camera.width, camera.height) != photo.full_size:
                    size = f"{photo.full_size[0]} x {photo.full_size[1]}"
                    what = f"{size} pixels, expected {camera.width} x {camera.height} of its camera"
                    raise InputError(folder / photo.name, what)
                known[photo.name] = camera.scaled(photo.width, photo.height)
            if len(known) < FEWEST_PHOTOS:
                what = f"{len(known)} photos have a known camera, expected {FEWEST_PHOTOS} or more"
                raise InputError(folder, what)
        structure = find_structure(photos, self.options, known)
        made = self._scan(folder.name, [photo for photo in photos if photo.name in structure.cameras], structure, step)
        unused = tuple(photo.name for photo in photos if photo.name not in structure.cameras)
        if unused:
            reason = "have no known camera" if known is not None else "could not be placed"
            warnings.append(f"{len(unused)} of {len(photos)} photos {reason}: {', '.join(unused[:8])}")
        report = replace(
            made.report,
            photos_unused=unused,
            warnings=(*warnings, *made.report.warnings),
            seconds=time.perf_counter() - start,
        )
        shown = PhotoColors(
            folder=folder, cameras=made.cameras.cameras, points=made.scan.points, triangles=made.scan.triangles
        )
        return replace(made, scan=replace(made.scan, photos=shown), report=report)

    def _scan(self, name: str, photos: list[Photo], structure: Structure, step: Step) -> PhotoScan:
        """The scan of photos that have a camera, without warnings on the others."""
        options = self.options
        subject, structure = find_subject(structure)
        if self.cameras is None:  # upright, and in millimetres where two markers give the scale
            radius = options.radius
            if self.marker_distance is not None:
                markers = self._markers(photos, structure)
                radius = subject.radius * scale_of_markers(markers, self.marker_distance)
            structure, subject = upright(structure, subject, radius)
        cameras = [structure.cameras[photo.name] for photo in photos]
        pairs = choose_pairs(structure, subject, options.neighbours)
        each_pair, each_photo = (lambda: step("depth", len(pairs))), (lambda: step("points", len(photos)))
        maps = depth_maps(photos, structure, pairs, options.agreement, options.texture, each_pair)
        cloud, apart = make_cloud(photos, cameras, maps, subject, options, each_photo)
        step("surface", 1)
        scan = make_surface(cloud, name, gap=options.gap, smallest=options.smallest)
        warnings = []
        if structure.error > _DOUBTFUL:
            off = f"matched points are {structure.error:.1f} pixels off"
            warnings.append(f"{off}: cameras that don't fit, or a face that moved")
        landmarks = ScanLandmarks(markers=self._markers(photos, structure))
        lost = sorted({one for seen in self.markers.values() for one in seen} - set(landmarks.markers))
        warnings += [f"marker {one}: no 2 photos show it at one place" for one in lost]
        if options.landmarks:
            sightings = landmark_sightings(photos, lambda: step("landmarks", len(photos)))
            points = place_landmarks(sightings, structure.cameras, scan)
            landmarks = replace(landmarks, points=points, sigma_mm=found_sigmas(colored=True))
        report = ScanPhotosReport(
            photos_used=tuple(photo.name for photo in photos),
            cameras="found" if self.cameras is None else "given",
            unit=self._unit,
            reprojection_px=structure.error,
            matched_points=len(structure.points),
            pairs=len(pairs),
            spacing=cloud.spacing,
            dense_points=len(cloud.points),
            consistency=apart,
            consistency_px=apart / cloud.spacing * options.spacing,
            points=len(scan.points),
            triangles=len(scan.triangles),
            landmarks=int(landmarks.known.sum()),
            markers=len(landmarks.markers),
            warnings=tuple(warnings),
        )
        full = {photo.name: structure.cameras[photo.name].scaled(*photo.full_size) for photo in photos}
        return PhotoScan(scan=scan, cameras=Cameras(cameras=full, unit=self._unit), landmarks=landmarks, report=report)

    @property
    def _unit(self) -> str | None:
        if self.cameras is not None:
            return self.cameras.unit
        return "mm" if self.marker_distance is not None else None

    def _markers(self, photos: list[Photo], structure: Structure) -> dict[str, FloatArray]:
        """Markers in space, by name."""
        sizes = {one.name: np.array([one.width, one.height]) / one.full_size for one in photos}
        seen = {
            photo: {name: place * sizes[photo] for name, place in one.items()}
            for photo, one in self.markers.items()
            if photo in sizes
        }
        size = float(np.median([max(one.width, one.height) for one in photos]))
        return triangulate_all(seen, structure.cameras, _MARKED * size, 2)
