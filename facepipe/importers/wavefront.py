"""Wavefront OBJ geometry as arrays, material libraries, sets of files on one topology, and meshes of pieces of one.

trimesh reads OBJ too, but triangulates, reorders and merges points, which breaks the correspondence between the
files of a shape set. Numeric lines are converted in bulk; a line at fault is looked for only when that fails.
Curves, points, lines and normals are left out.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import NoReturn

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.policy.paths import check_copied
from facepipe.core.reading import is_file, read_bytes
from facepipe.geometry.colors import from_srgb
from facepipe.parts import Blendshape, Material, Texture, TextureInput, UvSet

MAX_BYTES = 1 << 30
LARGEST = 1e30  # of a number: it stays finite in float32, its square in float64

_CORNERS = {  # how corners are written -> (pattern, numbers a corner)
    "point": (re.compile(r"(?:-?[0-9]+ )+"), 1),
    "point/uv": (re.compile(r"(?:-?[0-9]+/-?[0-9]+/? )+"), 2),
    "point/uv/normal": (re.compile(r"(?:-?[0-9]+/-?[0-9]+/-?[0-9]+ )+"), 3),
    "point//normal": (re.compile(r"(?:-?[0-9]+//-?[0-9]+ )+"), 2),
}
_CORNER = re.compile(r"(-?[0-9]{1,18})(?:/(-?[0-9]{1,18})?(?:/(?:-?[0-9]{1,18})?)?)?")
MAX_TEXTURE_BYTES = 1 << 28

_MAP_OPTIONS = {  # map_Kd option -> how many words follow; -o, -s and -t take one to three numbers
    "-blendu": 1,
    "-blendv": 1,
    "-boost": 1,
    "-bm": 1,
    "-cc": 1,
    "-clamp": 1,
    "-imfchan": 1,
    "-mm": 2,
    "-texres": 1,
    "-o": 3,
    "-s": 3,
    "-t": 3,
}


@dataclass(frozen=True, kw_only=True)
class Obj:
    """One OBJ file. Faces are n-gons; indices are 0-based."""

    points: FloatArray  # (n, 3) float64
    face_vertex_counts: IntArray  # (f,) int32
    face_vertex_indices: IntArray  # (corners,) int32
    uvs: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))  # (u, 2) float64
    uv_indices: IntArray | None = None  # (corners,) int32; None where a corner of the file has none
    colors: FloatArray | None = None  # (n, 3) linear 0..1 of the numbers after x y z, where every point has them
    objects: tuple[str, ...] = ()  # names of `o` lines
    face_object: IntArray = field(default_factory=lambda: np.zeros(0, np.int32))  # (f,) -1: before the first `o`
    groups: tuple[str, ...] = ()  # names of `g` lines
    face_group: IntArray = field(default_factory=lambda: np.zeros(0, np.int32))  # (f,) -1: before the first `g`
    materials: tuple[str, ...] = ()  # names of `usemtl` lines
    face_material: IntArray = field(default_factory=lambda: np.zeros(0, np.int32))  # (f,) -1: none
    libraries: tuple[str, ...] = ()  # file names of `mtllib` lines


@dataclass
class _Lines:
    """Line numbers (1-based) and the text after the keyword, by keyword."""

    path: Path
    records: dict[str, tuple[list[int], list[str]]]

    def fail(self, number: int, what: str) -> NoReturn:
        raise InputError(f"{self.path}:{number}", what)


def read_obj(path: Path) -> Obj:
    """Read `path`.

    :raises InputError: not readable, not UTF-8 text, without points, or a line that can't be used (``file:line``)
    """
    lines = _split(path, read_text(path))
    values = _numbers(lines, "v", 3)
    if len(values) == 0:
        raise InputError(path, "no points (v lines), expected a Wavefront OBJ")
    counts, indices, uv_indices = _faces(lines)
    uvs = _numbers(lines, "vt", 1, 2)
    indices = _resolved(lines, "v", counts, indices, len(values))
    if uv_indices is not None:
        uv_indices = _resolved(lines, "vt", counts, uv_indices, len(uvs))
    objects, face_object = _groups(lines, "o")
    groups, face_group = _groups(lines, "g")
    materials, face_material = _groups(lines, "usemtl")
    return Obj(
        points=np.ascontiguousarray(values[:, :3]),
        face_vertex_counts=counts,
        face_vertex_indices=indices,
        uvs=uvs,
        uv_indices=uv_indices,
        colors=_colors(values[:, -3:]) if values.shape[1] in (6, 7) else None,
        objects=objects,
        face_object=face_object,
        groups=groups,
        face_group=face_group,
        materials=materials,
        face_material=face_material,
        libraries=tuple(dict.fromkeys(text.strip() for text in lines.records["mtllib"][1] if text.strip())),
    )


def _colors(written: FloatArray) -> FloatArray:
    """(n, 3) linear light of what files hold: sRGB, most in 0..1 and some in 0..255."""
    largest = 255.0 if written.max() > 1.0 else 1.0
    return from_srgb(np.clip(written / largest, 0.0, 1.0))


def read_text(path: Path) -> str:
    """The UTF-8 text of `path`, line ends as ``\\n``.

    :raises InputError: not readable, too large, or binary
    """
    data = read_bytes(path, MAX_BYTES)
    if b"\0" in data:
        raise InputError(path, "is binary, expected text")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise InputError(f"{path}:{line}", f"byte 0x{data[error.start]:02x} is not UTF-8 text") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _split(path: Path, text: str) -> _Lines:
    rows, start = text.split("\n"), -1
    for i, row in enumerate(rows if "\\\n" in text else ()):
        # continued lines move up to where they start, and leave blank ones, so that line numbers stay true
        if start >= 0:
            rows[start] += " " + row.removesuffix("\\")
            rows[i] = ""
        elif row.endswith("\\"):
            start, rows[i] = i, row.removesuffix("\\")
        if not row.endswith("\\"):
            start = -1
    lines = _Lines(path, {keyword: ([], []) for keyword in ("v", "vt", "f", "o", "g", "usemtl", "mtllib")})
    for number, row in enumerate(rows, 1):
        words = row.split(None, 1)
        if words and words[0] in lines.records:
            lines.records[words[0]][0].append(number)
            lines.records[words[0]][1].append(words[1].partition("#")[0] if len(words) > 1 else "")
    return lines


def _numbers(lines: _Lines, keyword: str, at_least: int, columns: int | None = None) -> FloatArray:
    """(lines, columns) float64 of `keyword`, zeros where a line has fewer; None: as many as every line has."""
    numbers, texts = lines.records[keyword]
    words = [text.split() for text in texts]
    widths = list(map(len, words))
    if min(widths, default=at_least) < at_least:
        at = next(i for i, width in enumerate(widths) if width < at_least)
        lines.fail(numbers[at], f"{widths[at]} numbers after {keyword}, expected {at_least} or more")
    columns = columns or min(widths, default=at_least)
    if any(width != columns for width in widths):
        words = [(row + ["0"] * columns)[:columns] for row in words]
    try:
        values = np.array(list(map(float, chain.from_iterable(words))), dtype=np.float64).reshape(-1, columns)
    except ValueError:
        rows = zip(numbers, words, strict=True)
        number, bad = next((number, word) for number, row in rows for word in row if not _is_number(word))
        lines.fail(number, f"{bad[:40]!r}, expected a number")
    fits = (np.abs(values) <= LARGEST).all(axis=1)
    if not fits.all():
        lines.fail(numbers[int(np.argmin(fits))], f"NaN, infinity or over {LARGEST:g}, expected finite numbers")
    return values


def _faces(lines: _Lines) -> tuple[IntArray, IntArray, IntArray | None]:
    """Corner counts, point numbers and UV numbers as written (1-based or negative)."""
    numbers, texts = lines.records["f"]
    words = [text.split() for text in texts]
    counts = np.array(list(map(len, words)), dtype=np.int32)
    if len(counts) and counts.min() < 3:
        at = int(np.argmin(counts))
        lines.fail(numbers[at], f"{counts[at]} corners, expected 3 or more")
    joined = " ".join(chain.from_iterable(words)) + " "
    for style, (pattern, width) in _CORNERS.items():
        if pattern.fullmatch(joined):
            try:
                flat = np.array(list(map(int, joined.replace("/", " ").split())), dtype=np.int64).reshape(-1, width)
            except (OverflowError, ValueError):
                break
            return counts, flat[:, 0], flat[:, 1] if "/uv" in style else None
    points: list[int] = []
    uvs: list[int] = []
    for number, row in zip(numbers, words, strict=True):
        for word in row:
            match = _CORNER.fullmatch(word)
            if not match:
                lines.fail(number, f"corner {word[:40]!r}, expected point, point/uv or point/uv/normal")
            points.append(int(match[1]))
            if match[2]:
                uvs.append(int(match[2]))
    complete = len(uvs) == len(points) and bool(uvs)
    return counts, *(np.array(points, dtype=np.int64), np.array(uvs, dtype=np.int64) if complete else None)


def _resolved(lines: _Lines, keyword: str, counts: IntArray, indices: IntArray, available: int) -> IntArray:
    """0-based int32 indices; negative ones count back from the last `keyword` line before the face."""
    face_lines = np.array(lines.records["f"][0], dtype=np.int64)
    result = indices - 1
    if len(indices) and indices.min() < 0:
        before = np.searchsorted(np.array(lines.records[keyword][0], dtype=np.int64), face_lines)
        result = np.where(indices < 0, np.repeat(before, counts) + indices, result)
    bad = (result < 0) | (result >= available) | (indices == 0)
    if bad.any():
        at = int(np.argmax(bad))
        face = int(np.searchsorted(np.cumsum(counts), at, side="right"))
        lines.fail(int(face_lines[face]), f"{keyword} index {indices[at]}, expected 1..{available}")
    return result.astype(np.int32)


def _groups(lines: _Lines, keyword: str) -> tuple[tuple[str, ...], IntArray]:
    """Distinct names in order of appearance, and the number (f,) of the one in force at each face, -1 for none."""
    numbers, texts = lines.records[keyword]
    stripped = [text.strip() for text in texts]
    index: dict[str, int] = {}
    of_line = np.array([-1, *(index.setdefault(text, len(index)) for text in stripped)], dtype=np.int32)
    face_lines = np.array(lines.records["f"][0], dtype=np.int64)
    return tuple(index), of_line[np.searchsorted(np.array(numbers, dtype=np.int64), face_lines)]


def read_offsets(path: Path, neutral: Obj) -> FloatArray:
    """(n, 3) float64: points of the shape at `path` minus the neutral's.

    :raises InputError: the file can't be read
    :raises TopologyError: its points or faces aren't those of the neutral; a shape may have no faces at all
    """
    shape = read_obj(path)
    if len(shape.points) != len(neutral.points):
        raise TopologyError(path, f"{len(shape.points)} points, expected {len(neutral.points)} as in the neutral")
    counts, expected = shape.face_vertex_counts, neutral.face_vertex_counts
    same = np.array_equal(counts, expected)
    if len(counts) and not (same and np.array_equal(shape.face_vertex_indices, neutral.face_vertex_indices)):
        if len(counts) != len(expected):
            raise TopologyError(path, f"{len(counts)} faces, expected {len(expected)} as in the neutral")
        face = len(counts) if same else int(np.argmax(counts != expected))  # the first that differs in its size ...
        corners = int(expected[:face].sum())
        unequal = shape.face_vertex_indices[:corners] != neutral.face_vertex_indices[:corners]
        if unequal.any():  # ... or one before it, in its points
            face = int(np.searchsorted(np.cumsum(expected), int(np.argmax(unequal)), side="right"))
        found, wanted = _points(shape, face), _points(neutral, face)
        raise TopologyError(path, f"face {face + 1} has points {found}, expected {wanted} as in the neutral")
    return np.asarray(shape.points - neutral.points)


def _points(obj: Obj, face: int) -> list[int]:
    start = int(obj.face_vertex_counts[:face].sum())
    return [int(i) + 1 for i in obj.face_vertex_indices[start : start + int(obj.face_vertex_counts[face])]]


@dataclass
class Materials:
    """What was read, and what the user should know."""

    materials: dict[str, Material] = field(default_factory=dict)  # by name in the files
    files: list[Path] = field(default_factory=list)
    textures: dict[Path, Texture] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


def read_materials(source: Path, libraries: Sequence[str]) -> Materials:
    """The materials of all `libraries` of the OBJ file `source`.

    :raises InputError: a library or texture outside of its folder and roots, or a line that can't be used
    """
    result = Materials()
    for name in libraries:
        path = _beside(source, name, f"{source} -> mtllib")
        if not is_file(path):
            result.warnings.append(f"{ascii(path.name)[:80]}: material library not there, materials stay grey")
            continue
        result.files.append(path)
        material = None
        for number, row in enumerate(read_text(path).split("\n"), 1):
            keyword, *rest = row.split(None, 1)[:2] or [""]
            where, text = f"{path}:{number}", rest[0].strip() if rest else ""
            if keyword == "newmtl":
                material = Material(name=text)
            elif material is None:
                continue
            elif keyword == "Kd" and not isinstance(material.diffuse_color, TextureInput):
                red, green, blue = _material_numbers(where, text, 3)
                material = replace(material, diffuse_color=(red, green, blue))
            elif keyword in ("d", "Tr"):
                value = _material_numbers(where, text.removeprefix("-halo"), 1)[0]
                material = replace(material, opacity=1.0 - value if keyword == "Tr" else value)
            elif keyword == "map_Kd":
                texture = _texture(_beside(source, texture_name(text), where), where, result)
                material = replace(material, diffuse_color=TextureInput(texture=texture)) if texture else material
            result.materials[material.name] = material
    return result


def _beside(source: Path, name: str, where: str) -> Path:
    """The path that an OBJ file, or a library of it, means.

    :raises InputError: outside of its folder and roots
    """
    path = source.parent / name.replace("\\", "/")
    check_copied(where, path, source)
    return path


def _texture(path: Path, where: str, result: Materials) -> Texture | None:
    """The image at `path`, under a name of its own."""
    if path in result.textures:
        return result.textures[path]
    if not is_file(path):
        result.warnings.append(f"{where}: texture {ascii(path.name)[:80]} not there, the colour is used")
        return None
    data = read_bytes(path, MAX_TEXTURE_BYTES)
    taken = {texture.name for texture in result.textures.values()}
    name = path.name if path.name not in taken else f"{len(taken)}_{path.name}"
    result.files.append(path)
    result.textures[path] = Texture(name=name, data=data)
    return result.textures[path]


def texture_name(text: str) -> str:
    """The file of a texture's line: what is left after the options; a file name may hold blanks."""
    words = text.split(" ")
    while len(words) > 1 and words[0] in _MAP_OPTIONS:
        option, *words = words
        left = _MAP_OPTIONS[option]
        while left and len(words) > 1 and (left == _MAP_OPTIONS[option] or _is_number(words[0])):
            words, left = words[1:], left - 1
    return " ".join(words)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _material_numbers(where: str, text: str, count: int) -> list[float]:
    try:
        values = [float(word) for word in text.split()[:count]]
    except ValueError:
        raise InputError(where, f"{text[:40]!r}, expected {count} numbers from 0 to 1") from None
    if len(values) != count or not all(math.isfinite(value) and 0 <= value <= 1 for value in values):
        raise InputError(where, f"{text[:40]!r}, expected {count} numbers from 0 to 1")
    return values


def face_corners(face_vertex_counts: IntArray, faces: IntArray) -> IntArray:
    """Corner numbers of `faces`, face after face."""
    counts = np.asarray(face_vertex_counts, dtype=np.int64)
    starts = np.cumsum(counts) - counts
    picked = counts[faces]
    within = np.arange(int(picked.sum())) - np.repeat(np.cumsum(picked) - picked, picked)
    return np.asarray(np.repeat(starts[faces], picked) + within)


def compact_uvs(values: FloatArray, indices: IntArray) -> UvSet:
    """A face-varying UV set that holds only the values in use, in their order."""
    used, compact = np.unique(indices, return_inverse=True)
    return UvSet(values=np.asarray(values)[used], indices=compact.reshape(-1).astype(np.int32))


def sparse_shapes(
    shapes: Mapping[str, FloatArray], points: IntArray | slice, threshold: float
) -> tuple[Blendshape, ...]:
    """Shapes, name -> offsets (n, 3), of some `points`: those that they move further than `threshold`, if any."""
    sparse = []
    for name, whole in shapes.items():
        offsets = np.asarray(whole[points])
        moved = np.flatnonzero(np.linalg.norm(offsets.astype(np.float64), axis=1) > threshold)
        if len(moved):
            sparse.append(Blendshape(name=name, point_indices=moved.astype(np.int32), offsets=offsets[moved]))
    return tuple(sparse)


def whole_region(names: Sequence[str], region: str, count: int) -> dict[str, FloatArray]:
    """Masks (count,) of all regions `names` for a loose mesh that belongs to `region` alone."""
    return {name: np.full(count, float(name == region)) for name in names}
