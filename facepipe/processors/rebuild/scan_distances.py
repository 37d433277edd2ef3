"""How far each point of a fitted face is from its scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.polygons import point_normals
from facepipe.geometry.registration import RegistrationOptions, ScanTarget
from facepipe.geometry.similarity import Similarity
from facepipe.processors.rebuild.scan_fit import scan_target
from facepipe.processors.rebuild.template import Template
from facepipe.scans import Scan


def in_place(scan: Scan, place: Similarity) -> Scan:
    """The scan, mended and with normals, where a fit has found it to be.

    :raises InputError: a scan that can't be used
    """
    found = scan_target(scan)[0].moved(place)
    return replace(scan, points=found.points, triangles=found.triangles, normals=found.normals, colors=None)


def scan_distances(
    template: Template, points: FloatArray, scan: Scan, place: Similarity, reach_mm: float | None = None
) -> FloatArray:
    """(n,) millimetres from whole points (n, 3) to the scan, NaN where it doesn't show them.

    A point is shown where it can be seen from outside and the nearest place of the scan is within reach, faces the same
    way and is not on the scan's border.

    :param place: from the scan's coordinates to those of the points
    :param reach_mm: that of a registration by default
    :raises InputError: a scan that can't be used
    """
    reach = RegistrationOptions().reach_mm if reach_mm is None else reach_mm
    by_row = row_distances(template, points[template.rows], scan_target(scan)[0], place, reach)
    return np.where(template.row_of >= 0, by_row[template.row_of], np.nan)


def row_distances(
    template: Template, rows: FloatArray, target: ScanTarget, place: Similarity, reach_mm: float
) -> FloatArray:
    """(m,) the same of the skin's rows (m, 3), from a scan made ready."""
    seen = template.seen
    normals = point_normals(rows, template.triangles)[seen]
    matches = target.matches(rows[seen], normals, reach_mm, RegistrationOptions().angle, place)
    found = np.full(len(rows), np.nan)
    found[seen[matches.kept]] = matches.distances[matches.kept]
    return found
