"""Make a scan of photos: a coloured mesh of a face from 5 or more photos around it, taken at one moment.

Needs `pip install 'facepipe[scan]'`. Where the cameras stood and what lenses they have is found from the photos, in an
unknown unit; --cameras gives what a calibrated rig knows (the photos' names, intrinsics and extrinsics), and the scan
then has its unit and coordinates. --save-cameras writes them, for the other expressions of a rig that did not move.
Neighbouring photos should show much the same, some 15 degrees apart; sharp, in even light that moves with nobody.
--masks, white where the person is, help where the backdrop has a pattern of its own.

Landmarks go into OUT's name with .landmarks.json: markers painted on the actor, whose pixels in two or more photos
--markers gives ({"photos": {"front.jpg": {"chin": [2011, 3020], ...}, ...}}), and those of the 68 landmarks that lie
inside the face, where the extra [train] is installed. --marker-distance A B MM, the straight distance between two
markers, gives the scan its scale. Rebuild finds the scale of a scan that has none.

examples:
  facepipe scan neutral/ -o neutral.ply
  facepipe scan neutral/ --markers markers.json --marker-distance chin brow 118.5 -o neutral.ply --save-cameras rig.json
  facepipe scan smile/ --cameras rig.json -o smile.ply
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError
from facepipe.core.reports import table
from facepipe.declare import beside, option, source
from facepipe.kinds import FileAction, Job, action
from facepipe.scanning.photos.options import ScanPhotosOptions

if TYPE_CHECKING:
    from facepipe.scanning.photos.scan import ScanPhotosReport


@action("scan", "make a scan of photos around a face")
@dataclass(frozen=True, kw_only=True)
class MakeScan(ScanPhotosOptions, FileAction["ScanPhotosReport"]):
    """The action."""

    output = "scan to write: .ply"
    suffixes = (".ply",)

    photos: Path = source("folder of 5 or more photos of one expression")
    cameras: Path | None = source(
        "where the cameras stand and what they see", default=None, flag="--cameras", metavar="JSON"
    )
    masks: Path | None = source(
        "a PNG for each photo, white where the person is", default=None, flag="--masks", metavar="FOLDER"
    )
    markers: Path | None = source("pixels of markers in the photos", default=None, flag="--markers", metavar="JSON")
    marker_distance: tuple[str, ...] | None = option(
        None, "two markers and the straight distance between them, millimetres", words=3, metavar="A B MM"
    )
    save_cameras: Path | None = beside("write the cameras that were used", ".json", "save")

    @classmethod
    def with_it(cls, out: Path) -> tuple[Path, ...]:
        return (out.with_name(f"{out.stem}.landmarks.json"),)

    def write(self, job: Job) -> ScanPhotosReport:
        from facepipe.core.atomic import discard_stale
        from facepipe.importers.scan_landmarks import write_scan_landmarks
        from facepipe.importers.scan_ply import write_ply
        from facepipe.scanning.photos.cameras import read_cameras, read_markers
        from facepipe.scanning.photos.scan import ScanPhotos, bars

        cameras = None if self.cameras is None else read_cameras(self.cameras)
        markers = {} if self.markers is None else read_markers(self.markers)
        distance = None
        if self.marker_distance is not None:
            try:
                first, second, text = self.marker_distance
                distance = first, second, float(text)
            except ValueError:
                said = " ".join(map(str, self.marker_distance))[:80]
                raise InputError(f"--marker-distance {said}", "expected two markers and millimetres") from None
        scanner = ScanPhotos(options=self, cameras=cameras, markers=markers, marker_distance=distance, masks=self.masks)
        (landmark_file,) = self.with_it(job.out)
        with bars(job.watch) as step:
            made = scanner(self.photos, step)
        write_ply(made.scan, job.out)
        if made.landmarks.known.any() or made.landmarks.markers:
            write_scan_landmarks(made.landmarks, landmark_file)
        else:
            discard_stale(landmark_file)
        return replace(made.report, used=made.cameras)

    def save(self, report: ScanPhotosReport, path: Path) -> None:
        """The cameras."""
        from facepipe.scanning.photos.cameras import write_cameras

        write_cameras(path, report.used)

    def text(self, report: ScanPhotosReport, out: Path) -> str:
        unit = report.unit or "(unknown unit)"
        rows = [
            ("photos", f"{len(report.photos_used)} of {len(report.photos_used) + len(report.photos_unused)} used"),
            ("cameras", f"{report.cameras}; matched points are {report.reprojection_px:.2f} pixels off"),
            ("dense points", f"{report.dense_points}, {report.spacing:.3g} {unit} apart"),
            ("agreement of photos", f"{report.consistency:.3g} {unit}, {report.consistency_px:.2f} pixels (median)"),
            ("scan", f"{report.points} points, {report.triangles} triangles"),
            ("landmarks", f"{report.landmarks} of 68, {report.markers} markers"),
        ]
        files = (out, *(self.with_it(out) if report.landmarks or report.markers else ()))
        return "\n".join([*map(str, files), table(rows)])
