"""The picture of a face on its scan."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from facepipe.geometry.similarity import Similarity
    from facepipe.parts import FloatArray
    from facepipe.processors.rebuild import Template
    from facepipe.scans import Scan


def draw_fit(
    path: Path,
    template: Template,
    points: FloatArray,
    scan: Scan,
    place: Similarity,
    neutral: FloatArray | None = None,
) -> None:
    """Scan, face and their distance, drawn to `path`.

    :param points: (n, 3) whole points as the scan shows them
    :param place: from the scan's coordinates to those
    :param neutral: (n, 3) those without what the scan shows besides, where that is something
    """
    from facepipe.pictures import save_png
    from facepipe.pictures.fit_sheet import FitPicture, fit_sheet
    from facepipe.processors.database.whole_faces import whole_parts
    from facepipe.processors.rebuild.scan_distances import in_place, scan_distances

    shown = FitPicture(
        parts=whole_parts(template.parts, points),
        landmarks=points[template.rows[template.landmarks]],
        scan=in_place(scan, place),
        distances=scan_distances(template, points, scan, place),
        neutral=None if neutral is None else whole_parts(template.parts, neutral),
    )
    save_png(fit_sheet(shown), path)
