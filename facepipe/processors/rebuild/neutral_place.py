"""Where the scan of a known neutral lies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import FitError, InputError
from facepipe.geometry.registration import Anchors, DeformableSurface, RegistrationOptions, register
from facepipe.geometry.similarity import Similarity, robust_similarity
from facepipe.processors.rebuild.register_scans import NeutralScan
from facepipe.processors.rebuild.scan_fit import scan_target
from facepipe.processors.rebuild.template import Template
from facepipe.scans import Scan, ScanLandmarks

_FEWEST_LANDMARKS = 6
_RIGID = 1e6  # of the residual's precision: nothing bends
_LANDMARKS_MM = 5.0  # landmarks only begin: the surface places the scan far better than hands do


def placed_neutral(
    template: Template,
    points: FloatArray,
    scan: Scan,
    landmarks: ScanLandmarks,
    expression: FloatArray | None = None,
) -> NeutralScan:
    """A neutral with the place and size of its scan, see `neutral_place`.

    :param expression: (n, 3) whole delta that the scan shows besides, such as closed eyes
    """
    neutral = NeutralScan(points=points, landmarks=landmarks, expression=expression)
    return replace(neutral, place=neutral_place(template, neutral.shown, scan, landmarks))


def neutral_place(
    template: Template, points: FloatArray, scan: Scan, landmarks: ScanLandmarks, seen: IntArray | None = None
) -> Similarity:
    """From a scan to its neutral, found by landmarks, then by the surface; the neutral stays.

    :param points: (n, 3) whole points, as the scan shows them
    :param seen: rows of the skin to place it by, ascending; None: all that a scan can show
    :raises InputError: too few landmarks, or a scan that can't be used
    :raises FitError: a scan that does not show this face
    """
    known = landmarks.known
    if known.sum() < _FEWEST_LANDMARKS:
        what = f"{int(known.sum())} of 68 are known, expected {_FEWEST_LANDMARKS} or more"
        raise InputError(f"{scan.name} -> landmarks", what)
    surface = neutral_surface(template, points, held=_RIGID)
    surface = surface if seen is None else replace(surface, seen=seen)
    start = robust_similarity(landmarks.points[known], surface.base[template.landmarks][known])
    anchors = Anchors.at_points(template.landmarks, landmarks.points)
    options = RegistrationOptions(anchor_sigma_mm=_LANDMARKS_MM)
    target, _ = scan_target(scan)
    try:
        return register(surface, target, anchors, start, options).place
    except FitError as error:
        raise error.under(scan.name) from None


def neutral_surface(template: Template, points: FloatArray, held: float = 0.0) -> DeformableSurface:
    """The skin of a known neutral, with no modes.

    :param points: (n, 3) whole points
    :param held: how much a residual is drawn to 0, per mm^2
    """
    count = len(template.rows)
    return DeformableSurface(
        base=points[template.rows],
        modes=np.zeros((0, count, 3)),
        expected=np.zeros(0),
        precision=np.zeros(0),
        triangles=template.triangles,
        seen=template.seen,
        held=np.full(count, held),
        labels=template.labels,
    )
