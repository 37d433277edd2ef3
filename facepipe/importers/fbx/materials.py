"""FBX materials as UsdPreviewSurface inputs: Lambert and Phong as FBX has them, and shaders that ufbx maps to PBR.

A texture takes the place of its colour, times the factor beside it. Blender's Phong holds its roughness, metallic and
alpha, which ufbx undoes. Transparency is the factor times the colour, and many writers say one without the other.
"""

from __future__ import annotations

import io
import itertools
import ntpath
from collections.abc import Collection, Hashable
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np

from facepipe.core.errors import InputError
from facepipe.core.images import damage_of, decoding, open_image
from facepipe.core.names import file_name, handles
from facepipe.core.policy.bounds import same_file
from facepipe.core.policy.paths import check_copied
from facepipe.core.reading import is_file, read_bytes
from facepipe.importers.fbx.meshes import FIRST_UV_SET
from facepipe.importers.fbx.scene import LARGEST, MAPS, NONE, Rows, Scene, open_scene
from facepipe.importers.wavefront import MAX_TEXTURE_BYTES
from facepipe.parts import Color, Material, Texture, TextureInput, UvTransform

Channels = Literal["rgb", "r", "g", "b", "a"]
Quadruple = tuple[float, float, float, float]
_SIGNATURES = {b"\x89PNG\r\n\x1a\n": "png", b"\xff\xd8\xff": "jpg"}
_DECODED = ("WEBP", "AVIF", "TGA", "BMP", "TIFF")  # to PNG, which all readers know
_CLAMPED = 1  # ufbx_wrap_mode


def material_names(scene: Scene) -> list[str]:
    """Distinct names of all materials of the file."""
    return list(handles([scene.text(row["name"]) for row in scene.tables["materials"]], "Material"))


def read_materials(
    scene: Scene, names: list[str], used: Collection[str | None], uv_sets: dict[str, str]
) -> tuple[Material, ...]:
    """The materials in `used`, in the order of the file.

    :param uv_sets: the file's name of each UV set -> its name on the face
    :raises InputError: values that are not finite; of a strict reader, a texture that can't be read
    """
    textures, rows = _Textures(scene, uv_sets), zip(names, scene.tables["materials"], strict=True)
    return tuple(_material(scene, textures, name, row) for name, row in rows if name in used)


def picture_names(source: Path) -> list[str]:
    """Where the pictures that an FBX file names may lie, in its folder or below: its other paths are another machine's.

    :raises InputError: no FBX, or a damaged file; wasmtime is not there
    """
    scene = open_scene(source)
    rows = [row for row in scene.tables["textures"] if not row["content"]["count"]]
    names = [name for row in rows for name in _beside(scene, row)]
    return [name for name in names if not ntpath.splitdrive(name)[0] and ntpath.normpath(name)[:1] not in ("\\", ".")]


def _beside(scene: Scene, row: Rows) -> list[str]:
    """Where a picture may lie, from the folder of the file.

    Absolute paths are those of the writer's machine: what is beside the file comes first.
    """
    relative, absolute = (scene.text(row[key]).replace("\\", "/") for key in ("relative", "absolute"))
    names = dict.fromkeys([relative, ntpath.basename(relative), ntpath.basename(absolute), absolute])
    return [name for name in names if name]


@dataclass
class _Textures:
    """Texture inputs of one file; a picture is read once and its file name is unique."""

    scene: Scene
    uv_sets: dict[str, str]
    _read: dict[int, Texture | None] = field(default_factory=dict)
    _known: dict[bytes, Texture] = field(default_factory=dict)
    _stems: set[str] = field(default_factory=set)  # of their names
    _files: dict[Hashable, bytes] = field(default_factory=dict)  # beside it, by `same_file`

    def input(
        self, number: int, channels: Channels, scale: Quadruple, bias: Quadruple = (0.0,) * 4
    ) -> TextureInput | None:
        """A material input of a texture; None, with a warning, where there is no picture of it.

        :raises InputError: of a strict reader, where there is none
        """
        if number == NONE:
            return None
        row = self.scene.tables["textures"][number]
        if number not in self._read:
            self._read[number] = self._picture(row)
        texture = self._read[number]
        if texture is None:
            return None
        if row["layers"] > 1:
            self.scene.warn(self.scene.text(row["name"]), f"{row['layers']} layers of a texture: the lowest is kept")
        wraps: list[Any] = ["clamp" if row[key] == _CLAMPED else "repeat" for key in ("wrap_u", "wrap_v")]
        return TextureInput(
            texture=texture,
            channels=channels,
            uv_set=self.uv_sets.get(self.scene.text(row["uv_set"]), FIRST_UV_SET),
            uv_transform=_uv_transform(row),
            scale=scale,
            bias=bias,
            wrap_s=wraps[0],
            wrap_t=wraps[1],
        )

    def _picture(self, row: Rows) -> Texture | None:
        scene = self.scene
        called = scene.text(row["relative"]) or scene.text(row["absolute"]) or scene.text(row["name"])
        try:
            data = scene.array(row["content"], "u1").tobytes() or self._file(row)
            if data not in self._known:
                kind = next((kind for signature, kind in _SIGNATURES.items() if data.startswith(signature)), None)
                if (damage := damage_of(data)) is not None:
                    raise InputError(scene.where, f"texture {ascii(called)[1:-1][:80]} {damage}")
                stem = PurePosixPath(file_name(ntpath.basename(called), "texture")).stem
                free = itertools.chain([stem], (f"{stem}_{n}" for n in itertools.count(len(self._stems) + 1)))
                stem = next(one for one in free if one not in self._stems)
                self._known[data] = Texture(
                    name=f"{stem}.{kind or 'png'}", data=data if kind else _as_png(data, called)
                )
                self._stems.add(stem)
            return self._known[data]
        except InputError as error:
            if scene.strict:
                raise
            scene.warn("", f"{error.what}: left out" if error.where == scene.where else f"{error}: left out")
            return None

    def _file(self, row: Rows) -> bytes:
        """The bytes of a picture beside the file.

        :raises InputError: none of its paths leads to a file that may be read
        """
        scene, folder = self.scene, self.scene.path.parent
        names = _beside(scene, row)
        refusal: InputError | None = None
        for name in names:
            path = folder / name
            try:
                check_copied(scene.where, path, scene.path)
            except InputError as error:
                refusal = refusal or error
                continue
            if is_file(path):
                if (key := same_file(path)) not in self._files:
                    self._files[key] = read_bytes(path, MAX_TEXTURE_BYTES)
                    scene.files.append(path)
                return self._files[key]
        called = ascii(next(iter(names), ""))[1:-1][:80]
        raise refusal or InputError(scene.where, f"texture {called} can't be found")


def _as_png(data: bytes, called: str) -> bytes:
    """A picture of another kind as PNG.

    :raises InputError: of an unknown kind, or damaged
    """
    where, written = f"texture {ascii(called)[1:-1][:80]}", io.BytesIO()
    image = open_image(data, where, _DECODED, expected="PNG, JPEG, WebP, AVIF, TGA, BMP or TIFF")
    with decoding(where):
        alpha = "A" in image.mode or "transparency" in image.info
        image.convert("RGBA" if alpha else "RGB").save(written, "PNG")
    return written.getvalue()


def _has_alpha(data: bytes) -> bool:
    """Whether a picture is a PNG with alpha: of grey or colours, or of a palette's entries."""
    png = data.startswith(b"\x89PNG")
    return png and (data[25:26] in (b"\4", b"\6") or b"tRNS" in data[: data.find(b"IDAT")])


def _uv_transform(row: Rows) -> UvTransform:
    """The rows of what the file does to UVs before it looks into the picture; both count v up."""
    columns = np.asarray(row["uv_to_texture"]).reshape(4, 3)
    (a, d), (b, e), (c, f) = columns[[0, 1, 3], :2].tolist()
    return (a, b, c, d, e, f) if (np.abs(columns) <= LARGEST).all() else (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def _material(scene: Scene, textures: _Textures, name: str, row: Rows) -> Material:
    maps = dict(zip(MAPS, row["maps"], strict=True))
    label = scene.text(row["name"])
    if not (np.abs(row["maps"]["value"]) <= LARGEST).all():
        what = f"holds NaN, infinity or numbers over {LARGEST:g}, expected finite ones"
        raise scene.error(f"the material {ascii(name)[1:-1][:80]} {what}")

    def number(key: str, default: float) -> float:
        return float(maps[key]["value"][0]) if maps[key]["given"] else default

    def scalar(key: str, default: float, channel: Channels = "r") -> float | TextureInput:
        found = textures.input(int(maps[key]["texture"]), channel, (1.0,) * 4)
        return _unit(number(key, default)) if found is None else found

    def color(key: str, factor: float, default: Color) -> Color | TextureInput:
        found = textures.input(int(maps[key]["texture"]), "rgb", (factor, factor, factor, 1.0))
        red, green, blue = (float(one) for one in maps[key]["value"][:3]) if maps[key]["given"] else default
        return (factor * red, factor * green, factor * blue) if found is None else found

    roughness = scalar("roughness", 0.5)
    if not maps["roughness"]["given"] and maps["glossiness"]["given"]:
        roughness = _unit(1.0 - number("glossiness", 0.5))
    if maps["bump"]["texture"] != NONE and maps["normal"]["texture"] == NONE:
        scene.warn(label, "its bump map is left out: only normal maps are kept")
    ior = number("ior", 1.5)
    return Material(
        name=name,
        label=label if label != name else None,
        diffuse_color=color("base_color", number("base_factor", 1.0), (0.8, 0.8, 0.8)),
        emissive_color=color("emission_color", max(number("emission_factor", 1.0), 0.0), (0.0, 0.0, 0.0)),
        metallic=scalar("metallic", 0.0),
        roughness=roughness,
        opacity=_opacity(scene, textures, maps, label),
        occlusion=scalar("occlusion", 1.0),
        normal=textures.input(int(maps["normal"]["texture"]), "rgb", (2.0, 2.0, 2.0, 1.0), (-1.0, -1.0, -1.0, 0.0)),
        ior=ior if 1.0 <= ior <= 4.0 else 1.5,
    )


def _opacity(scene: Scene, textures: _Textures, maps: dict[str, Rows], label: str) -> float | TextureInput:
    """Of PBR materials their own; else 1 less the transparency. Of a picture with alpha it is that."""
    for key, sign in (("opacity", 1.0), ("transparency_color", -1.0), ("transparency_factor", -1.0)):
        found = textures.input(int(maps[key]["texture"]), "r", (sign,) * 4, (0.0 if sign > 0 else 1.0,) * 4)
        if found is not None and _has_alpha(found.texture.data):
            return replace(found, channels="a", scale=(1.0,) * 4, bias=(0.0,) * 4)
        if found is not None:
            return found
    if maps["opacity"]["given"]:
        return _unit(float(np.mean(maps["opacity"]["value"][:3])))
    if not maps["transparency_color"]["given"]:
        return 1.0
    factor = float(maps["transparency_factor"]["value"][0]) if maps["transparency_factor"]["given"] else 1.0
    opacity = _unit(1.0 - factor * float(np.mean(maps["transparency_color"]["value"][:3])))
    if opacity == 0.0:  # writers leave a white transparent colour behind: nothing would be seen
        scene.warn(label, "says that it is wholly transparent: taken for opaque")
        return 1.0
    return opacity


def _unit(value: float) -> float:
    return min(max(value, 0.0), 1.0)
