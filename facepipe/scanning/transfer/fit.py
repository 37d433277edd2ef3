"""The template on a head: identity modes, a smooth residual, and the rims of the head's own eyes and mouth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.registration import Stage, View, register_together
from facepipe.geometry.similarity import Similarity
from facepipe.geometry.smooth_modes import smooth_modes
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
# What no people have in common is smooth too. Left to a membrane, which resists stretching as much as bending, lids and
# lips of a head that is 5 mm from all people slid by 0.4 to 0.7 mm, and 52 shapes were off by 0.13 and 0.17 mm on 14k
# and 3k triangles instead of 0.08 and 0.13. Of 30 mm and 60 places it follows lids no better, for 1.5 times as long.
_SMOOTH_MM, _SMOOTH_DEVIATION_MM, _SMOOTH_PLACES = 40.0, 3.0, 40
# Where a head's neck ends, points find places at one step and its border at the next, and swing by 6 mm for ever. Of 12
# and 18 steps shapes were off by 0.295 and 0.135 mm on two heads beyond people, of 7 after 10 by 0.285 and 0.134.
_FINE = (Stage(2.0, 2.0, 3, 0.5), Stage(1.0, 1.0, 4, 0.1))


@dataclass(frozen=True, kw_only=True)
class HeadFit:
    """The template on a head."""

    points: FloatArray  # (n, 3) whole points of the template, in its own place, millimetres
    place: Similarity  # from the head's coordinates to there
    head: HeadMesh  # there
    report: FitNeutralReport


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

    First, roughly, as a neutral onto a scan of the size that its landmarks have, since with a free size heads that are
    unlike people shrink, MakeHuman's to half; then with any smooth deformation, and with the rims of lids and lips held
    where the head has its own.

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
    neutral, place, report = fit_neutral(template, scan, landmarks, database, options, progress, roughly=True)
    triangles = np.asarray(triangles, np.int64)
    head, rows = HeadMesh.of(place.apply(scan.points), triangles), neutral.points[template.rows]
    labels, sides = sides_on(template, rows, head, nearest_places(rows, template.triangles, head), REACH_MM)
    rims = rim_anchors(template, rows, head, labels, sides)

    own, (target, mended) = landmark_anchors(template, landmarks), scan_target(scan)
    anchors = own.with_more(replace(rims, targets=place.undo(rims.targets)))
    people = identity_surface(template, database.identity, options)
    smooth = smooth_modes(people.base, _SMOOTH_MM, _SMOOTH_DEVIATION_MM, _SMOOTH_PLACES)
    surface = people.with_modes(smooth, options.prior)
    known = np.array(report.coefficients)
    found = register_together(
        surface,
        [View(scan=target, anchors=anchors, start=place, name=name)],
        np.append(known, np.zeros(len(smooth))),
        rows - people.points(known),
        replace(options.registration, scale=False),
        progress,
        _FINE,
    )[0]
    beyond = found.residual + np.tensordot(found.coefficients[len(known) :], smooth, axes=1)
    found = replace(found, coefficients=found.coefficients[: len(known)], residual=beyond)
    lines = (*scan.warnings, *mended)
    neutral, report = found_neutral(template, database.identity, name, found, anchors.names, lines, {})
    head = HeadMesh.of(found.place.apply(scan.points), triangles)
    return HeadFit(points=neutral.points, place=found.place, head=head, report=report)
