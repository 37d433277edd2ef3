"""glTF materials as UsdPreviewSurface inputs, textures as image bytes.

Source: glTF 2.0 section 3.9 (materials), KHR_materials_ior, KHR_materials_unlit, KHR_materials_emissive_strength.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Literal

from facepipe.core.names import handles
from facepipe.parts import Color, Material, Texture, TextureInput
from facepipe_gltf.read.document import BASIS, Document, uri_name
from facepipe_gltf.read.meshes import uv_name
from facepipe_gltf.read.values import Names, Value, file_name, given_name
from facepipe_gltf.record_format import image_digest

Channels = Literal["rgb", "r", "g", "b", "a"]
Wrap = Literal["repeat", "mirror", "clamp"]
_Four = tuple[float, float, float, float]

_WRAPS: dict[int, Wrap] = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_SIGNATURES = {b"\x89PNG\r\n\x1a\n": "png", b"\xff\xd8\xff": "jpg"}
_DEFAULT = "default_material"
_IMPLEMENTED = {
    "KHR_materials_clearcoat",
    "KHR_materials_ior",
    "KHR_materials_unlit",
    "KHR_materials_emissive_strength",
}


def material_names(document: Document) -> list[str]:
    """Distinct names of all materials of the document; the last is for primitives without a material."""
    given = [given_name(value) or "" for value in document.entries("materials")]
    return list(handles([*given, _DEFAULT], "Material"))


def read_materials(document: Document, names: list[str], used: Iterable[str | None]) -> tuple[Material, ...]:
    """The materials in `used`, in document order.

    :raises InputError: values or images that can't be read
    """
    wanted = set(used)
    textures = _Textures(document)
    values = document.entries("materials")
    read = [_material(document, textures, values[i], name) for i, name in enumerate(names[:-1]) if name in wanted]
    if names[-1] in wanted:  # glTF 2.0 section 3.9.6: white, metallic 1, rough 1
        read.append(_material(document, textures, Value({}, document.root.trail), names[-1]))
    return tuple(read)


def is_double_sided(document: Document, index: int) -> bool:
    """Whether material `index` shows both sides."""
    return document.entries("materials")[index].get_or("doubleSided", False).flag()


class _Textures:
    """Texture inputs of one document; an image is read once and its file name is unique."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._images: dict[int, Texture] = {}
        self._read: dict[bytes, Texture] = {}  # an image that others repeat is one
        self._names = Names()

    def input(
        self, reference: Value, channels: Channels, scale: _Four, bias: _Four = (0.0, 0.0, 0.0, 0.0)
    ) -> TextureInput | None:
        """A material input of the textureInfo at `reference`; None, with a warning, where it has no image of ours."""
        document = self._document
        texture = document.entry("textures", reference.require("index"))
        source = texture.get("source")
        # KHR_texture_basisu and EXT_texture_webp name their image elsewhere, and need no source
        if source is None and texture.extension(BASIS) is not None:
            document.warn(texture, f"its image is KTX2 ({BASIS}), which is not decoded: left out")
            return None
        if source is None:
            document.warn(texture, "has no PNG or JPEG image: left out")
            return None
        sampler = texture.get("sampler")
        settings = Value({}, texture.trail) if sampler is None else document.entry("samplers", sampler)
        image = self._image(document.index("images", source))
        number = reference.get_or("texCoord", 0).integer()
        transform = reference.extension("KHR_texture_transform")
        if transform is not None:
            moved = transform.get_or("offset", [0.0, 0.0]).numbers(2) != (0.0, 0.0)
            scaled = transform.get_or("scale", [1.0, 1.0]).numbers(2) != (1.0, 1.0)
            if moved or scaled or transform.get_or("rotation", 0.0).number() != 0.0:
                document.warn(transform, "texture offsets, scales and rotations are left out")
            number = transform.get_or("texCoord", number).integer()
        return TextureInput(
            texture=image,
            channels=channels,
            uv_set=uv_name(number),
            scale=scale,
            bias=bias,
            wrap_s=_wrap(settings, "wrapS"),
            wrap_t=_wrap(settings, "wrapT"),
        )

    def _image(self, index: int) -> Texture:
        if index not in self._images:
            value = self._document.entries("images")[index]
            uri, view = value.get("uri"), value.get("bufferView")
            if uri is not None:
                data = self._document.content(uri)
            elif view is not None:
                buffer, start, length = self._document.view(view)
                self._document.budget.spend(length, value.error)
                data = bytes(buffer[start : start + length])
            else:
                raise value.error("neither uri nor bufferView, expected one")
            # by what it begins with: mimeType and the suffix may say otherwise
            kind = next((kind for signature, kind in _SIGNATURES.items() if data.startswith(signature)), None)
            if kind is None:
                raise value.error(f"image of unknown type (begins with {data[:4]!r}), expected PNG or JPEG")
            if data not in self._read:
                named = uri_name(uri.text()) if uri is not None else ""
                stem = PurePosixPath(named).stem or given_name(value) or ""
                name = f"{self._names.new(file_name(stem, 'texture'))}.{kind}"
                self._read[data] = Texture(name=name, data=data)
            self._images[index] = self._read[data]
        return self._images[index]


def _material(document: Document, textures: _Textures, value: Value, name: str) -> Material:
    for extension in value.get_or("extensions", {}).member_names():
        if extension not in _IMPLEMENTED:
            document.warn(value, f"the extension {ascii(extension)[:60]} is left out")
    empty = Value({}, value.trail)
    surface = value.get("pbrMetallicRoughness") or empty
    base = _factors(surface, "baseColorFactor", 4, 1.0)
    opacity, threshold = _opacity(textures, value, surface, base[3])
    ior = value.extension("KHR_materials_ior") or empty
    rough, metal = _factor(surface, "roughnessFactor"), _factor(surface, "metallicFactor")
    coat = value.extension("KHR_materials_clearcoat") or empty
    label = given_name(value)
    # in this order: images are numbered as they are first asked for
    diffuse = _color(textures, surface.get("baseColorTexture"), base)
    gain = _factor(value.extension("KHR_materials_emissive_strength") or empty, "emissiveStrength")
    red, green, blue = (gain * factor for factor in _factors(value, "emissiveFactor", 3, 0.0))
    emissive: Color | TextureInput = (0.0, 0.0, 0.0)
    if (red, green, blue) != emissive:
        emissive = _color(textures, value.get("emissiveTexture"), (red, green, blue, 1.0))
    # one picture holds both: by glTF roughness is its green channel, metallic its blue one
    metallic = _scalar(textures, surface.get("metallicRoughnessTexture"), "b", metal)
    roughness = _scalar(textures, surface.get("metallicRoughnessTexture"), "g", rough)
    occlusion, shaded = None, value.get("occlusionTexture")
    if shaded is not None:
        strength = _factor(shaded, "strength")  # ``1 + strength (texel - 1)``
        occlusion = textures.input(shaded, "r", (strength,) * 4, (1.0 - strength,) * 4)
    normal, bumped = None, value.get("normalTexture")
    if bumped is not None:
        scale = _factor(bumped, "scale")  # ``(2 texel - 1) * (scale, scale, 1)``
        normal = textures.input(bumped, "rgb", (2.0 * scale, 2.0 * scale, 2.0, 1.0), (-scale, -scale, -1.0, 0.0))
    return Material(
        name=name,
        label=label if label != name else None,
        diffuse_color=diffuse,
        emissive_color=emissive,
        metallic=metallic,
        roughness=roughness,
        opacity=opacity,
        opacity_threshold=threshold,
        occlusion=1.0 if occlusion is None else occlusion,
        normal=normal,
        ior=_factor(ior, "ior", 1.5),
        **_clearcoat(textures, coat),
    )


def _clearcoat(textures: _Textures, coat: Value) -> dict[str, float | TextureInput]:
    """Nothing where there is none: its roughness doesn't count then."""
    factor = _factor(coat, "clearcoatFactor", 0.0)
    if factor == 0:
        return {}
    rough = _factor(coat, "clearcoatRoughnessFactor", 0.0)
    return {
        "clearcoat": _scalar(textures, coat.get("clearcoatTexture"), "r", factor),
        "clearcoat_roughness": _scalar(textures, coat.get("clearcoatRoughnessTexture"), "g", rough),
    }


def _color(textures: _Textures, reference: Value | None, factor: tuple[float, ...]) -> Color | TextureInput:
    red, green, blue, alpha = factor
    found = None if reference is None else textures.input(reference, "rgb", (red, green, blue, alpha))
    return (red, green, blue) if found is None else found


def _scalar(textures: _Textures, reference: Value | None, channel: Channels, factor: float) -> float | TextureInput:
    found = None if reference is None else textures.input(reference, channel, (factor,) * 4)
    return factor if found is None else found


def _opacity(textures: _Textures, value: Value, surface: Value, alpha: float) -> tuple[float | TextureInput, float]:
    name = value.get_or("alphaMode", "OPAQUE").text()
    if name not in ("OPAQUE", "MASK", "BLEND"):
        raise value.error(f"alphaMode {ascii(name)[:40]}, expected OPAQUE, MASK or BLEND")
    threshold = _factor(value, "alphaCutoff", 0.5) if name == "MASK" else 0.0
    if name == "OPAQUE" or (name == "MASK" and threshold <= 0.0):
        return 1.0, 0.0
    return _scalar(textures, surface.get("baseColorTexture"), "a", alpha), threshold


def _wrap(sampler: Value, key: str) -> Wrap:
    mode = sampler.get_or(key, 10497)
    if mode.integer() not in _WRAPS:
        raise mode.error(f"{mode.integer()}, expected one of {', '.join(map(str, _WRAPS))}")
    return _WRAPS[mode.integer()]


def _factor(value: Value, key: str, default: float = 1.0) -> float:
    return value.get_or(key, default).number()


def _factors(value: Value, key: str, count: int, default: float) -> tuple[float, ...]:
    return value.get_or(key, [default] * count).numbers(count)


def with_recorded_images(
    document: Document, recorded: Sequence[Material], read: Sequence[Material]
) -> tuple[Material, ...]:
    """Recorded materials of a file of ours with the file's images; one whose images it lacks is as it was read."""
    textures = [used.texture for material in read for used in material.textured.values()]
    images = {image_digest(texture.data): texture.data for texture in textures}
    by_name = {one.name: one for one in read}
    result = []
    for material in recorded:
        if all(used.texture.data in images for used in material.textured.values()):
            result.append(material.with_textures(lambda texture: replace(texture, data=images[texture.data])))
            continue
        document.warn("facepipe", f"the images of the material {material.name} were merged: it is read as glTF has it")
        result.append(replace(by_name.get(material.name, Material(name=material.name)), name=material.name))
    return tuple(result)
