"""UsdPreviewSurface materials of a stage, read as parts and authored from them, and images that a stage names."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from typing import Any, Literal

from pxr import Ar, Gf, Sdf, Usd, UsdGeom, UsdShade

from facepipe.core import tokens
from facepipe.core.errors import InputError, SchemaError
from facepipe.core.images import is_image
from facepipe.core.names import unique_identifiers
from facepipe.core.policy.paths import check_copied
from facepipe.core.reading import check_regular
from facepipe.parts import Color, FaceParts, Material, Texture, TextureInput, UvTransform, WrinkleRegion, Wrinkles
from facepipe.stage.layer_files import file_of, name_of
from facepipe.stage.prims import (
    apply_schema,
    author_name,
    check_property_name,
    editable,
    instances,
    is_applied,
    label,
    put,
    put_value,
)
from facepipe.stage.uv_transforms import IDENTITY, composed, scaled_turned_moved
from facepipe.stage.values import floats, reads_prim

_DEFAULT = Usd.TimeCode.Default()
_MOST_IMAGE_BYTES = 1 << 28  # of an image
_CHANNELS = ("r", "g", "b", "a")
Images = dict[str, bytes | None]  # by resolved path
Wrap = Literal["repeat", "mirror", "clamp"]
_WRAPS: dict[str, Wrap] = {
    "repeat": "repeat",
    "mirror": "mirror",
    "clamp": "clamp",
    "black": "clamp",
    "useMetadata": "repeat",
}
_MOST_TRANSFORMS = 16  # one after another: a circle has no end


def read_image(asset: Sdf.AssetPath) -> bytes | None:
    """The image that a value names; None where it names another file, or none.

    :raises InputError: a pipe or device, or a file that may not be read
    """
    if not asset.resolvedPath:
        return None
    file = file_of(asset.resolvedPath)
    check_regular(file, None if Ar.IsPackageRelativePath(asset.resolvedPath) else _MOST_IMAGE_BYTES)
    opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(asset.resolvedPath))
    data = bytes(opened.GetBuffer() or b"") if opened else b""  # an empty file has no buffer
    return data if is_image(data) else None


def copy_refusal(
    where: object, attribute: Usd.Attribute, asset: Sdf.AssetPath, time: Usd.TimeCode = _DEFAULT
) -> InputError | None:
    """Why the file that a value of an attribute names may not be copied: it is outside the roots and the folder of the
    layer that names it. A stage that is all in memory is the caller's own.
    """
    # the file of the layer that a value comes from; None where all of the stage is in memory
    layer = _layer_of_value(attribute, time)
    if layer is None or layer.anonymous:  # a repair in memory of what a file says
        below = [layer for layer in attribute.GetStage().GetLayerStack() if not layer.anonymous]
        layer = _layer_of_value(attribute, Usd.TimeCode.EarliestTime(), files=True) or next(iter(below), None)
    namer = None if layer is None else file_of(layer.realPath or layer.identifier)
    try:
        if namer is not None:
            check_copied(where, file_of(asset.resolvedPath), namer)
    except InputError as error:
        return error
    return None


def images_of(stage: Usd.Stage, known: Container[str] = ()) -> dict[str, bytes]:
    """The images that a stage names, by resolved path, but those known.

    :raises InputError: one that may not be copied
    """
    images: dict[str, bytes] = {}
    for attribute, time, asset in _asset_values(stage):
        data = None if asset.resolvedPath in known else read_image(asset)
        if data is None:
            continue
        refusal = copy_refusal(attribute.GetPath(), attribute, asset, time)
        if refusal is not None:
            raise refusal
        images[asset.resolvedPath] = data
    return images


def _asset_values(stage: Usd.Stage) -> Iterator[tuple[Usd.Attribute, Usd.TimeCode, Sdf.AssetPath]]:
    """All values of attributes that name files."""
    for top in (stage.GetPseudoRoot(), *stage.GetPrototypes()):
        for prim in Usd.PrimRange(top, Usd.PrimAllPrimsPredicate):
            for attribute in prim.GetAuthoredAttributes():
                if attribute.GetTypeName().scalarType != Sdf.ValueTypeNames.Asset:
                    continue
                for time in (_DEFAULT, *map(Usd.TimeCode, attribute.GetTimeSamples())):
                    value = attribute.Get(time)
                    for one in [value] if isinstance(value, Sdf.AssetPath) else value or ():
                        yield attribute, time, one


def _layer_of_value(attribute: Usd.Attribute, time: Usd.TimeCode, *, files: bool = False) -> Sdf.Layer | None:
    """The strongest layer with a value for a time; with `files`, of those that are not in memory alone."""
    kinds = ("default",) if time.IsDefault() else ("default", "timeSamples")
    for spec in attribute.GetPropertyStack(time):
        if any(map(spec.HasInfo, kinds)) and not (files and spec.layer.anonymous):
            return spec.layer
    return None


def value_of(shader: UsdShade.Shader, name: str, otherwise: Any) -> Any:
    attribute = attribute_of(shader, name)
    value = attribute.Get() if attribute else None
    return otherwise if value is None else value


def attribute_of(shader: UsdShade.Shader, name: str) -> Usd.Attribute | None:
    """The attribute that an input takes its value from."""
    given = shader.GetInput(name)
    attributes = UsdShade.Utils.GetValueProducingAttributes(given) if given else []
    return attributes[0] if attributes else None


def four(value: Any) -> tuple[float, float, float, float]:
    red, green, blue, alpha = value
    return (float(red), float(green), float(blue), float(alpha))


def image_of(source: UsdShade.Shader, images: Images) -> Texture | None:
    """The image of a shader that reads one; None where it names none.

    :param images: that were read before, filled in
    :raises InputError: missing, tiles, or no image
    """
    file = attribute_of(source, "file")
    return None if file is None else image_at(f"{source.GetPath()}.inputs:file", file, images)


def image_at(where: str, file: Usd.Attribute, images: Images) -> Texture | None:
    """The image that an attribute names; else as `image_of`."""
    asset = file.Get()
    if asset is None:
        return None
    if not isinstance(asset, Sdf.AssetPath):
        raise InputError(where, f"value of type {type(asset).__name__}, expected an asset path")
    if asset.resolvedPath not in images:
        images[asset.resolvedPath] = read_image(asset)
    data = images[asset.resolvedPath]
    if data is None:
        missing = not asset.resolvedPath
        if "<UDIM>" in asset.path:
            what = "UDIM tiles: a face has one picture an input, so bake them into one, or name one tile"
            raise InputError(where, f"@{asset.path}@ are {what}")
        raise InputError(where, f"texture @{asset.path}@ can't be found" if missing else f"@{asset.path}@ is no image")
    # a face with an image that may not be copied can be read all the same: who writes the image raises the refusal
    refusal = copy_refusal(where, file, asset)
    return Texture(name=name_of(asset.resolvedPath), data=b"" if refusal else data, refusal=refusal)


@reads_prim
def read_material(prim: Usd.Prim, name: str, images: Images) -> Material | None:
    """The UsdPreviewSurface of a Material prim; None where it has none.

    :param images: that were read before, filled in: one that many materials name is read once

    :raises InputError: a texture that is missing or no image
    """
    surface, _, _ = UsdShade.Material(prim).ComputeSurfaceSource()
    if not surface or surface.GetShaderId() != "UsdPreviewSurface":
        return None
    # what is not authored has the default of the UsdPreviewSurface specification
    return Material(
        name=name,
        diffuse_color=_color(surface, "diffuseColor", (0.18, 0.18, 0.18), images),
        emissive_color=_color(surface, "emissiveColor", (0.0, 0.0, 0.0), images),
        metallic=_number(surface, "metallic", 0.0, images),
        roughness=_number(surface, "roughness", 0.5, images),
        opacity=_number(surface, "opacity", 1.0, images),
        opacity_threshold=float(value_of(surface, "opacityThreshold", 0.0)),
        occlusion=_number(surface, "occlusion", 1.0, images),
        normal=_texture(surface, "normal", images),
        ior=float(value_of(surface, "ior", 1.5)),
        clearcoat=_number(surface, "clearcoat", 0.0, images),
        clearcoat_roughness=_number(surface, "clearcoatRoughness", 0.01, images),
        unlit=bool(prim.GetCustomDataByKey(tokens.UNLIT)),
        **_sheen(prim),
        wrinkles=_read_wrinkles(prim, images),
        label=label(prim, name),
    )


def _sheen(prim: Usd.Prim) -> dict[str, Any]:
    """The sheen of a Material prim, by field."""
    color, rough = (prim.GetCustomDataByKey(key) for key in (tokens.SHEEN_COLOR, tokens.SHEEN_ROUGHNESS))
    if color is None:
        return {}
    red, green, blue = color
    return {"sheen_color": (float(red), float(green), float(blue)), "sheen_roughness": float(rough or 0.0)}


def _read_wrinkles(prim: Usd.Prim, images: Images) -> Wrinkles | None:
    """The wrinkles of a Material prim; None where it has none, or names no maps.

    :param images: that were read before, filled in
    :raises InputError: an image that is missing, or none
    :raises SchemaError: a channel that images don't have, or lists that are not parallel
    """
    if not is_applied(prim, tokens.WRINKLES_API):
        return None
    uv_set = str(prim.GetAttribute(tokens.WRINKLES_UV_SET).Get() or "st")

    def image(name: str) -> Texture | None:
        attribute = prim.GetAttribute(name)
        return image_at(str(attribute.GetPath()), attribute, images) if attribute else None

    normal, tint = image(tokens.WRINKLES_NORMAL), image(tokens.WRINKLES_TINT)
    if normal is None or tint is None:
        return None
    regions = []
    for name in sorted(instances(prim, tokens.WRINKLE_API)):
        prefix = f"{tokens.WRINKLE_PREFIX}{name}:"
        where = f"{prim.GetPath()}.{prefix}"
        mask, channel = image(f"{prefix}mask"), str(prim.GetAttribute(f"{prefix}channel").Get() or "r")
        shapes = [str(one) for one in prim.GetAttribute(f"{prefix}shapes").Get() or ()]
        gains = floats(prim.GetAttribute(f"{prefix}gains").Get()).tolist()
        if channel not in _CHANNELS:
            raise SchemaError(f"{where}channel", f"'{channel[:40]}', expected one of {', '.join(_CHANNELS)}")
        if len(shapes) != len(gains):
            raise SchemaError(f"{where}gains", f"{len(gains)} gains and {len(shapes)} shapes, expected as many of each")
        if mask is not None:
            own: Any = channel
            read = TextureInput(texture=mask, channels=own, uv_set=uv_set)
            regions.append(WrinkleRegion(name=name, mask=read, shapes=tuple(zip(shapes, gains, strict=True))))
    return Wrinkles(
        normal=TextureInput(texture=normal, uv_set=uv_set, scale=(2.0, 2.0, 2.0, 1.0), bias=(-1.0, -1.0, -1.0, 0.0)),
        tint=TextureInput(texture=tint, uv_set=uv_set),
        regions=tuple(regions),
    )


def _color(shader: UsdShade.Shader, name: str, otherwise: Color, images: Images) -> Color | TextureInput:
    textured = _texture(shader, name, images)
    if textured:
        return textured
    red, green, blue = value_of(shader, name, otherwise)
    return (float(red), float(green), float(blue))


def _number(shader: UsdShade.Shader, name: str, otherwise: float, images: Images) -> float | TextureInput:
    return _texture(shader, name, images) or float(value_of(shader, name, otherwise))


def _texture(shader: UsdShade.Shader, name: str, images: Images) -> TextureInput | None:
    given = attribute_of(shader, name)
    if given is None or UsdShade.Utils.GetType(given.GetName()) != UsdShade.AttributeType.Output:
        return None
    source = UsdShade.Shader(given.GetPrim())
    if source.GetShaderId() != "UsdUVTexture":
        return None
    texture = image_of(source, images)
    if texture is None:
        return None
    uv_set, transform = _uv_set(source)
    return TextureInput(
        texture=texture,
        channels=given.GetName().rpartition(":")[2],
        uv_set=uv_set,
        uv_transform=transform,
        scale=four(value_of(source, "scale", (1, 1, 1, 1))),
        bias=four(value_of(source, "bias", (0, 0, 0, 0))),
        wrap_s=_WRAPS.get(str(value_of(source, "wrapS", "repeat")), "repeat"),
        wrap_t=_WRAPS.get(str(value_of(source, "wrapT", "repeat")), "repeat"),
    )


def _uv_set(shader: UsdShade.Shader) -> tuple[str, UvTransform]:
    """The UV set that a texture reads, and what transforms before it do to it."""
    transform, name = IDENTITY, "st"
    for _ in range(_MOST_TRANSFORMS):
        given = attribute_of(shader, name)
        if not given:
            return "st", transform
        shader = UsdShade.Shader(given.GetPrim())
        if shader.GetShaderId() != "UsdTransform2d":
            break
        (x, y), (u, v) = value_of(shader, "scale", (1, 1)), value_of(shader, "translation", (0, 0))
        own = scaled_turned_moved((float(x), float(y)), float(value_of(shader, "rotation", 0.0)), (float(u), float(v)))
        transform, name = composed(transform, own), "in"
    return str(value_of(shader, "varname", "st")), transform


_COLOR_FIELDS = ("diffuse_color", "emissive_color")
USD_NAMES = {
    "diffuse_color": "diffuseColor",
    "emissive_color": "emissiveColor",
    "metallic": "metallic",
    "roughness": "roughness",
    "opacity": "opacity",
    "opacity_threshold": "opacityThreshold",
    "occlusion": "occlusion",
    "normal": "normal",
    "ior": "ior",
    "clearcoat": "clearcoat",
    "clearcoat_roughness": "clearcoatRoughness",
}


def textures_of(parts: FaceParts) -> dict[str, Texture]:
    """Every texture of a face by name.

    :raises InputError: two different images of one name
    """
    textures: dict[str, Texture] = {}
    for material in parts.materials:
        for one in material.textures:
            if textures.setdefault(one.name, one).data != one.data:
                raise InputError(material.name, f"two different textures named '{one.name}'")
    return textures


def author_texture(material: Usd.Prim, field: str, path: str) -> None:
    """Put another image in place of the texture of a material's input; one of colours is read as it is.

    :param field: of `Material`
    :param path: asset path of the image
    :raises InputError: the input is no texture
    """
    surface, _, _ = UsdShade.Material(material).ComputeSurfaceSource()
    given = attribute_of(surface, USD_NAMES[field]) if surface else None
    shader = UsdShade.Shader(editable(given.GetPrim())) if given else None
    if not shader or shader.GetShaderId() != "UsdUVTexture":
        raise InputError(material.GetPath(), f"no texture of its {USD_NAMES[field]}, expected one")
    put(shader.CreateInput("file", Sdf.ValueTypeNames.Asset).GetAttr(), Sdf.AssetPath(path))
    if field not in _COLOR_FIELDS:
        return
    for name, neutral in (("scale", 1.0), ("bias", 0.0)):
        if shader.GetInput(name):
            put(shader.GetInput(name).GetAttr(), Gf.Vec4f(neutral))


def author_opacity(material: Usd.Prim, opacity: float) -> None:
    """Put one number in place of what a material's opacity was."""
    surface, _, _ = UsdShade.Material(material).ComputeSurfaceSource()
    given = UsdShade.Shader(editable(surface.GetPrim())).CreateInput("opacity", Sdf.ValueTypeNames.Float)
    given.DisconnectSource()
    put(given.GetAttr(), float(opacity))


def author_color_scale(material: Usd.Prim, scale: tuple[float, float, float, float]) -> None:
    """What the texture of a material's colour is multiplied with."""
    surface, _, _ = UsdShade.Material(material).ComputeSurfaceSource()
    given = attribute_of(surface, "diffuseColor")
    if given is None:
        return
    shader = UsdShade.Shader(editable(given.GetPrim()))
    put(shader.CreateInput("scale", Sdf.ValueTypeNames.Float4).GetAttr(), Gf.Vec4f(*scale))


def author_materials(
    stage: Usd.Stage, scope: Sdf.Path, materials: tuple[Material, ...], textures: dict[str, str]
) -> dict[str, UsdShade.Material]:
    """Define materials under `scope`; the material by its name in parts."""
    UsdGeom.Scope.Define(stage, scope)
    names = unique_identifiers(material.name for material in materials)
    default, prims = Material(name=""), {}
    for material, own in zip(materials, names, strict=True):
        path = scope.AppendChild(own)
        prim = UsdShade.Material.Define(stage, path)
        author_name(prim.GetPrim(), material)
        if material.unlit:
            prim.GetPrim().SetCustomDataByKey(tokens.UNLIT, True)
        if any(material.sheen_color):
            prim.GetPrim().SetCustomDataByKey(tokens.SHEEN_COLOR, Gf.Vec3f(*material.sheen_color))
            prim.GetPrim().SetCustomDataByKey(tokens.SHEEN_ROUGHNESS, float(material.sheen_roughness))
        if material.wrinkles is not None:
            _author_wrinkles(prim.GetPrim(), material.wrinkles, textures)
        surface = UsdShade.Shader.Define(stage, path.AppendChild("Surface"))
        surface.CreateIdAttr("UsdPreviewSurface")
        prim.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
        for field, name in USD_NAMES.items():
            value = getattr(material, field)
            if value == getattr(default, field):
                continue  # the shader has the same
            kind = Sdf.ValueTypeNames.Normal3f if field == "normal" else Sdf.ValueTypeNames.Float
            given = surface.CreateInput(name, Sdf.ValueTypeNames.Color3f if field in _COLOR_FIELDS else kind)
            if isinstance(value, TextureInput):
                texture = _author_texture(stage, path.AppendChild(f"{name}_texture"), value, field, textures)
                given.ConnectToSource(texture.ConnectableAPI(), value.channels)
            else:
                given.Set(Gf.Vec3f(*value) if field in _COLOR_FIELDS else float(value))
        prims[material.name] = prim
    return prims


def _author_wrinkles(prim: Usd.Prim, wrinkles: Wrinkles, textures: Mapping[str, str]) -> None:
    """Put wrinkles on a Material prim.

    :param textures: asset path by texture name; names themselves where not given
    :raises InputError: the name of a region that USD can't hold
    """

    def asset(used: TextureInput) -> Sdf.AssetPath:
        return Sdf.AssetPath(textures.get(used.texture.name, used.texture.name))

    apply_schema(prim, tokens.WRINKLES_API)
    for region in wrinkles.regions:
        check_property_name(prim.GetPath(), "wrinkles", region.name, tokens.WRINKLE_API)
        apply_schema(prim, tokens.WRINKLE_API, region.name)
    put_value(prim, tokens.WRINKLES_NORMAL, asset(wrinkles.normal))
    put_value(prim, tokens.WRINKLES_TINT, asset(wrinkles.tint))
    put_value(prim, tokens.WRINKLES_UV_SET, wrinkles.normal.uv_set)
    for region in wrinkles.regions:
        prefix = f"{tokens.WRINKLE_PREFIX}{region.name}:"
        put_value(prim, f"{prefix}mask", asset(region.mask))
        put_value(prim, f"{prefix}channel", region.mask.channels)
        put_value(prim, f"{prefix}shapes", [shape for shape, _ in region.shapes])
        put_value(prim, f"{prefix}gains", [gain for _, gain in region.shapes])


def _author_texture(
    stage: Usd.Stage, path: Sdf.Path, given: TextureInput, field: str, textures: dict[str, str]
) -> UsdShade.Shader:
    reader = UsdShade.Shader.Define(stage, path.GetParentPath().AppendChild(f"{path.name}_uv"))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set(given.uv_set)
    reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    shader = UsdShade.Shader.Define(stage, path)
    shader.CreateIdAttr("UsdUVTexture")
    asset = textures.get(given.texture.name, given.texture.name)
    shader.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(asset))
    shader.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    shader.CreateInput("wrapS", Sdf.ValueTypeNames.Token).Set(given.wrap_s)
    shader.CreateInput("wrapT", Sdf.ValueTypeNames.Token).Set(given.wrap_t)
    shader.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(*given.scale))
    shader.CreateInput("bias", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(*given.bias))
    # numbers are not colours: read as sRGB, a roughness of 0.5 would be 0.21
    space = "sRGB" if field in _COLOR_FIELDS else "raw"
    shader.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set(space)
    kind = Sdf.ValueTypeNames.Float3 if given.channels == "rgb" else Sdf.ValueTypeNames.Float
    shader.CreateOutput(given.channels, kind)
    return shader
