"""A scan read with its landmarks and made ready to be fitted to, how a face lies on it, and the picture of both."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import FacepipeError
from facepipe.core.reports import Watch
from facepipe.geometry.polygons import point_normals
from facepipe.geometry.registration import Registered, RegistrationOptions, ScanTarget
from facepipe.geometry.similarity import Similarity
from facepipe.scanning.clean_scan import CleanScan
from facepipe.scanning.rebuild.declared import UNITS
from facepipe.scanning.rebuild.template import Template
from facepipe.scans import Scan, ScanLandmarks

if TYPE_CHECKING:
    from facepipe.scanning.photos import PhotoScan

_PARTS = {"brows": range(17, 27), "lids": range(36, 48), "lips": range(48, 68)}  # landmarks
_ALIKE = 0.15  # a scale nearer than this to a unit's counts as that unit


@dataclass(frozen=True, kw_only=True)
class ScanFit:
    """How a face lies on a scan."""

    scan: str
    mm_per_unit: float  # of the scan's coordinates
    unit: str | None  # what that is nearest to; None where it is like no unit
    surface_mean_mm: float  # distances of matched points from the scan
    surface_p95_mm: float
    coverage: float  # share 0..1 of the face area that has a match
    landmark_mean_mm: float
    slid_mm: Mapping[str, float]  # brows, lids, lips: how far off their landmarks points lie along the surface, RMS
    outliers: tuple[str, ...]  # landmarks and markers that are ignored
    steps: int


def slid_text(slid_mm: Mapping[str, float]) -> str:
    """How far parts of a face may have slid along a scan, as `ScanFit.slid_mm`."""
    return ", ".join(f"{part} {off:.2f} mm" for part, off in slid_mm.items())


def fit_rows(fit: ScanFit) -> list[tuple[str, str]]:
    """How a face lies on a scan, for a table."""
    off = f", {len(fit.outliers)} of them outliers" if fit.outliers else ""
    return [
        ("distance from the scan", f"mean {fit.surface_mean_mm:.3f} mm, 95 % below {fit.surface_p95_mm:.3f} mm"),
        ("face area that the scan shows", f"{100 * fit.coverage:.1f} %"),
        ("landmarks", f"{fit.landmark_mean_mm:.2f} mm off (mean){off}"),
    ]


# What is known of a scan: it, its landmarks, warnings, and what `facepipe scan` reports of its photos.
Given = tuple[Scan, ScanLandmarks, tuple[str, ...], Mapping[str, Any]]


def scan_input(source: Path, landmarks: Path | None, watch: Watch) -> Given:
    """The scan in a file, or that of the photos in a folder.

    :param landmarks: their file; None: they come from the photos, or are found on the scan
    :raises FacepipeError: files that can't be used, photos that give no scan, or no landmarks found
    """
    from facepipe.importers.scan_file import read_scan
    from facepipe.scanning.photos import ScanPhotos, bars

    if not source.is_dir():
        scan = read_scan(source)
        return (scan, *landmarks_of(landmarks, scan), {})
    with named(source), bars(watch) as step:
        made = ScanPhotos()(source, step)
    return input_of_photos(made, landmarks)


def input_of_photos(made: PhotoScan, landmarks: Path | None) -> Given:
    """The same of the scan that photos gave."""
    found, warnings = landmarks_of(landmarks, made.scan, made.landmarks)
    return made.scan, found, (*made.report.warnings, *warnings), made.report.to_dict()


def landmarks_of(
    file: Path | None, scan: Scan, known: ScanLandmarks | None = None
) -> tuple[ScanLandmarks, tuple[str, ...]]:
    """Landmarks from a file, else the known ones, else those that are found on the scan; and warnings.

    :raises FacepipeError: a file that can't be used, or no landmarks found
    """
    from facepipe.importers.scan_landmarks import read_scan_landmarks

    if file is not None:
        return read_scan_landmarks(file, scan), ()
    if known is not None and known.known.any():
        return known, ()
    from facepipe.pictures.surface_view import draw_surface
    from facepipe.scanning.landmarks import FindScanLandmarks

    found = FindScanLandmarks(draw=draw_surface)(scan)
    return found.landmarks, found.report.warnings


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Errors with the file that they are about."""
    try:
        yield
    except FacepipeError as error:
        raise error if str(path) in error.where else error.under(path) from None


def scan_target(scan: Scan) -> tuple[ScanTarget, tuple[str, ...]]:
    """A scan mended and with normals, and what was mended.

    :raises InputError: nothing to fit to
    """
    cleaned = CleanScan()(scan)
    mended = cleaned.scan
    repairs = tuple(f"{scan.name}: {line}" for line in cleaned.report.warnings)
    if mended.is_cloud:
        return ScanTarget.of_cloud(mended.points, np.asarray(mended.normals)), repairs
    return ScanTarget.of_surface(mended.points, mended.triangles), repairs


def unit_of(mm_per_unit: float) -> str | None:
    """The unit that a scale is nearest to, within 15 %."""
    return next((name for name, size in UNITS.items() if abs(mm_per_unit / size - 1.0) <= _ALIKE), None)


def scan_fit(scan: str, registered: Registered, face: BoolArray, names: tuple[str, ...]) -> ScanFit:
    """What to report of a registration.

    :param face: (m,) points of the face area
    :param names: of the anchors
    """
    distances = registered.distances[np.isfinite(registered.distances)]
    # By landmarks alone: elsewhere nothing says how far a face has slid along its scan.
    slides = dict(zip(names, registered.anchor_slides, strict=True))
    known = {part: [slides[key] for i in marks if (key := f"landmark {i}") in slides] for part, marks in _PARTS.items()}
    return ScanFit(
        scan=scan,
        mm_per_unit=registered.place.scale,
        unit=unit_of(registered.place.scale),
        surface_mean_mm=float(distances.mean()) if len(distances) else float("nan"),
        surface_p95_mm=float(np.percentile(distances, 95)) if len(distances) else float("nan"),
        coverage=float(registered.matched[face].mean()) if face.any() else 0.0,
        landmark_mean_mm=float(registered.anchor_distances.mean())
        if len(registered.anchor_distances)
        else float("nan"),
        slid_mm={part: float(np.sqrt(np.mean(np.square(found)))) for part, found in known.items() if found},
        outliers=tuple(names[number] for number in registered.outliers),
        steps=registered.steps,
    )


def in_place(scan: Scan, place: Similarity) -> Scan:
    """The scan, mended and with normals, where a fit has found it to be.

    :raises InputError: a scan that can't be used
    """
    moved = scan_target(scan)[0].moved(place)
    return replace(scan, points=moved.points, triangles=moved.triangles, normals=moved.normals, colors=None)


def scan_distances(template: Template, points: FloatArray, scan: Scan, place: Similarity) -> FloatArray:
    """(n,) millimetres from whole points (n, 3) to the scan, NaN where it doesn't show them.

    A point is shown where it can be seen from outside and the nearest place of the scan is within the reach of
    registrations, faces the same way and is not on the scan's border.

    :param place: from the scan's coordinates to those of the points
    :raises InputError: a scan that can't be used
    """
    target, reach_mm = scan_target(scan)[0], RegistrationOptions().reach_mm
    by_row = row_distances(template, points[template.rows], target, place, reach_mm)
    return np.where(template.row_of >= 0, by_row[template.row_of], np.nan)


def row_distances(
    template: Template, rows: FloatArray, target: ScanTarget, place: Similarity, reach_mm: float
) -> FloatArray:
    """(m,) the same of the skin's rows (m, 3), from a scan made ready."""
    seen = template.seen
    normals = point_normals(rows, template.triangles)[seen]
    matches = target.matches(rows[seen], normals, reach_mm, RegistrationOptions().angle, place)
    distances = np.full(len(rows), np.nan)
    distances[seen[matches.kept]] = matches.distances[matches.kept]
    return distances


def draw_face_on_scan(
    path: Path,
    *,
    template: Template,
    points: FloatArray,
    scan: Scan,
    place: Similarity,
    neutral: FloatArray | None = None,
) -> None:
    """Draw a scan, a face as it shows it, and their distance.

    :param points: (n, 3) whole points
    :param place: from the scan's coordinates to those of the points
    :param neutral: (n, 3) the points without what the scan shows besides, where that is something
    """
    from facepipe.pictures import save_png
    from facepipe.scanning.rebuild_pictures import FitPicture, fit_sheet
    from facepipe.verbs.whole_faces import whole_parts

    sheet = FitPicture(
        parts=whole_parts(template.parts, points),
        landmarks=points[template.rows[template.landmarks]],
        scan=in_place(scan, place),
        distances=scan_distances(template, points, scan, place),
        neutral=None if neutral is None else whole_parts(template.parts, neutral),
    )
    save_png(fit_sheet(sheet), path)
