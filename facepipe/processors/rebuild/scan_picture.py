"""The picture of a face on its scan."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from facepipe.core.arrays import FloatArray
from facepipe.geometry.similarity import Similarity
from facepipe.processors.rebuild.template import Template
from facepipe.scans import Scan


@dataclass(frozen=True, kw_only=True)
class FaceOnScan:
    """A face as a scan shows it, and the scan."""

    template: Template
    points: FloatArray  # (n, 3) whole points
    scan: Scan
    place: Similarity  # from the scan's coordinates to those of the points
    neutral: FloatArray | None = None  # (n, 3) the points without what the scan shows besides, where that is something

    def draw(self, path: Path) -> None:
        """Scan, face and their distance."""
        from facepipe.pictures import save_png
        from facepipe.pictures.fit_sheet import FitPicture, fit_sheet
        from facepipe.processors.database.whole_faces import whole_parts
        from facepipe.processors.rebuild.scan_distances import in_place, scan_distances

        template = self.template
        shown = FitPicture(
            parts=whole_parts(template.parts, self.points),
            landmarks=self.points[template.rows[template.landmarks]],
            scan=in_place(self.scan, self.place),
            distances=scan_distances(template, self.points, self.scan, self.place),
            neutral=None if self.neutral is None else whole_parts(template.parts, self.neutral),
        )
        save_png(fit_sheet(shown), path)
