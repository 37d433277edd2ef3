"""Find the 68 landmarks of a scanned face; OUT is the JSON file that rebuilding takes, to be mended by hand.

SCAN is a mesh or point cloud in any pose and unit, with colours or without: .ply .obj .stl .off .glb .gltf or USD.
facepipe's own network searches pictures of it from all around; landmarks are in the coordinates of SCAN, null
where views disagree. It needs `pip install 'facepipe[train]'`. Exit code 1: done, but some landmarks are null.

example: facepipe scan-landmarks neutral.ply -o neutral.landmarks.json --picture neutral.png
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.declare import beside, source
from facepipe.kinds import FileAction, Job, action

if TYPE_CHECKING:
    from facepipe.scanning.landmarks.find import ScanLandmarksReport

_SIZE = 640  # pixels a side of each picture of the sheet
_TURNS = (0.0, 0.7, -0.7)  # radians


@action("scan-landmarks", "find the landmarks of a scanned face")
@dataclass(frozen=True, kw_only=True)
class ScanLandmarks(FileAction["ScanLandmarksReport"]):
    """The action."""

    output = "landmark file to write: .json"
    suffixes = (".json",)

    scan: Path = source("mesh or point cloud")
    picture: Path | None = beside("draw the scan with its landmarks, from three sides", ".png", "draw")

    def write(self, job: Job) -> ScanLandmarksReport:
        from facepipe.importers.scan_file import read_scan
        from facepipe.importers.scan_landmarks import write_scan_landmarks
        from facepipe.pictures.surface_view import draw_surface
        from facepipe.scanning.landmarks.find import FindScanLandmarks

        with job.watch("scan-landmarks", 2) as bar:
            scan = read_scan(self.scan)
            bar.update()
            result = FindScanLandmarks(draw=draw_surface)(scan)
            bar.update()
        write_scan_landmarks(result.landmarks, job.out)
        return replace(result.report, landmarks=result, warnings=(*scan.warnings, *result.report.warnings))

    def draw(self, report: ScanLandmarksReport, path: Path) -> None:
        """The picture of the landmarks."""
        from facepipe.pictures import save_png
        from facepipe.pictures.surface_view import scan_sheet

        found = report.landmarks
        views = [found.frame.view(yaw, 0.0, _SIZE, 1.4) for yaw in _TURNS]
        save_png(scan_sheet(found.look, views, found.landmarks.points), path)

    def missed(self, report: ScanLandmarksReport) -> bool:
        return report.found < len(report.landmarks.landmarks.points)

    def text(self, report: ScanLandmarksReport, out: Path) -> str:
        text = f"{out}: {report.found} landmarks, presence {report.presence:.3f}"
        return f"{text}, spread {report.spread:.1%} of the eyes' distance"
