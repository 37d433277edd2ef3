"""Scans in STL and OFF files, through trimesh, once their bytes are found to hold what they promise.

PLY, OBJ and glTF have readers of our own: trimesh refuses a binary PLY whose faces differ in size, splits the points of
an OBJ at texture seams, and decodes no compressed glTF. Formats: 3D Systems, "StereoLithography Interface
Specification", 1989; "OFF Files" of Geomview's manual.
"""

from __future__ import annotations

import io
import logging
import re
import warnings
from pathlib import Path

import numpy as np

from facepipe.core.errors import InputError
from facepipe.core.reading import read_bytes
from facepipe.importers.wavefront import MAX_BYTES, read_text
from facepipe.scans import Scan

_NOWHERE = logging.NullHandler()
_HEADER, _TRIANGLE = 84, 50  # bytes of a binary STL
_NEXT_SOLID = re.compile(rb"endsolid[^\n]*\n\s*solid[^\n]*", re.IGNORECASE)
_OFF = re.compile(r"(?:ST)?C?N?OFF\s+([0-9]{1,10})\s+([0-9]{1,10})(?:\s+[0-9]{1,10})?\s*")


def read_stl(path: Path) -> Scan:
    """The triangles of an STL file, text or binary, three points each.

    :raises InputError: neither, cut short, without triangles, NaN or infinity
    """
    data = read_bytes(path, MAX_BYTES)
    count = int.from_bytes(data[_HEADER - 4 : _HEADER], "little")
    if len(data) != _HEADER + _TRIANGLE * count:
        if b"\0" in data or data.lstrip()[:5].lower() != b"solid":
            what = f"{len(data)} bytes, expected {_HEADER + _TRIANGLE * count} for the {count} triangles of its header"
            raise InputError(path, f"no STL, or cut short: {what}")
        count = data.lower().count(b"endfacet")
        data = _NEXT_SOLID.sub(b"", data)  # many solids take trimesh the square of their number
    return _read(path, data, "stl", count)


def read_off(path: Path) -> Scan:
    """The triangles and quads of an OFF file, points in its order; colours and normals are left out.

    :raises InputError: no text of that format, cut short, faces of other sizes or without points, NaN or infinity
    """
    rows = [row for line in read_text(path).split("\n") if (row := line.partition("#")[0].strip())]
    start = 1 if _OFF.fullmatch(rows[0] if rows else "") else 2  # the counts may have a row of their own
    header = _OFF.fullmatch(" ".join(rows[:start]))
    if header is None:
        raise InputError(path, "no OFF header, expected 'OFF' and the numbers of points and faces")
    points, faces = int(header[1]), int(header[2])
    if len(rows) - start < points + faces:
        raise InputError(path, f"cut short: {len(rows) - start} rows of {points} points and {faces} faces")
    corners = [row.split(None, 1)[0] for row in rows[start + points : start + points + faces]]
    other = next((number for number, one in enumerate(corners) if one not in ("3", "4")), None)
    if other is not None:
        raise InputError(f"{path} -> face {other}", f"{corners[other][:40]!r} corners, expected 3 or 4")
    triangles = corners.count("3") + 2 * corners.count("4")
    return _read(path, "\n".join(rows).encode(), "off", triangles)


def _read(path: Path, data: bytes, kind: str, triangles: int) -> Scan:
    """What trimesh makes of the bytes.

    :raises InputError: it can't read them, or finds another number of triangles, or numbers that are not finite
    """
    import trimesh

    if not triangles:
        raise InputError(path, "no triangles, expected a surface")
    logging.getLogger("trimesh").addHandler(_NOWHERE)  # else Python prints its notes where nobody has set up logging
    try:
        with warnings.catch_warnings():  # numpy's, of text at whose middle a number ends
            warnings.simplefilter("ignore")
            mesh = trimesh.load_mesh(io.BytesIO(data), file_type=kind, process=False)
    except Exception as error:  # of any kind: it trusts its files
        raise InputError(path, f"can't be read: {' '.join(str(error).split())[:120]}") from None
    if len(mesh.faces) != triangles:
        raise InputError(path, f"damaged: {len(mesh.faces)} triangles can be read of {triangles}")
    points, corners = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    if not np.isfinite(points).all():
        raise InputError(path, "NaN or infinity, expected finite numbers")
    if corners.min() < 0 or corners.max() >= len(points):
        raise InputError(path, f"a face with a point outside 0 to {len(points) - 1}")
    return Scan(name=path.stem, points=points, triangles=corners.astype(np.int32))
