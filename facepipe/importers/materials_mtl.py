"""Wavefront material libraries: diffuse colour, opacity and diffuse texture.

Files come from the folder of the OBJ file or its roots: a name that leads elsewhere is refused, not followed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.core.policy.paths import check_copied
from facepipe.core.reading import is_file, read_bytes
from facepipe.importers.wavefront import read_text
from facepipe.parts import Material, Texture, TextureInput

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
        _read_library(path, source, result)
    return result


def _beside(source: Path, name: str, where: str) -> Path:
    """The path that an OBJ file, or a library of it, means.

    :raises InputError: outside of its folder and roots
    """
    path = source.parent / name.replace("\\", "/")
    check_copied(where, path, source)
    return path


def _read_library(path: Path, source: Path, result: Materials) -> None:
    name = None
    for number, row in enumerate(read_text(path).split("\n"), 1):
        keyword, *rest = row.split(None, 1)[:2] or [""]
        where, text = f"{path}:{number}", rest[0].strip() if rest else ""
        if keyword == "newmtl":
            name = text
            result.materials[name] = Material(name=name)
        elif name is not None:
            result.materials[name] = _with_line(result.materials[name], keyword, text, where, source, result)


def _with_line(material: Material, keyword: str, text: str, where: str, source: Path, result: Materials) -> Material:
    if keyword == "Kd" and not isinstance(material.diffuse_color, TextureInput):
        r, g, b = _numbers(where, text, 3)
        return replace(material, diffuse_color=(r, g, b))
    if keyword in ("d", "Tr"):
        value = _numbers(where, text.removeprefix("-halo"), 1)[0]
        return replace(material, opacity=1.0 - value if keyword == "Tr" else value)
    if keyword == "map_Kd":
        texture = _texture(_beside(source, texture_name(text), where), where, result)
        return replace(material, diffuse_color=TextureInput(texture=texture)) if texture else material
    return material


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


def _numbers(where: str, text: str, count: int) -> list[float]:
    try:
        values = [float(word) for word in text.split()[:count]]
    except ValueError:
        raise InputError(where, f"{text[:40]!r}, expected {count} numbers from 0 to 1") from None
    if len(values) != count or not all(math.isfinite(value) and 0 <= value <= 1 for value in values):
        raise InputError(where, f"{text[:40]!r}, expected {count} numbers from 0 to 1")
    return values
