"""Where the scan of a known neutral lies."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError
from facepipe.geometry.registration import Anchors, DeformableSurface, RegistrationOptions, register
from facepipe.geometry.robust_similarity import robust_similarity
from facepipe.processors.rebuild.register_scans import NeutralScan
from facepipe.processors.rebuild.scan_fit import scan_target
from facepipe.processors.rebuild.template import Template
from facepipe.scans import Scan, ScanLandmarks

FloatArray = npt.NDArray[np.floating]

_FEWEST_LANDMARKS = 6
_RIGID = 1e6  # of the residual's precision: nothing bends
_LANDMARKS_MM = 5.0  # landmarks only begin: the surface places the scan far better than hands do


def placed_neutral(template: Template, points: FloatArray, scan: Scan, landmarks: ScanLandmarks) -> NeutralScan:
    """A neutral with the place and size of its scan, found by landmarks, then by the surface; the neutral stays.

    :param points: (n, 3) whole points of the neutral, as fitted to the scan, or corrected since
    :raises InputError: too few landmarks, or a scan that can't be used
    :raises FitError: a scan that does not show this face
    """
    known = landmarks.known
    if known.sum() < _FEWEST_LANDMARKS:
        what = f"{int(known.sum())} of 68 are known, expected {_FEWEST_LANDMARKS} or more"
        raise InputError(f"{scan.name} -> landmarks", what)
    base = points[template.rows]
    surface = DeformableSurface(
        base=base,
        modes=np.zeros((0, len(base), 3)),
        expected=np.zeros(0),
        precision=np.zeros(0),
        triangles=template.triangles,
        seen=template.seen,
        held=np.full(len(base), _RIGID),
        labels=template.labels,
    )
    start = robust_similarity(landmarks.points[known], base[template.landmarks][known])
    anchors = Anchors.at_points(template.landmarks, landmarks.points)
    options = RegistrationOptions(anchor_sigma_mm=_LANDMARKS_MM)
    place = register(surface, scan_target(scan)[0], anchors, start, options).place
    return NeutralScan(points=points, place=place, landmarks=landmarks)
