"""Scans and their landmarks as the actions of a rebuild take them."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from facepipe.core.errors import FacepipeError
from facepipe.kinds import StageAction

if TYPE_CHECKING:
    from facepipe.processors.rebuild.action_reports import Judged
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
    """The landmarks given, or those that lie beside the scan."""
    if given is not None:
        return Path(given)
    beside = Path(scan).with_name(f"{Path(scan).stem}.landmarks.json")
    return beside if beside.exists() else None


def landmarks_of(file: Path | None, scan: Scan) -> tuple[ScanLandmarks, tuple[str, ...]]:
    """Landmarks from a file, or found on the scan, and warnings.

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
