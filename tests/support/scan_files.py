"""A cube with colours as a PLY of any form, and scans read from the bytes of files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from facepipe.importers.scan_file import read_scan
from facepipe.scans import Scan

CODES = {"float": "f4", "double": "f8", "uchar": "u1", "ushort": "u2", "int": "i4", "uint": "u4", "short": "i2"}
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float64)
SIDES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
PAINT = np.linspace(0, 255, 24).reshape(8, 3).round()


def ply(
    form: str, columns: list[tuple[str, str, Any]], faces: list[list[int]], corner: str = "int", count: str = "uchar"
) -> bytes:
    """A PLY file by its format's description, property by property: slow, and nothing shared with the reader."""
    lines = ["ply", f"format {form} 1.0", "comment a cube", f"element vertex {len(columns[0][2])}"]
    lines += [f"property {kind} {name}" for name, kind, _ in columns]
    lines += ["element camera 1", "property list uchar float numbers", "property int id"]
    lines += [f"element face {len(faces)}", "property uchar flags", f"property list {count} {corner} vertex_indices"]
    rows = [
        [(kind, value) for (_, kind, _), value in zip(columns, row, strict=True)]
        for row in zip(*(c[2] for c in columns), strict=True)
    ]
    rows += [[("uchar", 2), ("float", 1.5), ("float", 2.5), ("int", 7)]]
    rows += [[("uchar", 0), (count, len(face)), *((corner, one) for one in face)] for face in faces]
    head = "\n".join([*lines, "end_header", ""]).encode()
    if form == "ascii":
        return head + "\n".join(" ".join(f"{value:.17g}" for _, value in row) for row in rows).encode()
    order = "<" if "little" in form else ">"
    return head + b"".join(np.array(value, order + CODES[kind]).tobytes() for row in rows for kind, value in row)


def cube(form: str = "ascii", position: str = "float", color: str = "uchar", **rest: Any) -> bytes:
    scale = {"uchar": 1.0, "ushort": 257.0, "float": 1 / 255}[color]
    columns = [(name, position, CUBE[:, i]) for i, name in enumerate("xyz")]
    columns += [(name, color, PAINT[:, i] * scale) for i, name in enumerate(("red", "green", "blue"))]
    return ply(form, columns, rest.pop("faces", SIDES), **rest)


def read(data: bytes, folder: Path, name: str = "scan.ply") -> Scan:
    """The scan of a file with these bytes."""
    (folder / name).write_bytes(data)
    return read_scan(folder / name)


def volume(points: np.ndarray, triangles: np.ndarray) -> float:
    """Of a closed surface that faces outward."""
    a, b, c = points[triangles].transpose(1, 0, 2)
    return float(np.einsum("tc,tc->", a, np.cross(b, c)) / 6)
