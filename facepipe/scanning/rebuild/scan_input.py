"""Scans and their landmarks as the actions of a rebuild take them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from facepipe.core.errors import FacepipeError
from facepipe.core.reading import file_beside
from facepipe.kinds import StageAction, Watch

if TYPE_CHECKING:
    from facepipe.scanning.photos import PhotoScan
    from facepipe.scanning.rebuild.action_reports import Judged
    from facepipe.scans import Scan, ScanLandmarks
    from facepipe.stage import Face

J = TypeVar("J", bound="Judged")


class ScanAction(StageAction[J]):
    """Base of the actions that put a face on a scan."""

    @classmethod
    def replaced(cls, arguments: Any) -> Collection[str]:
        """Landmarks of a scan in whose place the line gives another."""
        of_scans = (("scan", "landmarks"), ("neutral_scan", "neutral_landmarks"))
        return [landmarks for scan, landmarks in of_scans if getattr(arguments, scan, None)]

    def draw(self, face: Face, report: J, path: Path) -> None:
        """The picture of scan, face and their distance."""
        if report.picture is not None:
            report.picture.draw(path)


def landmark_file(scan: Path, given: Path | None) -> Path | None:
    """The landmarks given, or those that lie beside a scan's file.

    :raises InputError: a link beside it leads outside the roots
    """
    if given is not None or Path(scan).is_dir():
        return None if given is None else Path(given)
    return file_beside(Path(scan), f"{Path(scan).stem}.landmarks.json")


@dataclass(frozen=True, kw_only=True)
class ScanInput:
    """A scan and its landmarks."""

    scan: Scan
    landmarks: ScanLandmarks
    warnings: tuple[str, ...]
    photos: Mapping[str, Any] = field(default_factory=dict)  # what `facepipe scan` reports of them


def scan_input(source: Path, landmarks: Path | None, watch: Watch) -> ScanInput:
    """The scan in a file, or that of the photos in a folder.

    :param landmarks: their file; None: they come from the photos, or are found on the scan
    :raises FacepipeError: files that can't be used, photos that give no scan, or no landmarks found
    """
    from facepipe.importers.scan_file import read_scan
    from facepipe.scanning.photos import ScanPhotos, bars

    if not source.is_dir():
        scan = read_scan(source)
        found, warnings = landmarks_of(landmarks, scan)
        return ScanInput(scan=scan, landmarks=found, warnings=warnings)
    with named(source), bars(watch) as step:
        made = ScanPhotos()(source, step)
    return input_of_photos(made, landmarks)


def input_of_photos(made: PhotoScan, landmarks: Path | None) -> ScanInput:
    """The scan that photos gave, and what is known of it.

    :param landmarks: their file; None: they come from the photos, or are found on the scan
    :raises FacepipeError: a file that can't be used, or no landmarks found
    """
    found, warnings = landmarks_of(landmarks, made.scan, made.landmarks)
    report = made.report.to_dict()
    return ScanInput(scan=made.scan, landmarks=found, warnings=(*made.report.warnings, *warnings), photos=report)


def landmarks_of(
    file: Path | None, scan: Scan, known: ScanLandmarks | None = None
) -> tuple[ScanLandmarks, tuple[str, ...]]:
    """Landmarks from a file, else the known ones, else those that are found on the scan; and warnings.

    :raises FacepipeError: a file that can't be used, or no landmarks found
    """
    from facepipe.importers.scan_landmarks import read_scan_landmarks

    if file is not None:
        return read_scan_landmarks(file), ()
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
