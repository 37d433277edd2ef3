"""What `facepipe fit-neutral` takes, on disk."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from facepipe.importers.scan_landmarks import write_scan_landmarks
from facepipe.importers.scan_ply import write_ply
from facepipe.scans import Scan, ScanLandmarks

PERSON = 9  # none of the database's


@dataclass(frozen=True)
class Files:
    """What a fit takes."""

    folder: Path

    def __getitem__(self, name: str) -> Path:
        return self.folder / name

    def words(self, *more: object, scan: str = "scan.ply") -> tuple[object, ...]:
        """A command line."""
        files = ("--template", self["head.usda"], "--database", self["faces.fpdb"], "-o", self["out.usda"])
        return ("fit-neutral", self[scan], *files, *more)

    def put(self, scan: Scan, landmarks: ScanLandmarks, name: str = "scan.ply") -> None:
        """A scan with its landmarks beside it."""
        write_ply(scan, self[name])
        write_scan_landmarks(landmarks, self[name].with_suffix(".landmarks.json"))
