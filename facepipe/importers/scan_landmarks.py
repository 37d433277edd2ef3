"""Landmarks and painted markers of a scan, from and to JSON, in the scan's own coordinates.

``{"scheme": "multipie68", "points": [[x, y, z] | null, ... 68 of them], "markers": {"name": [x, y, z], ...}}``;
points, markers, or both. ``"sigma_mm"``, a number or 68 of them or null, says how far off points may be. In place of
points, ``"vertices": [int | null, ... 68]`` or ``{"30": int, ...}`` number points of the scan's file, from 0 in its
order, and of the mesh ``"mesh": "name"`` where it has several.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray, require_finite
from facepipe.core.atomic import write_bytes
from facepipe.core.errors import InputError
from facepipe.core.reading import read_json_object
from facepipe.importers.scan_file import LARGEST, read_scan
from facepipe.scans import LANDMARK_COUNT, LANDMARK_SCHEME, Scan, ScanLandmarks, no_landmarks, no_sigmas

_MOST_BYTES = 1 << 24
_KEYS = ("scheme", "points", "vertices", "mesh", "markers", "sigma_mm")
_NAMED = 6  # meshes in a message
_LEAST_SIGMA, _MOST_SIGMA = 1e-3, 1e3  # mm


def read_scan_landmarks(path: Path, scan: Scan | Path | None = None) -> ScanLandmarks:
    """The landmarks and markers in `path`.

    :param scan: what they lie on, or its file: ``vertices`` can't be read without
    :raises InputError: no such JSON, an unknown key or scheme, another number of points than 68, something else than
        three finite numbers or null, a sigma out of range, or neither a landmark nor a marker
    """
    content = read_json_object(Path(path), _MOST_BYTES)
    unknown = [key for key in content if key not in _KEYS]
    if unknown:
        raise InputError(path, f"key {ascii(unknown[0])[:40]}, expected {', '.join(_KEYS)}")
    scheme = content.get("scheme", LANDMARK_SCHEME)
    if scheme != LANDMARK_SCHEME:
        raise InputError(f"{path} -> scheme", f"{ascii(scheme)[:40]}, expected {LANDMARK_SCHEME}")
    points, where = no_landmarks(), f"{path} -> points"
    if (value := content.get("points")) is not None:
        if not isinstance(value, list):
            raise InputError(where, f"{ascii(value)[:40]}, expected a list of {LANDMARK_COUNT}")
        if len(value) != LANDMARK_COUNT:
            what = f"{len(value)} landmarks, expected {LANDMARK_COUNT} (null for those that are unknown)"
            raise InputError(where, what)
        rows = [[math.nan] * 3 if row is None else _place(f"{where} -> {i}", row) for i, row in enumerate(value)]
        points = np.array(rows, dtype=np.float64)
    if (value := content.get("vertices")) is not None:
        if content.get("points") is not None:
            raise InputError(path, "points and vertices, expected one of them")
        points = _at_vertices(path, value, content.get("mesh"), scan)
    sigmas, where = no_sigmas(), f"{path} -> sigma_mm"
    if isinstance(value := content.get("sigma_mm"), list):
        if len(value) != LANDMARK_COUNT:
            raise InputError(where, f"{len(value)} numbers, expected one, or {LANDMARK_COUNT}")
        sigmas = np.array([math.nan if one is None else _sigma(f"{where} -> {i}", one) for i, one in enumerate(value)])
    elif value is not None:
        sigmas = np.full(LANDMARK_COUNT, _sigma(where, value))
    markers, where = {}, f"{path} -> markers"
    if (value := content.get("markers")) is not None:
        if not isinstance(value, Mapping):
            raise InputError(where, f"{ascii(value)[:40]}, expected an object of name and place")
        if "" in value:
            raise InputError(where, "a marker without a name, expected a name for each")
        markers = {name: np.array(_place(f"{where} -> {ascii(name)[:40]}", row)) for name, row in value.items()}
    landmarks = ScanLandmarks(points=points, sigma_mm=sigmas, markers=markers)
    if not landmarks.known.any() and not landmarks.markers:
        raise InputError(path, "no landmark and no marker, expected at least one")
    return landmarks


def _at_vertices(path: Path, value: object, mesh: object, scan: Scan | Path | None) -> FloatArray:
    """(68, 3) the points of the scan's file that `value` numbers, NaN for landmarks that it does not."""
    where = f"{path} -> vertices"
    scan = read_scan(scan) if isinstance(scan, Path) else scan
    vertices = {} if scan is None else scan.hints.vertices
    if not vertices:
        raise InputError(where, "there are no vertices to number, expected a scan from a file")
    if mesh is None and len(vertices) == 1:
        mesh = next(iter(vertices))
    if not isinstance(mesh, str) or mesh not in vertices:
        named = ", ".join(ascii(name)[:40] for name in [*vertices][:_NAMED])
        raise InputError(f"{path} -> mesh", f"{ascii(mesh)[:40]}, expected the name of a mesh of the scan: {named}")
    of_file = vertices[mesh]
    if isinstance(value, list) and len(value) == LANDMARK_COUNT:
        rows = {str(number): one for number, one in enumerate(value) if one is not None}
    elif isinstance(value, Mapping):
        rows = dict(value)
    else:
        raise InputError(where, f"{ascii(value)[:40]}, expected a list of {LANDMARK_COUNT}, or an object by number")
    points = no_landmarks()
    for name, vertex in rows.items():
        if not (name.isdecimal() and len(name) < 3 and int(name) < LANDMARK_COUNT):
            raise InputError(where, f"landmark {ascii(name)[:40]}, expected a number from 0 to {LANDMARK_COUNT - 1}")
        if isinstance(vertex, bool) or not isinstance(vertex, int) or not 0 <= vertex < len(of_file):
            raise InputError(f"{where} -> {name}", f"{ascii(vertex)[:40]}, expected 0 to {len(of_file) - 1}")
        points[int(name)] = of_file[vertex]
    return points


def write_scan_landmarks(landmarks: ScanLandmarks, path: Path) -> None:
    """Write `landmarks` as `read_scan_landmarks` reads them: whole or not at all, the same bytes for the same ones.

    :raises InputError: a marker with NaN or infinity, or a file that can't be written
    """
    require_finite(landmarks.markers, str(path), "markers")
    known = landmarks.known
    points = [row if there else None for row, there in zip(landmarks.points.tolist(), known.tolist(), strict=True)]
    lines = ",\n".join(f"    {json.dumps(row)}" for row in points)
    parts = [f'  "scheme": {json.dumps(landmarks.scheme)}', f'  "points": [\n{lines}\n  ]']
    sigmas = [one if one == one else None for one in landmarks.sigma_mm.tolist()]
    if any(sigma is not None for sigma in sigmas):
        parts.append(f'  "sigma_mm": {json.dumps(sigmas)}')
    if landmarks.markers:
        rows = (f"    {json.dumps(name)}: {json.dumps(place.tolist())}" for name, place in landmarks.markers.items())
        parts.append('  "markers": {\n' + ",\n".join(rows) + "\n  }")
    write_bytes(path, ("{\n" + ",\n".join(parts) + "\n}\n").encode("ascii"))


def _sigma(where: str, value: object) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool) and _LEAST_SIGMA <= value <= _MOST_SIGMA:
        return float(value)
    raise InputError(where, f"{ascii(value)[:40]}, expected {_LEAST_SIGMA:g} to {_MOST_SIGMA:g} mm")


def _place(where: str, value: object) -> list[float]:
    if not isinstance(value, list) or len(value) != 3:
        raise InputError(where, f"{ascii(value)[:40]}, expected three numbers")
    for one in value:
        if isinstance(one, bool) or not isinstance(one, int | float) or not abs(one) <= LARGEST:
            raise InputError(where, f"{ascii(one)[:40]}, expected a finite number up to {LARGEST:g}")
    return [float(one) for one in value]
