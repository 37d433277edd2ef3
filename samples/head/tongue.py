"""tongueOut, which ICT-FaceKit lacks: the jaw opens a little, and the tongue comes out over the lower lip."""

from __future__ import annotations

import numpy as np
from anatomy import Jaw, Tongue, smooth
from arcs import about_axis
from model import Floats, Model
from scipy.interpolate import CubicSpline

OPEN = 0.37  # of jawOpen, with which the tongue has room
HALFWAY = 0.5
# The middle line of the tongue that is out, root to tip: z and y in cm where jawOpen is at OPEN.
LINE = np.array([(3.4, -4.3), (5.6, -3.95), (7.6, -4.05), (9.6, -4.2), (11.3, -4.38), (12.5, -5.0), (13.2, -5.95)])
THIN, NARROW = 0.66, 0.95  # at the tip, of its thickness and width at rest
ROOT = (0.05, 0.5)  # along the tongue: before it stays, after it follows the line
OUT = {HALFWAY: (0.6, 0.3), 1.0: (1.0, 1.0)}  # weight -> shares of the jaw's and of the tongue's way: the jaw is first


def tongue_out(model: Model, jaw: Jaw, tongue: Tongue) -> dict[float, Floats]:
    """Weight -> (n, 3) offsets."""
    found = {}
    for weight, (opened, out) in OUT.items():
        offsets = about_axis(model.points, model.shapes["jawOpen"], jaw.hinge, OPEN * opened)
        held = (smooth((tongue.along - ROOT[0]) / (ROOT[1] - ROOT[0])) * tongue.free * out)[:, None]
        there = _along_line(model.points[tongue.points], tongue.along) - model.points[tongue.points]
        offsets[tongue.points] = (1.0 - held) * offsets[tongue.points] + held * there
        found[weight] = offsets
    return found


def _along_line(points: Floats, along: Floats) -> Floats:
    """Points of the tongue swept along the line."""
    middle = np.polyval(np.polyfit(points[:, 2], points[:, 1], 2), points[:, 2])
    knots = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(LINE, axis=0), axis=1)))
    line = CubicSpline(knots / knots[-1], LINE)
    place, way = line(along), line(along, 1)
    up = np.stack([-way[:, 1], way[:, 0]], axis=1) / np.linalg.norm(way, axis=1, keepdims=True)
    flat = smooth(along)
    height = (points[:, 1] - middle) * (1.0 - (1.0 - THIN) * flat)
    moved = place + height[:, None] * up
    return np.column_stack([points[:, 0] * (1.0 - (1.0 - NARROW) * flat), moved[:, 1], moved[:, 0]])
