"""UsdPreviewSurface materials as glTF metallic-roughness materials, with their images, samplers and textures."""

from __future__ import annotations

import hashlib
import io
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import ExportError, InputError
from facepipe.core.images import open_image
from facepipe.core.images import pixels as decoded
from facepipe.parts import Material, Mesh, Texture, TextureInput, exact
from facepipe.records import Json
from facepipe_gltf.options import Engine, TextureFormat

Pixels = npt.NDArray[np.uint8]

VARIANTS = "KHR_materials_variants"
WEBP, BASIS = "EXT_texture_webp", "KHR_texture_basisu"
_CLEARCOAT, _SHEEN = "KHR_materials_clearcoat", "KHR_materials_sheen"
_WRAP = {"repeat": 10497, "mirror": 33648, "clamp": 33071}
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"
_SUFFIX = {"image/png": ".png", "image/jpeg": ".jpg", "image/webp": ".webp", "image/ktx2": ".ktx2"}
_CHANNEL = {"r": 0, "g": 1, "b": 2, "a": 3}


@dataclass(frozen=True)
class Image:
    """An image file as it goes into the document."""

    name: str  # without extension
    mime: str
    data: bytes

    @property
    def extension(self) -> str:
        """File name extension with its dot."""
        return _SUFFIX[self.mime]


class Textures:
    """Collects images, each once however often it is used."""

    def __init__(self, kind: TextureFormat | None) -> None:
        self._kind = kind  # what pictures are to be, of those of --texture-format
        self.images: list[Image] = []
        self.samplers: list[Json] = []
        self.textures: list[Json] = []
        self.warnings: list[str] = []
        self._number: dict[bytes, int] = {}

    def whole(self, texture: Texture) -> int | None:
        """The image of a texture: PNG and JPEG as they are, others as PNG; None (and a warning) where unreadable.

        :raises InputError: one that may not be copied
        """
        data = texture.image()
        try:
            open_image(data, texture.name, decode=False)
        except InputError as error:
            self._unreadable(texture, error)
            return None
        if texture.data.startswith(_PNG):
            # without colour profile, chromaticities and pixel aspect ratio: glTF itself defines the colour space of
            # every texture; pixel bytes stay untouched, and so does a file that has none of these chunks
            kept, position = [_PNG], len(_PNG)
            while position + 8 <= len(texture.data):
                length, kind = struct.unpack_from(">I4s", texture.data, position)
                end = position + 12 + length
                body = texture.data[position + 8 : end]
                uneven = kind == b"pHYs" and body[:4] != body[4:8]
                if kind not in (b"cHRM", b"iCCP") and not uneven:
                    kept.append(texture.data[position:end])
                position = end
            return self._image(Image(_stem(texture), "image/png", b"".join(kept)))
        if texture.data.startswith(_JPEG):
            return self._image(Image(_stem(texture), "image/jpeg", texture.data))
        if self._kind == "webp" and texture.data[:4] == b"RIFF" and texture.data[8:12] == b"WEBP":
            return self._image(Image(_stem(texture), "image/webp", texture.data))
        pixels = self.pixels(texture)
        return None if pixels is None else self.made(_stem(texture), pixels)

    @property
    def webp_used(self) -> bool:
        """Whether an image is WebP."""
        return any(image.mime == "image/webp" for image in self.images)

    def made(self, name: str, pixels: Pixels) -> int:
        """The image of (h, w, 3 or 4) pixels: PNG, or what pictures are to be."""
        from PIL import Image as Pillow

        if self._kind == "jpeg" or self._kind == "webp":
            from facepipe_gltf.images import COLORS, packed_image

            kind = "png" if self._kind == "jpeg" and pixels.shape[2] == 4 else self._kind
            return self._image(Image(name, f"image/{kind}", packed_image(pixels, kind, colors=COLORS)))
        stream = io.BytesIO()
        Pillow.fromarray(pixels).save(stream, format="PNG")
        return self._image(Image(name, "image/png", stream.getvalue()))

    def pixels(self, texture: Texture) -> Pixels | None:
        """(h, w, 4) pixels of a texture; None (and a warning) where unreadable."""
        data = texture.image()
        try:
            return decoded(open_image(data, texture.name), "RGBA", texture.name)
        except InputError as error:
            self._unreadable(texture, error)
            return None

    def info(self, image: int, source: TextureInput, uv_names: tuple[str, ...]) -> Json:
        """A textureInfo that reads `image` like `source` does."""
        if source.uv_set not in uv_names:
            self.warn(f"{source.texture.name}: reads UV set '{source.uv_set}', which is missing; '{uv_names[0]}' taken")
        sampler = {"wrapS": _WRAP[source.wrap_s], "wrapT": _WRAP[source.wrap_t]}
        texture: Json = {"sampler": _place(self.samplers, sampler), "source": image}
        if self.images[image].mime == "image/webp":
            texture = {"sampler": texture["sampler"], "extensions": {WEBP: {"source": image}}}
        info: Json = {"index": _place(self.textures, texture)}
        if source.uv_set in uv_names and uv_names.index(source.uv_set):
            info["texCoord"] = uv_names.index(source.uv_set)
        return info

    def warn(self, line: str) -> None:
        """Add a warning, once."""
        if line not in self.warnings:
            self.warnings.append(line)

    def _unreadable(self, texture: Texture, error: InputError) -> None:
        self.warn(f"{texture.name}: texture left out, it {error.what}")

    def _image(self, image: Image) -> int:
        digest = hashlib.sha256(image.data).digest()
        if digest not in self._number:
            self._number[digest] = len(self.images)
            self.images.append(image)
        return self._number[digest]


def _place(entries: list[Json], entry: Json) -> int:
    """Index of `entry` in `entries`, added where missing."""
    if entry not in entries:
        entries.append(entry)
    return entries.index(entry)


def _stem(texture: Texture) -> str:
    name = texture.name.replace("\\", "/").rpartition("/")[2]
    return name.rpartition(".")[0] or name or "image"


class Channel(NamedTuple):
    """One channel of a new image: a texture's, or white."""

    source: TextureInput | None = None
    channel: int = 0
    inverted: bool = False


@dataclass(frozen=True)
class Surface:
    """A material in the document, and what its primitives need."""

    index: int
    tangent_uv: int | None  # the UV set of its normal map, which gets tangents
    colored: bool  # COLOR_0 may multiply it
    mappings: tuple[Json, ...] = ()  # what variants show in its place, as KHR_materials_variants has it


class MaterialWriter:
    """Converts the face's materials as meshes ask for them; one glTF material per material, UV layout and sidedness."""

    def __init__(
        self, materials: Sequence[Material], tangents: bool, engine: Engine, kind: TextureFormat | None
    ) -> None:
        self.textures = Textures(kind)
        self._engine = engine
        self._unread: dict[str, list[str]] = {}  # extension -> materials that are without for the engine's sake
        self._tangents = tangents
        self.materials: list[Json] = []
        self.extensions: set[str] = set()
        self._by_name = {material.name: material for material in materials}
        self._surfaces: dict[tuple[str | None, tuple[str, ...], bool, bool], Surface] = {}
        self.variants = tuple(dict.fromkeys(variant for material in materials for variant in material.variants))

    @property
    def dropped(self) -> tuple[str, ...]:
        """A line for each extension that the engine doesn't read: it shows these materials without either way."""
        return tuple(
            f"{kind} of {len(names)} material{'s' * (len(names) > 1)}: {self._engine.title} does not read it"
            for kind, names in self._unread.items()
        )

    @property
    def names(self) -> tuple[str | None, ...]:
        """Of each material of the file the one of the face."""
        return tuple(name for name, *_ in self._surfaces)

    def surface(self, name: str | None, mesh: Mesh) -> Surface:
        """The material `name` as `mesh` needs it, with what variants show in its place; None is UsdPreviewSurface's
        default.

        :raises ExportError: there is no such material
        """
        own = self._surface(name, mesh)
        shown = {} if name is None else self._by_name[name].variants
        if not shown:
            return own
        # each variant is named: some readers, as Babylon.js, leave what an earlier one showed where a mapping lacks
        others = [self._surface(shown.get(variant, name), mesh) for variant in self.variants]
        numbers: dict[int, list[int]] = {}
        for variant, other in enumerate(others):
            numbers.setdefault(other.index, []).append(variant)
        self.extensions.add(VARIANTS)
        # one set of vertices serves them all: it has tangents where one needs them, and colours where none would be off
        mapped = list(dict.fromkeys(one.tangent_uv for one in (own, *others) if one.tangent_uv is not None))
        if len(mapped) > 1:
            self.textures.warn(f"{name}: normal maps of its variants read other UV sets, the tangents are of the first")
        return replace(
            own,
            tangent_uv=mapped[0] if mapped else None,
            colored=all(one.colored for one in (own, *others)),
            mappings=tuple({"material": index, "variants": listed} for index, listed in numbers.items()),
        )

    def _surface(self, name: str | None, mesh: Mesh) -> Surface:
        if name is not None and name not in self._by_name:
            raise ExportError(f"{mesh.name} -> material {name}", "not among the face's materials")
        uv_names = tuple(uv_set.name for uv_set in mesh.uv_sets)
        key = (name, uv_names, mesh.double_sided, name is None and mesh.colors is not None)
        if key not in self._surfaces:
            plain = Material(name="default", diffuse_color=(0.18,) * 3 if mesh.colors is None else (1.0, 1.0, 1.0))
            source = material = plain if name is None else self._by_name[name]
            if material.textured and not uv_names:
                self.textures.warn(f"{material.name}: textures left out on a mesh without UVs")
                constants = vars(Material(name=material.name))
                source = replace(material, **{one: constants[one] for one in material.textured})
            # numbers of UV sets and sidedness are the mesh's in USD and the material's in glTF: one for each of these
            result: Json = {"name": exact(material), "pbrMetallicRoughness": {}}
            self._base_color(result, source, uv_names)
            self._metallic_roughness(result["pbrMetallicRoughness"], source, uv_names)
            self._normal(result, source, uv_names)
            self._occlusion(result, source, uv_names)
            self._emissive(result, source, uv_names)
            if mesh.double_sided:
                result["doubleSided"] = True
            if source.ior != 1.5:
                self._extend(result, "KHR_materials_ior", {"ior": max(source.ior, 1.0)})
            self._clearcoat(result, source, uv_names)
            self._sheen(result, source)
            self._wrinkles(result, source, uv_names)
            if source.unlit:
                self._extend(result, "KHR_materials_unlit", {})
            self.materials.append(result)
            mapped = "normalTexture" in result
            self._surfaces[key] = Surface(
                index=len(self.materials) - 1,
                tangent_uv=result["normalTexture"].get("texCoord", 0) if mapped and self._tangents else None,
                colored=source.diffuse_color == (1.0, 1.0, 1.0),
            )
        return self._surfaces[key]

    def _base_color(self, result: Json, material: Material, uv_names: tuple[str, ...]) -> None:
        pbr = result["pbrMetallicRoughness"]
        diffuse, opacity = material.diffuse_color, material.opacity
        factor = self._factors(material, "diffuseColor", diffuse, range(3)) + self._factor(material, "opacity", opacity)
        # the base colour image with opacity in its alpha channel, and the input that says how it is read
        source = diffuse if isinstance(diffuse, TextureInput) else None
        if source is None:
            channels = [Channel()] * 3
        elif source.channels != "rgb":
            channels = [Channel(source, _CHANNEL[source.channels])] * 3
        else:
            channels = [Channel(source, i) for i in range(3)]
        image = None
        if not isinstance(opacity, TextureInput):
            if source is not None:
                whole = source.channels == "rgb"
                image = self.textures.whole(source.texture) if whole else self._merge(material, "diffuse", channels)
        elif source is not None and (source.channels, opacity.channels, source.texture) == (
            "rgb",
            "a",
            opacity.texture,
        ):
            image = self.textures.whole(source.texture)
        elif source is not None and not _same_reading(source, opacity):
            # glTF has no opacity texture, only the alpha of the base colour: one image, so one set of UVs for both
            self.textures.warn(f"{material.name}: opacity texture left out, its UVs are not those of the diffuse one")
            image = self.textures.whole(source.texture)
        else:
            channels.append(Channel(opacity, _CHANNEL.get(opacity.channels, 0)))
            image, source = self._merge(material, "base", channels), source or opacity
        if image is not None and source is not None:
            pbr["baseColorTexture"] = self.textures.info(image, source, uv_names)
        if factor != [1.0, 1.0, 1.0, 1.0]:
            pbr["baseColorFactor"] = factor
        if material.opacity_threshold > 0 and (isinstance(opacity, TextureInput) or opacity < 1):
            result |= {"alphaMode": "MASK", "alphaCutoff": material.opacity_threshold}
        elif isinstance(opacity, TextureInput) or opacity < 1:
            result["alphaMode"] = "BLEND"

    def _metallic_roughness(self, pbr: Json, material: Material, uv_names: tuple[str, ...]) -> None:
        metallic, roughness = material.metallic, material.roughness
        (pbr["metallicFactor"],) = self._factor(material, "metallic", metallic)
        (pbr["roughnessFactor"],) = self._factor(material, "roughness", roughness)
        inputs = [one for one in (metallic, roughness) if isinstance(one, TextureInput)]
        if not inputs:
            return
        if len(inputs) == 2 and not _same_reading(*inputs):
            self.textures.warn(f"{material.name}: metallic texture left out, its UVs are not those of roughness")
            inputs, metallic, pbr["metallicFactor"] = inputs[1:], 0.0, 0.0
        # glTF fixes the channels of its one image: roughness in green, metallic in blue
        if _is_packed(metallic, "b") and _is_packed(roughness, "g") and len({one.texture for one in inputs}) == 1:
            image = self.textures.whole(inputs[0].texture)
        else:
            channels = [Channel(), _channel(roughness), _channel(metallic)]
            image = self._merge(material, "metallicRoughness", channels)
        if image is not None:
            pbr["metallicRoughnessTexture"] = self.textures.info(image, inputs[0], uv_names)
            return
        # UsdPreviewSurface's defaults: glTF's own, 1 and 1, would make rough metal of skin
        if isinstance(metallic, TextureInput):
            pbr["metallicFactor"] = 0.0
        if isinstance(roughness, TextureInput):
            pbr["roughnessFactor"] = 0.5

    def _normal(self, result: Json, material: Material, uv_names: tuple[str, ...]) -> None:
        normal = material.normal
        if normal is None:
            return
        x, y = (normal.scale[axis] if normal.scale[axis] else 2.0 for axis in (0, 1))
        if abs(x) == 1.0:  # unauthored scale: the texture is read as if it were authored with 2
            x = y = 2.0
        if y * x < 0:  # green points down
            flipped = [Channel(normal, 0), Channel(normal, 1, inverted=True), Channel(normal, 2)]
            image = self._merge(material, "normal", flipped)
        else:
            image = self.textures.whole(normal.texture)
        if image is None:
            return
        result["normalTexture"] = self.textures.info(image, normal, uv_names)
        if abs(x) != 2.0:
            result["normalTexture"]["scale"] = abs(x) / 2

    def _occlusion(self, result: Json, material: Material, uv_names: tuple[str, ...]) -> None:
        occlusion = material.occlusion
        if not isinstance(occlusion, TextureInput):
            if occlusion != 1.0:
                self.textures.warn(f"{material.name}: constant occlusion {occlusion:g} left out")
            return
        if occlusion.channels in ("r", "rgb"):
            image = self.textures.whole(occlusion.texture)
        else:
            image = self._merge(material, "occlusion", [_channel(occlusion)] * 3)
        if image is None:
            return
        result["occlusionTexture"] = self.textures.info(image, occlusion, uv_names)
        channel = _CHANNEL.get(occlusion.channels, 0)
        strength = occlusion.scale[channel]
        if not np.isclose(occlusion.bias[channel], 1 - strength) or not 0 <= strength <= 1:
            self.textures.warn(f"{material.name}: scale and bias of the occlusion texture left out")
        elif strength != 1.0:
            result["occlusionTexture"]["strength"] = strength

    def _emissive(self, result: Json, material: Material, uv_names: tuple[str, ...]) -> None:
        emissive = material.emissive_color
        if isinstance(emissive, TextureInput):
            image = self.textures.whole(emissive.texture)
            if image is None:
                return
            result["emissiveTexture"] = self.textures.info(image, emissive, uv_names)
            factor = [max(value, 0.0) for value in emissive.scale[:3]]
            if any(emissive.bias[:3]):
                self.textures.warn(f"{material.name}: bias of the emissiveColor texture left out")
        else:
            factor = [max(value, 0.0) for value in emissive]
        strength = max(1.0, *factor)
        if strength > 1.0:
            self._extend(result, "KHR_materials_emissive_strength", {"emissiveStrength": strength})
        if any(factor):
            result["emissiveFactor"] = [value / strength for value in factor]

    def _clearcoat(self, result: Json, material: Material, uv_names: tuple[str, ...]) -> None:
        if material.clearcoat == 0:
            return
        if not self._engine.clearcoat:
            self._unread.setdefault(_CLEARCOAT, []).append(material.name)
            return
        coat: Json = {}
        inputs = (("clearcoat", material.clearcoat), ("clearcoatRoughness", material.clearcoat_roughness))
        for place, (name, value) in enumerate(inputs):
            (coat[f"{name}Factor"],) = self._factor(material, name, value)
            if not isinstance(value, TextureInput):
                continue
            whole = _CHANNEL.get(value.channels, 0) == place
            image = self.textures.whole(value.texture) if whole else self._merge(material, name, [_channel(value)] * 3)
            if image is not None:
                coat[f"{name}Texture"] = self.textures.info(image, value, uv_names)
        self._extend(result, _CLEARCOAT, coat)

    def _sheen(self, result: Json, material: Material) -> None:
        if not any(material.sheen_color) or material.unlit:
            return
        if not self._engine.sheen:
            self._unread.setdefault(_SHEEN, []).append(material.name)
            return
        color = self._factors(material, "sheenColor", material.sheen_color)
        (rough,) = self._factors(material, "sheenRoughness", [material.sheen_roughness])
        self._extend(result, _SHEEN, {"sheenColorFactor": color, "sheenRoughnessFactor": rough})

    def _wrinkles(self, result: Json, material: Material, uv_names: tuple[str, ...]) -> None:
        """What glTF has no word for, in extras: other readers show the skin without."""
        wrinkles = material.wrinkles
        if wrinkles is None or "normalTexture" not in result:
            return
        images = [self.textures.whole(used.texture) for used in wrinkles.inputs]
        if None in images:
            self.textures.warn(f"{material.name}: wrinkles left out")
            return
        normal, tint, *masks = (
            self.textures.info(image, used, uv_names)
            for image, used in zip(images, wrinkles.inputs, strict=True)
            if image is not None
        )
        regions = [
            {"name": one.name, "mask": mask, "channel": one.mask.channels, "shapes": dict(one.shapes)}
            for one, mask in zip(wrinkles.regions, masks, strict=True)
        ]
        result["extras"] = {"facepipe": {"wrinkles": {"normal": normal, "tint": tint, "regions": regions}}}

    def _merge(self, material: Material, role: str, channels: Sequence[Channel]) -> int | None:
        """An image of these channels, as large as the largest texture; None where a texture can't be read."""
        planes: list[Pixels | None] = []
        for one in channels:
            pixels = None if one.source is None else self.textures.pixels(one.source.texture)
            planes.append(None if pixels is None else pixels[..., one.channel].copy())  # the others are let go
        present = [plane for plane in planes if plane is not None]
        if len(present) < sum(one.source is not None for one in channels):
            return None
        height, width = max((plane.shape for plane in present), key=lambda size: size[0] * size[1])
        from PIL import Image as Pillow

        merged = []
        for one, found in zip(channels, planes, strict=True):
            plane = np.full((height, width), 255, np.uint8) if found is None else found
            if plane.shape != (height, width):
                plane = np.asarray(Pillow.fromarray(plane).resize((width, height), Pillow.Resampling.BILINEAR))
            merged.append(255 - plane if one.inverted else plane)
        return self.textures.made(f"{material.name}_{role}", np.stack(merged, axis=-1))

    def _factor(self, material: Material, name: str, value: float | TextureInput) -> list[float]:
        if isinstance(value, TextureInput):
            return self._factors(material, name, value, [_CHANNEL.get(value.channels, 0)])
        return self._factors(material, name, [value])

    def _factors(
        self, material: Material, name: str, values: Sequence[float] | TextureInput, channels: Sequence[int] = ()
    ) -> list[float]:
        """Constants, or a texture's scales of `channels`, within 0..1."""
        if isinstance(values, TextureInput):
            if any(values.bias[channel] for channel in channels):
                self.textures.warn(f"{material.name}: bias of the {name} texture left out")
            values = [values.scale[channel] for channel in channels]
        clipped = [float(min(max(value, 0.0), 1.0)) for value in values]
        if clipped != [float(value) for value in values]:
            self.textures.warn(f"{material.name}: {name} {tuple(values)} clamped to 0..1")
        return clipped

    def _extend(self, result: Json, extension: str, values: Json) -> None:
        self.extensions.add(extension)
        result.setdefault("extensions", {})[extension] = values


def _channel(value: float | TextureInput) -> Channel:
    """A texture's channel, or white for a constant: its value is in the factor."""
    if isinstance(value, TextureInput):
        return Channel(value, _CHANNEL.get(value.channels, 0))
    return Channel()


def _is_packed(value: float | TextureInput, channel: str) -> bool:
    """Whether a value can be read from `channel` of a shared texture as it is; a constant 0 wipes the channel out."""
    return value.channels == channel if isinstance(value, TextureInput) else value == 0.0


def _same_reading(a: TextureInput, b: TextureInput) -> bool:
    return (a.uv_set, a.wrap_s, a.wrap_t) == (b.uv_set, b.wrap_s, b.wrap_t)
