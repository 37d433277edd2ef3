"""Ways of points that are no straight lines: a jaw turns about its hinge, a lid slides over the eyeball."""

from __future__ import annotations

import numpy as np
from model import Floats


def about_axis(points: Floats, offsets: Floats, centre: Floats, share: float) -> Floats:
    """(n, 3) offsets of points that went `share` of their way, on arcs about an axis along x through `centre`."""
    start, end = (points - centre)[:, 1:], (points + offsets - centre)[:, 1:]
    radius = [np.linalg.norm(one, axis=1) for one in (start, end)]
    angle = np.arctan2(start[:, 1], start[:, 0])
    turn = np.arctan2(end[:, 1], end[:, 0]) - angle
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    middle = (1 - share) * radius[0] + share * radius[1]
    at = angle + share * turn
    moved = np.stack([middle * np.cos(at), middle * np.sin(at)], axis=1) - start
    return np.column_stack([share * offsets[:, 0], moved])


def about_point(points: Floats, offsets: Floats, centre: Floats, share: float) -> Floats:
    """(n, 3) offsets of points that went `share` of their way, on arcs around `centre`."""
    start, end = points - centre, points + offsets - centre
    length = [np.linalg.norm(one, axis=1, keepdims=True) for one in (start, end)]
    a, b = start / length[0], end / length[1]
    angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))[:, None]
    sine = np.maximum(np.sin(angle), 1e-9)
    turned = (np.sin((1 - share) * angle) * a + np.sin(share * angle) * b) / sine
    turned = np.where(angle < 1e-6, (1 - share) * a + share * b, turned)
    return np.asarray(((1 - share) * length[0] + share * length[1]) * turned - start)
