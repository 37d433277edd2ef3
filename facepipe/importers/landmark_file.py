"""Landmarks from a JSON file beside a mesh.

One scheme: a list of points, an object ``{"name": point}``, or ``{"scheme": "multipie68", "indices": [...],
"names": [...]}``; a scheme without name is multipie68. Several: an object of schemes, each a list or an object.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from facepipe.core.errors import InputError
from facepipe.core.reading import read_json
from facepipe.parts import Landmarks

_DEFAULT = "multipie68"
_MOST_BYTES = 1 << 24


def read_landmarks(path: Path, point_count: int) -> dict[str, Landmarks]:
    """Scheme -> landmarks.

    :raises InputError: not such JSON, or a point out of range
    """
    content = read_json(path, _MOST_BYTES)
    if isinstance(content, Mapping) and "indices" in content:
        names, points = content.get("names"), content["indices"]
        content = {str(content.get("scheme", _DEFAULT)): _paired(path, names, points) if names else points}
    elif not isinstance(content, Mapping) or not any(isinstance(value, list | Mapping) for value in content.values()):
        content = {_DEFAULT: content}
    return {
        scheme: _landmarks(f"{path} -> {ascii(scheme)[:40]}", scheme, content[scheme], point_count)
        for scheme in content
    }


def _paired(path: Path, names: object, points: object) -> dict[str, object]:
    if isinstance(names, list) and isinstance(points, list) and all(isinstance(name, str) for name in names):
        paired = dict(zip(names, points, strict=False))
        if len(paired) == len(names) == len(points):
            return paired
    raise InputError(path, "expected as many different names as indices")


def _landmarks(where: str, scheme: str, value: object, point_count: int) -> Landmarks:
    if not (scheme.isascii() and scheme.isidentifier()):
        raise InputError(where, "expected a scheme name of letters, digits and underscores")
    names = tuple(value) if isinstance(value, Mapping) else ()
    points = list(value.values()) if isinstance(value, Mapping) else value
    if not isinstance(points, list) or not points:
        raise InputError(where, "expected a list of points, or an object of name and point")
    for point in points:
        if isinstance(point, bool) or not isinstance(point, int) or not 0 <= point < point_count:
            raise InputError(where, f"point {str(point)[:40]}, expected a whole number from 0 to {point_count - 1}")
    return Landmarks(indices=np.array(points, dtype=np.int32), names=names)
