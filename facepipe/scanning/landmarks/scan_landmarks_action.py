"""Find the 68 landmarks of a face on any mesh; OUT is the JSON file that rebuilding takes, to be mended by hand.

SCAN is a head, a whole body or a point cloud, in any pose and unit, with colours or without: .ply .obj .stl .off .glb
.gltf .vrm .fbx or USD. facepipe's own network searches pictures of it, in colours and in clay: of what the head's joint
carries, of the top of a body, of connected pieces, from all around. Landmarks are in the coordinates of SCAN, null
where views disagree. Exit code 1: done, but some landmarks are null.

examples:
  facepipe scan-landmarks neutral.ply -o neutral.landmarks.json --picture neutral.png
  facepipe scan-landmarks crowd.glb --component Anna -o anna.landmarks.json
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.declare import beside, option, source
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
    component: str | None = option(None, "look at one mesh, object or group of the file alone, by its name")
    picture: Path | None = beside("draw the scan with its landmarks, from three sides", ".png", "draw")

    def write(self, job: Job) -> ScanLandmarksReport:
        from facepipe.importers.scan_file import read_scan
        from facepipe.importers.scan_landmarks import write_scan_landmarks
        from facepipe.pictures.surface_view import draw_surface
        from facepipe.scanning.landmarks.find import FindScanLandmarks

        with job.watch("scan-landmarks", 2) as bar:
            scan = read_scan(self.scan)
            bar.update()
            result = FindScanLandmarks(draw=draw_surface, component=self.component)(scan)
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
        from facepipe.scanning.rebuild.scan_fit import unit_of

        text = f"{out}: {report.found} landmarks, presence {report.presence:.3f}"
        text = f"{text}, spread {report.spread:.1%} of the eyes' distance"
        text = f"{text}\nfound in {report.seen}, on {report.place}, after {report.searched} pictures"
        if report.unit_known:
            return text
        usual = unit_of(report.mm_per_unit)
        named = "" if usual is None else f", about {usual}"
        return f"{text}\nthe file has no unit: by the size of the face one of {report.mm_per_unit:.3g} mm{named}"
