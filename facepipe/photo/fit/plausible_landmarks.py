"""What can't be the 68 landmarks of a face."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.landmarks import downward, turned_view
from facepipe.heads.asset import asset

_SMALLEST_FACE = 16.0  # pixels of the longer side of the landmarks' box
_LARGEST_NUMBER = 1e6
# Random heads seen from all sides up to full profile, close by too: at most 0.39 of the spread is within the parts,
# of shuffled landmarks 0.83 at least; the spread across the longest direction is at least 0.41 of that along it.
_WITHIN_PARTS = 0.55
_ACROSS = 0.15
_MIRRORED = -0.1  # 1 from the front, 0 in profile, -1 for a mirrored face
_PARTS = ((0, 5), (5, 12), (12, 17), (17, 22), (22, 27), (27, 31), (31, 36), (36, 42), (42, 48), (48, 68))
_RIGHT = [*range(8), *range(17, 22), *range(36, 42)]  # of the person
_LEFT = [*range(9, 17), *range(22, 27), *range(42, 48)]
_INNER = {
    "right brow": slice(17, 22),
    "left brow": slice(22, 27),
    "nose": slice(27, 36),
    "right eye": slice(36, 42),
    "left eye": slice(42, 48),
    "mouth": slice(48, 68),
}
# Of the spread of all landmarks. Heads beyond the usual ones with several strong expressions, from all sides up to 80
# degrees: parts are at most 0.49 away (open mouths), all together 0.32.
_AWAY = 0.55
_SCATTER = 0.45
_OUTLIER = 0.15  # beyond which a landmark counts little for where the others are
_ROUNDS = 5


def check_face(points: FloatArray, where: str) -> None:
    """Check landmarks (68, 2) in pixels, however the face is turned.

    :param where: the trail, for messages
    :raises InputError: nothing like the 68 of Multi-PIE
    """
    if not (np.abs(points) <= _LARGEST_NUMBER).all():  # NaN too
        raise InputError(where, f"NaN, infinity or beyond {_LARGEST_NUMBER:g} pixels, expected places in a photo")
    extent = float(np.ptp(points, axis=0).max())
    if extent < _SMALLEST_FACE:
        what = f"the landmarks span {extent:.3g} pixels, expected at least {_SMALLEST_FACE:g}"
        raise InputError(where, f'{what} (places in 0..1 need "units": "normalized")')
    centred = points - points.mean(axis=0)
    along, across = np.linalg.svd(centred, compute_uv=False)
    if across < _ACROSS * along:
        raise InputError(where, "the landmarks lie on one line, expected those of a face")
    within = sum(((points[a:b] - points[a:b].mean(axis=0)) ** 2).sum() for a, b in _PARTS)
    if within > _WITHIN_PARTS**2 * (centred**2).sum():
        raise InputError(
            where, "jaw, brows, nose, eyes and lips are mixed, expected the 68 of Multi-PIE in their order"
        )
    if _handedness(points) < _MIRRORED:
        what = "the landmarks are mirrored, expected the person's right side first, x right and y down"
        raise InputError(where, f"{what} from the top left corner")
    _check_parts(points, where)


def _check_parts(points: FloatArray, where: str) -> None:
    """Against the average head, turned and scaled robustly."""
    spread = float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))
    trust = np.ones(len(points))
    scattered = float(np.sqrt((_off_average(points, trust) ** 2).sum(axis=1).mean())) / spread
    for _ in range(_ROUNDS):
        off = _off_average(points, trust) / spread
        trust = 1 / (1 + (off**2).sum(axis=1) / _OUTLIER**2)
    for name, part in _INNER.items():
        away = float(np.linalg.norm(off[part].mean(axis=0)))
        if away > _AWAY:
            what = f"the landmarks of the {name} are {away:.2g} of the face's spread away from where a face has them"
            raise InputError(where, f"{what}, expected at most {_AWAY:g}")
    if scattered > _SCATTER:
        what = f"the landmarks are {scattered:.2g} of the face's spread away from any turned head's"
        raise InputError(where, f"{what}, expected at most {_SCATTER:g}")


def _off_average(points: FloatArray, weights: FloatArray) -> FloatArray:
    """(68, 2) how far landmarks are from those of the average head, turned, scaled and moved next to them."""
    places = asset().points[asset().landmarks]
    middle, seen = (np.average(one, axis=0, weights=weights) for one in (places, points))
    return np.asarray(points - seen - (places - middle) @ turned_view(places, points, weights).T)


def _handedness(points: FloatArray) -> float:
    """1 for a face from the front however it is turned in the picture, 0 in profile, -1 when mirrored."""
    right = points[_LEFT].mean(axis=0) - points[_RIGHT].mean(axis=0)
    down = downward(points)
    return float((right[0] * down[1] - right[1] * down[0]) / max(down @ down, 1e-300))
