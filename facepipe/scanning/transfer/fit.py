"""The template on a head: identity modes, a smooth residual, and the rims of the head's own eyes and mouth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.registration import View, register_together
from facepipe.geometry.similarity import Similarity
from facepipe.scanning.database import FaceDatabase
from facepipe.scanning.rebuild.declared import FitNeutralOptions
from facepipe.scanning.rebuild.fit_neutral import (
    FitNeutralReport,
    fit_neutral,
    found_neutral,
    identity_surface,
    landmark_anchors,
)
from facepipe.scanning.rebuild.scan_fit import scan_target
from facepipe.scanning.rebuild.template import Template
from facepipe.scanning.transfer.mesh import HeadMesh
from facepipe.scanning.transfer.places import REACH_MM, nearest_places
from facepipe.scanning.transfer.rims import rim_anchors
from facepipe.scanning.transfer.sides import sides_on
from facepipe.scans import Scan, ScanLandmarks

_USUAL = FitNeutralOptions()
# Matches of neighbouring points are no independent measurements, so that a surface counts for more than it knows: heads
# that no mode shows slide along it by 4 mm under landmarks that are 2 mm off and say so. Held by this share of their
# sigma, shapes of such a head are off by 0.30 instead of 0.44 mm, those of one inside the model by 0.08, not 0.07.
_HELD = 0.35
_ROUNDS = 2  # lids that lie 4 mm off are outliers in the first, and near enough in the second


@dataclass(frozen=True, kw_only=True)
class HeadFit:
    """The template on a head."""

    points: FloatArray  # (n, 3) whole points of the template, in its own place, millimetres
    place: Similarity  # from the head's coordinates to there
    head: HeadMesh  # there
    report: FitNeutralReport
    open_slits: tuple[str, ...] = ()  # of mouth, eye_right and eye_left: those with something between their rims


def fit_head(
    template: Template,
    database: FaceDatabase,
    points: FloatArray,
    triangles: IntArray,
    landmarks: ScanLandmarks,
    options: FitNeutralOptions = _USUAL,
    name: str = "head",
    progress: Callable[[int], None] = lambda step: None,
) -> HeadFit:
    """Lay the template onto the head.

    First as a neutral onto a scan; then once more with the rims of lids and lips held where the head has its own.

    :param database: who people may be, on the template's topology: `built_in_head.people` for the head in the box
    :param points: (m, 3) of the head, in any unit and place
    :param triangles: (t, 3) of them
    :param landmarks: in the head's coordinates
    :param name: of the head in errors and warnings
    :raises InputError: no triangles, too few landmarks or a mirrored head
    :raises FitError: a head that does not show a face
    """
    scan = Scan(name=name, points=np.asarray(points, np.float64), triangles=np.asarray(triangles, np.int32))
    landmarks = replace(landmarks, sigma_mm=_HELD * landmarks.sigma_mm)
    neutral, place, report = fit_neutral(template, scan, landmarks, database, options, progress)
    own, (target, mended) = landmark_anchors(template, landmarks), scan_target(scan)
    lines, surface = (*scan.warnings, *mended), identity_surface(template, database.identity, options)
    # With its size as found: what rims add says nothing of it.
    solver = replace(options.registration, scale=False)
    triangles = np.asarray(triangles, np.int64)
    open_slits: tuple[str, ...] = ()
    for _ in range(_ROUNDS):
        head, rows = HeadMesh.of(place.apply(scan.points), triangles), neutral.points[template.rows]
        labels, sides = sides_on(template, rows, head, nearest_places(rows, template.triangles, head), REACH_MM)
        rims, open_slits = rim_anchors(template, rows, head, labels, sides)
        if not len(rims):
            break
        anchors = own.with_more(replace(rims, targets=place.undo(rims.targets)))
        view = View(scan=target, anchors=anchors, start=place, name=name)
        coefficients = np.array(report.coefficients)
        residual = rows - surface.points(coefficients)
        found = register_together(surface, [view], coefficients, residual, solver, progress)[0]
        neutral, report = found_neutral(template, database.identity, name, found, anchors.names, lines, {})
        place = found.place
    head = HeadMesh.of(place.apply(scan.points), triangles)
    return HeadFit(points=neutral.points, place=place, head=head, report=report, open_slits=open_slits)
