"""Scans and their landmarks as stages of a rebuild take them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.errors import FacepipeError

if TYPE_CHECKING:
    from facepipe.scans import Scan, ScanLandmarks


def landmark_file(scan: Path, given: Path | None) -> Path | None:
    """The landmarks given, or those that lie beside the scan."""
    if given is not None:
        return Path(given)
    beside = scan.with_name(f"{scan.stem}.landmarks.json")
    return beside if beside.exists() else None


def landmarks_of(file: Path | None, scan: Scan) -> tuple[ScanLandmarks, tuple[str, ...]]:
    """Landmarks from a file, or found on the scan, and what there is to say of that.

    :raises FacepipeError: a file that can't be used, or no landmarks found
    """
    from facepipe.importers.scan_landmarks import read_scan_landmarks

    if file is not None:
        return read_scan_landmarks(file), ()
    from facepipe.pictures.surface_view import draw_surface
    from facepipe.processors.scan_landmarks import FindScanLandmarks

    found = FindScanLandmarks(draw=draw_surface)(scan)
    return found.landmarks, found.report.warnings


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Errors with the file that they are about."""
    try:
        yield
    except FacepipeError as error:
        raise error if str(path) in error.where else error.under(path) from None
