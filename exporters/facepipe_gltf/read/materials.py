"""glTF materials as UsdPreviewSurface inputs, textures as image bytes.

Source: glTF 2.0 section 3.9 (materials), KHR_materials_ior, _sheen, _unlit, _emissive_strength,
KHR_materials_pbrSpecularGlossiness with its appendix B (conversion), KHR_texture_transform, EXT_texture_webp, _avif.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any, Literal

from facepipe.core.errors import InputError
from facepipe.core.images import damage_of, decoding, open_image
from facepipe.core.names import handles
from facepipe.core.reading import is_file
from facepipe.parts import Color, Material, Texture, TextureInput, UvTransform, WrinkleRegion, Wrinkles
from facepipe.stage.uv_transforms import IDENTITY
from facepipe_gltf.materials import BASIS
from facepipe_gltf.read.document import Document, Names, Value, file_name, given_name, quote, uri_name
from facepipe_gltf.read.meshes import uv_name
from facepipe_gltf.read.variants import Variants
from facepipe_gltf.record_format import image_digest

Channels = Literal["rgb", "r", "g", "b", "a"]
Wrap = Literal["repeat", "mirror", "clamp"]
_Four = tuple[float, float, float, float]

_CHANNELS: dict[str, Channels] = {"r": "r", "g": "g", "b": "b", "a": "a"}
_WRAPS: dict[int, Wrap] = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_SIGNATURES = {b"\x89PNG\r\n\x1a\n": "png", b"\xff\xd8\xff": "jpg"}
_OTHER_SOURCES = ("EXT_texture_avif", "EXT_texture_webp")
_DIELECTRIC = 0.04  # reflectance of what is no metal
_DEFAULT = "default_material"
_IMPLEMENTED = {
    "KHR_materials_clearcoat",
    "KHR_materials_ior",
    "KHR_materials_sheen",
    "KHR_materials_unlit",
    "KHR_materials_emissive_strength",
    "KHR_materials_pbrSpecularGlossiness",
}


def material_names(document: Document, variants: Variants) -> list[str]:
    """Distinct names of all materials by their numbers; the last is for primitives without a material."""
    count = len(document.entries("materials")) + len(variants.twins)
    given = [given_name(variants.value(number)) or "" for number in range(count)]
    return list(handles([*given, _DEFAULT], "Material"))


def read_materials(
    document: Document, names: list[str], used: Iterable[int], variants: Variants
) -> tuple[Material, ...]:
    """The materials in `used`, and those that variants show in their place, by number.

    :raises InputError: values or images that can't be read
    """
    numbers = {*used}
    numbers |= {other for number in numbers for other in variants.others(number)}
    textures, read = _Textures(document), []
    for number in sorted(numbers):
        last = number == len(names) - 1  # glTF 2.0 section 3.9.6: white, metallic 1, rough 1
        value = Value({}, document.root.trail) if last else variants.value(number)
        material = _material(document, textures, value, names[number])
        read.append(replace(material, variants=variants.shown(number, names)))
    return tuple(read)


class _Textures:
    """Texture inputs of one document; an image is read once and its file name is unique."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._images: dict[int, Texture | None] = {}
        self._read: dict[bytes, Texture] = {}  # an image that others repeat is one
        self._names = Names()

    def input(
        self, reference: Value, channels: Channels, scale: _Four, bias: _Four = (0.0, 0.0, 0.0, 0.0)
    ) -> TextureInput | None:
        """A material input of the textureInfo at `reference`; None, with a warning, where no image of it can be read.

        :raises InputError: of a strict reader, where none can be read
        """
        document = self._document
        texture = document.entry("textures", reference.require("index"))
        # the plain one first: it is what readers of glTF without extensions show
        given = [texture.get("source")]
        given += [one.get("source") for one in map(texture.extension, _OTHER_SOURCES) if one is not None]
        sources = [one for one in given if one is not None]
        image = next((one for one in map(self._image_of, sources) if one is not None), None)
        if image is None:
            ktx = texture.extension(BASIS) is not None
            why = f"its image is KTX2 ({BASIS}), which is not decoded" if ktx else "has no image that can be read"
            if document.strict:
                raise texture.error(why)
            document.warn(texture, f"{why}: left out")
            return None
        sampler = texture.get("sampler")
        settings = Value({}, texture.trail) if sampler is None else document.entry("samplers", sampler)
        number = reference.get_or("texCoord", 0).integer()
        transform = reference.extension("KHR_texture_transform")
        if transform is not None:
            number = transform.get_or("texCoord", number).integer()
        return TextureInput(
            texture=image,
            channels=channels,
            uv_set=uv_name(number),
            uv_transform=IDENTITY if transform is None else _uv_transform(transform),
            scale=scale,
            bias=bias,
            wrap_s=_wrap(settings, "wrapS"),
            wrap_t=_wrap(settings, "wrapT"),
        )

    def _image_of(self, source: Value) -> Texture | None:
        """The image that a texture names; None, with a warning, where it can't be read.

        :raises InputError: of a strict reader, one that can't be read; its bytes are not there
        """
        index = self._document.index("images", source)
        if index not in self._images:
            value = self._document.entries("images")[index]
            try:
                self._images[index] = self._read_image(value)
            except _NoImageError as error:
                fault = value.error(str(error))
                if self._document.strict:
                    raise fault from None
                self._document.warn(value, f"{error}: left out")
                self._images[index] = None
        return self._images[index]

    def _read_image(self, value: Value) -> Texture:
        """An image of the file, PNG and JPEG as they are, WebP and AVIF decoded.

        :raises _NoImageError: none that can be read
        """
        uri, view = value.get("uri"), value.get("bufferView")
        if uri is not None:
            file = self._document.file_of(uri)
            if file is not None and not is_file(file):
                raise _NoImageError(f"the file {quote(uri.text())} can't be found")
            data = self._document.content(uri)
        elif view is not None:
            buffer, start, length = self._document.view(view)
            self._document.budget.spend(length, value.error)
            data = bytes(buffer[start : start + length])
        else:
            raise value.error("neither uri nor bufferView, expected one")
        if data in self._read:
            return self._read[data]
        # by what it begins with: mimeType and the suffix may say otherwise
        kind = next((kind for signature, kind in _SIGNATURES.items() if data.startswith(signature)), None)
        if (damage := damage_of(data)) is not None:
            raise _NoImageError(damage)
        png = data if kind is not None else _as_png(data)
        named = uri_name(uri.text()) if uri is not None else ""
        stem = PurePosixPath(named).stem or given_name(value) or ""
        name = f"{self._names.new(file_name(stem, 'texture'))}.{kind or 'png'}"
        self._read[data] = Texture(name=name, data=png)
        return self._read[data]


class _NoImageError(Exception):
    """Why an image can't be read."""


def _as_png(data: bytes) -> bytes:
    """A WebP or AVIF image as PNG.

    :raises _NoImageError: another kind, or damaged
    """
    is_webp, is_avif = data[:4] == b"RIFF" and data[8:12] == b"WEBP", data[4:12] in (b"ftypavif", b"ftypavis")
    if data[:12] == b"\xabKTX 20\xbb\r\n\x1a\n":
        raise _NoImageError("KTX2 image, expected PNG, JPEG, WebP or AVIF (`gltf-transform png` makes it one)")
    if not is_webp and not is_avif:
        raise _NoImageError(f"image of unknown type (begins with {data[:4]!r}), expected PNG, JPEG, WebP or AVIF")
    written = io.BytesIO()
    try:
        image = open_image(data, "image", ["WEBP" if is_webp else "AVIF"])
        with decoding("image"):
            alpha = "A" in image.mode or "transparency" in image.info
            image.convert("RGBA" if alpha else "RGB").save(written, "PNG")
    except InputError as error:
        raise _NoImageError(error.what) from None
    return written.getvalue()


def _uv_transform(transform: Value) -> UvTransform:
    """``T R S`` of KHR_texture_transform, turned from glTF's v, which points down: u is as it is, v is 1 - v."""
    (x, y), (u, v) = transform.get_or("scale", [1.0, 1.0]).numbers(2), transform.get_or("offset", [0.0, 0.0]).numbers(2)
    angle = transform.get_or("rotation", 0.0).number()
    cosine, sine = math.cos(angle), math.sin(angle)
    # R = (cos sin, -sin cos) as the extension's example shader has it
    a, b, c, d = cosine * x, sine * y, -sine * x, cosine * y
    return (a, -b, b + u, -c, d, 1.0 - d - v)


def _material(document: Document, textures: _Textures, value: Value, name: str) -> Material:
    for extension in value.get_or("extensions", {}).member_names():
        if extension not in _IMPLEMENTED:
            document.warn(value, f"the extension {ascii(extension)[:60]} is left out")
    empty = Value({}, value.trail)
    surface = value.get("pbrMetallicRoughness") or empty
    glossy = value.extension("KHR_materials_pbrSpecularGlossiness")
    base, colored = _factors(surface, "baseColorFactor", 4, 1.0), surface.get("baseColorTexture")
    if glossy is not None:
        base, colored = _factors(glossy, "diffuseFactor", 4, 1.0), glossy.get("diffuseTexture")
    opacity, threshold = _opacity(textures, value, colored, base[3])
    ior = value.extension("KHR_materials_ior") or empty
    rough, metal = _factor(surface, "roughnessFactor"), _factor(surface, "metallicFactor")
    label = given_name(value)
    # in this order: images are numbered as they are first asked for
    diffuse = _color(textures, colored, base)
    gain = _factor(value.extension("KHR_materials_emissive_strength") or empty, "emissiveStrength")
    red, green, blue = (gain * factor for factor in _factors(value, "emissiveFactor", 3, 0.0))
    emissive: Color | TextureInput = (0.0, 0.0, 0.0)
    if (red, green, blue) != emissive:
        emissive = _color(textures, value.get("emissiveTexture"), (red, green, blue, 1.0))
    # one picture holds both: by glTF roughness is its green channel, metallic its blue one
    metallic = _scalar(textures, surface.get("metallicRoughnessTexture"), "b", metal)
    roughness = _scalar(textures, surface.get("metallicRoughnessTexture"), "g", rough)
    if glossy is not None:
        diffuse, metallic, roughness = _metallic_roughness(document, textures, glossy, diffuse)
    occlusion, shaded = None, value.get("occlusionTexture")
    if shaded is not None:
        strength = _factor(shaded, "strength")  # ``1 + strength (texel - 1)``
        occlusion = textures.input(shaded, "r", (strength,) * 4, (1.0 - strength,) * 4)
    normal, bumped = None, value.get("normalTexture")
    if bumped is not None:
        scale = _factor(bumped, "scale")  # ``(2 texel - 1) * (scale, scale, 1)``
        normal = textures.input(bumped, "rgb", (2.0 * scale, 2.0 * scale, 2.0, 1.0), (-scale, -scale, -1.0, 0.0))
    clearcoat: dict[str, Any] = {}
    coat = value.extension("KHR_materials_clearcoat") or empty
    if (factor := _factor(coat, "clearcoatFactor", 0.0)) != 0:  # its roughness doesn't count without
        coat_rough = _factor(coat, "clearcoatRoughnessFactor", 0.0)
        clearcoat["clearcoat"] = _scalar(textures, coat.get("clearcoatTexture"), "r", factor)
        rough_picture = coat.get("clearcoatRoughnessTexture")
        clearcoat["clearcoat_roughness"] = _scalar(textures, rough_picture, "g", coat_rough)
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
        unlit=value.extension("KHR_materials_unlit") is not None,
        wrinkles=_wrinkles(textures, value),
        **clearcoat,
        **_sheen(document, value),
    )


def _sheen(document: Document, value: Value) -> dict[str, Any]:
    """Colour and roughness of a sheen by field; its pictures are named and left out."""
    sheen = value.extension("KHR_materials_sheen")
    if sheen is None:
        return {}
    if any(sheen.get(f"sheen{kind}Texture") is not None for kind in ("Color", "Roughness")):
        document.warn(sheen, "its pictures are left out")
    red, green, blue = _factors(sheen, "sheenColorFactor", 3, 0.0)
    if not (red or green or blue):  # its roughness doesn't count without
        return {}
    return {"sheen_color": (red, green, blue), "sheen_roughness": _factor(sheen, "sheenRoughnessFactor", 0.0)}


def _wrinkles(textures: _Textures, value: Value) -> Wrinkles | None:
    """The wrinkles that our exports have in a material's extras; None where there are none, or their images lack."""
    ours = value.extras().get("facepipe")
    own = ours.get("wrinkles") if ours is not None and isinstance(ours.data, dict) else None
    if own is None:
        return None
    normal = textures.input(own.require("normal"), "rgb", (2.0, 2.0, 2.0, 1.0), (-1.0, -1.0, -1.0, 0.0))
    tint = textures.input(own.require("tint"), "rgb", (1.0,) * 4)
    regions = []
    for one in own.require("regions").items():
        channel = one.require("channel")
        if channel.text() not in _CHANNELS:
            raise channel.error(f"{quote(channel.text())}, expected one of {', '.join(_CHANNELS)}")
        mask = textures.input(one.require("mask"), _CHANNELS[channel.text()], (1.0,) * 4)
        shapes = one.require("shapes")
        gains = tuple((name, shapes.require(name).number()) for name in shapes.member_names())
        if mask is not None:
            regions.append(WrinkleRegion(name=one.require("name").name(), mask=mask, shapes=gains))
    return None if normal is None or tint is None else Wrinkles(normal=normal, tint=tint, regions=tuple(regions))


def _metallic_roughness(
    document: Document, textures: _Textures, glossy: Value, diffuse: Color | TextureInput
) -> tuple[Color | TextureInput, float, float | TextureInput]:
    """Base colour, metallic and roughness of a specular-glossiness material, by the extension's appendix B.

    Metallic is solved for the factors: what reflects more than 4 % is metal in part, and its colour that of its
    reflection. Where textures give a colour that can't be seen here, it is taken for no metal.
    """
    specular, gloss = _factors(glossy, "specularFactor", 3, 1.0), _factor(glossy, "glossinessFactor")
    picture = glossy.get("specularGlossinessTexture")
    found = None if picture is None else textures.input(picture, "a", (-gloss,) * 4, (1.0,) * 4)
    roughness: float | TextureInput = 1.0 - gloss if found is None else found
    if picture is not None or isinstance(diffuse, TextureInput):
        if picture is not None or max(specular) > 2 * _DIELECTRIC:
            document.warn(glossy, "its specular colour is left out: taken for no metal")
        return diffuse, 0.0, roughness
    shine = max(specular)
    dull, bright = _brightness(diffuse), _brightness(specular)
    if bright <= _DIELECTRIC:
        return diffuse, 0.0, roughness
    a, b, c = _DIELECTRIC, dull * (1 - shine) / (1 - _DIELECTRIC) + bright - 2 * _DIELECTRIC, _DIELECTRIC - bright
    metal = min(max((-b + math.sqrt(max(b * b - 4 * a * c, 0.0))) / (2 * a), 0.0), 1.0)
    color = []
    for dim, reflected in zip(diffuse, specular, strict=True):
        matt = dim * (1 - shine) / (1 - _DIELECTRIC) / max(1 - metal, 1e-6)
        mirror = (reflected - _DIELECTRIC * (1 - metal)) / max(metal, 1e-6)
        color.append(min(max(matt + (mirror - matt) * metal * metal, 0.0), 1.0))
    return (color[0], color[1], color[2]), metal, roughness


def _brightness(color: tuple[float, ...]) -> float:
    """How bright a colour is seen."""
    red, green, blue = color[:3]
    return math.sqrt(0.299 * red**2 + 0.587 * green**2 + 0.114 * blue**2)


def _color(textures: _Textures, reference: Value | None, factor: tuple[float, ...]) -> Color | TextureInput:
    red, green, blue, alpha = factor
    found = None if reference is None else textures.input(reference, "rgb", (red, green, blue, alpha))
    return (red, green, blue) if found is None else found


def _scalar(textures: _Textures, reference: Value | None, channel: Channels, factor: float) -> float | TextureInput:
    found = None if reference is None else textures.input(reference, channel, (factor,) * 4)
    return factor if found is None else found


def _opacity(
    textures: _Textures, value: Value, colored: Value | None, alpha: float
) -> tuple[float | TextureInput, float]:
    name = value.get_or("alphaMode", "OPAQUE").text()
    if name not in ("OPAQUE", "MASK", "BLEND"):
        raise value.error(f"alphaMode {ascii(name)[:40]}, expected OPAQUE, MASK or BLEND")
    threshold = _factor(value, "alphaCutoff", 0.5) if name == "MASK" else 0.0
    if name == "OPAQUE" or (name == "MASK" and threshold <= 0.0):
        return 1.0, 0.0
    return _scalar(textures, colored, "a", alpha), threshold


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
    textures = [texture for material in read for texture in material.textures]
    images = {image_digest(texture.data): texture.data for texture in textures}
    by_name = {one.name: one for one in read}
    result = []
    for material in recorded:
        if all(texture.data in images for texture in material.textures):
            result.append(material.with_textures(lambda texture: replace(texture, data=images[texture.data])))
            continue
        document.warn("facepipe", f"the images of the material {material.name} were merged: it is read as glTF has it")
        found = by_name.get(material.name, Material(name=material.name))
        result.append(replace(found, name=material.name, variants=material.variants))
    return tuple(result)
