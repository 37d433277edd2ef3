"""Materials that MaterialX nodes make, authored as UsdShade: the surfaces that it defines, and the nodes of images.

Sources: the MaterialX specification (standard nodes, place2d, normalmap), its definitions of standard_surface,
open_pbr_surface, gltf_pbr and UsdPreviewSurface, and the OpenPBR Surface specification.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal, NamedTuple

from pxr import Usd, UsdShade

from facepipe.parts import Color, Material, TextureInput, UvTransform
from facepipe.stage.guard import reads_prim
from facepipe.stage.prims import label
from facepipe.stage.shaders import Images, attribute_of, image_of, value_of
from facepipe.stage.uv_transforms import IDENTITY, composed

_ADDRESS: Mapping[str, Literal["repeat", "mirror", "clamp"]] = {
    "periodic": "repeat",
    "mirror": "mirror",
    "clamp": "clamp",
    "constant": "clamp",
}
_IMAGES = ("image", "tiledimage", "UsdUVTexture", "gltf_colorimage", "gltf_image", "gltf_normalmap")
_PASSED = ("normalmap", "convert", "separate2", "separate3", "separate4", "dot")
_TYPES = re.compile(r"(_(float|color[34]|vector[234]|integer|boolean))+[A-Z]*$")
_MOST_NODES = 32  # one after another: a circle has no end
_NO_CHANGE = (1.0, 1.0, 1.0, 1.0)


class _Surface(NamedTuple):
    """Inputs of a surface shader: their names, and what they are where they are not authored."""

    color: tuple[str, Color]
    weight: str  # a number that the colour is multiplied with; none: ""
    numbers: Mapping[str, tuple[str, float]]  # field of `Material` -> input, default
    normal: str
    emission: tuple[str, str]  # colour, and a number that it is multiplied with; 0 where that is not authored


_KINDS = {
    "ND_standard_surface_surfaceshader": _Surface(
        ("base_color", (0.8, 0.8, 0.8)),
        "base",
        {
            "metallic": ("metalness", 0.0),
            "roughness": ("specular_roughness", 0.2),
            "opacity": ("opacity", 1.0),
            "ior": ("specular_IOR", 1.5),
            "clearcoat": ("coat", 0.0),
            "clearcoat_roughness": ("coat_roughness", 0.1),
        },
        "normal",
        ("emission_color", "emission"),
    ),
    "ND_open_pbr_surface_surfaceshader": _Surface(
        ("base_color", (0.8, 0.8, 0.8)),
        "base_weight",
        {
            "metallic": ("base_metalness", 0.0),
            "roughness": ("specular_roughness", 0.3),
            "opacity": ("geometry_opacity", 1.0),
            "ior": ("specular_ior", 1.5),
            "clearcoat": ("coat_weight", 0.0),
            "clearcoat_roughness": ("coat_roughness", 0.0),
        },
        "geometry_normal",
        ("", ""),  # in nits, which a face without exposure has none of
    ),
    "ND_gltf_pbr_surfaceshader": _Surface(
        ("base_color", (1.0, 1.0, 1.0)),
        "",
        {
            "metallic": ("metallic", 1.0),
            "roughness": ("roughness", 1.0),
            "occlusion": ("occlusion", 1.0),
            "opacity": ("alpha", 1.0),
            "ior": ("ior", 1.5),
            "clearcoat": ("clearcoat", 0.0),
            "clearcoat_roughness": ("clearcoat_roughness", 0.0),
        },
        "normal",
        ("emissive", "emissive_strength"),
    ),
    "ND_UsdPreviewSurface_surfaceshader": _Surface(
        ("diffuseColor", (0.18, 0.18, 0.18)),
        "",
        {
            "metallic": ("metallic", 0.0),
            "roughness": ("roughness", 0.5),
            "opacity": ("opacity", 1.0),
            "opacity_threshold": ("opacityThreshold", 0.0),
            "occlusion": ("occlusion", 1.0),
            "ior": ("ior", 1.5),
            "clearcoat": ("clearcoat", 0.0),
            "clearcoat_roughness": ("clearcoatRoughness", 0.01),
        },
        "normal",
        ("emissiveColor", ""),
    ),
}
_UNTEXTURED = ("ior", "opacity_threshold")


def surface_of(prim: Usd.Prim) -> tuple[UsdShade.Shader, _Surface] | None:
    """The surface shader of a Material prim that MaterialX defines, and its inputs; None where it has none of these."""
    shader, _, _ = UsdShade.Material(prim).ComputeSurfaceSource("mtlx")
    kind = _KINDS.get(str(shader.GetShaderId())) if shader else None
    return None if kind is None else (shader, kind)


def read_materialx(prim: Usd.Prim, name: str, images: Images) -> Material | None:
    """A Material prim whose surface MaterialX defines; None where it has no such.

    :param images: as of `read_material`
    :raises InputError: a texture that is missing or no image
    """
    found = surface_of(prim)
    if found is None:
        return None
    shader, kind = found
    color = _color(shader, *kind.color, images)
    weight = float(value_of(shader, kind.weight, 1.0)) if kind.weight else 1.0
    if weight != 1.0:
        color = _times(color, (weight,) * 4)
    numbers: dict[str, Any] = {}
    for field, (own, otherwise) in kind.numbers.items():
        used = None if field in _UNTEXTURED else _textured(shader, own, "r", images)
        value = value_of(shader, own, otherwise)
        plain = float(value) if isinstance(value, int | float) else sum(map(float, value)) / len(value)
        numbers[field] = plain if used is None else used
    lit, gain = kind.emission
    glow = float(value_of(shader, gain, 0.0 if gain == "emission" else 1.0)) if gain else 1.0
    emissive: Color | TextureInput = (0.0, 0.0, 0.0)
    if lit and glow > 0:
        unsaid = (1.0, 1.0, 1.0) if gain == "emission" else (0.0, 0.0, 0.0)
        emissive = _times(_color(shader, lit, unsaid, images), (glow,) * 4)
    normal = _textured(shader, kind.normal, "rgb", images)
    if normal is not None:  # from 0..1 to -1..1
        normal = replace(normal, scale=(2.0, 2.0, 2.0, 1.0), bias=(-1.0, -1.0, -1.0, 0.0))
    return Material(
        name=name,
        diffuse_color=color,
        emissive_color=emissive,
        normal=normal,
        label=label(prim, name),
        **numbers,
    )


@reads_prim
def unread_inputs(prim: Usd.Prim) -> list[str]:
    """Authored inputs of its surface that `read_materialx` has no use for, or whose nodes it doesn't know."""
    found = surface_of(prim)
    if found is None:
        return []
    shader, kind = found
    read = {kind.color[0], kind.weight, kind.normal, *kind.emission, *(own for own, _ in kind.numbers.values())}
    lost = {given.GetBaseName() for given in shader.GetInputs() if given.GetAttr().HasAuthoredValue()} - read
    fed = [given.GetBaseName() for given in shader.GetInputs() if _source(shader, given.GetBaseName()) is not None]
    return [*sorted(lost), *(f"{name} (of nodes that mix)" for name in fed if _image_node(shader, name) is None)]


def _color(shader: UsdShade.Shader, name: str, otherwise: Color, images: Images) -> Color | TextureInput:
    used = _textured(shader, name, "rgb", images)
    if used is not None:
        return used
    red, green, blue = value_of(shader, name, otherwise)
    return (float(red), float(green), float(blue))


def _times(color: Color | TextureInput, by: tuple[float, float, float, float]) -> Color | TextureInput:
    if isinstance(color, TextureInput):
        red, green, blue, alpha = (a * b for a, b in zip(color.scale, by, strict=True))
        return replace(color, scale=(red, green, blue, alpha))
    return (color[0] * by[0], color[1] * by[1], color[2] * by[2])


def _source(shader: UsdShade.Shader, name: str) -> tuple[UsdShade.Shader, str] | None:
    """The node that an input takes its value from, and the node's output."""
    given = attribute_of(shader, name)
    if given is None or UsdShade.Utils.GetType(given.GetName()) != UsdShade.AttributeType.Output:
        return None
    return UsdShade.Shader(given.GetPrim()), given.GetName().rpartition(":")[2]


def _node(shader: UsdShade.Shader) -> str:
    """The node of a definition: image of ND_image_color3."""
    return _TYPES.sub("", str(shader.GetShaderId() or "").removeprefix("ND_"))


def _image_node(shader: UsdShade.Shader, name: str) -> tuple[UsdShade.Shader, str, tuple[float, ...]] | None:
    """The node of the image that an input shows, the channel that is taken of it ("" for its own), and its factor."""
    channel, factor = "", tuple[float, ...](_NO_CHANGE)
    for _ in range(_MOST_NODES):
        found = _source(shader, name)
        if found is None:
            return None
        shader, output = found
        node = _node(shader)
        if node in _IMAGES or str(shader.GetShaderId()).startswith("ND_UsdUVTexture"):
            return shader, channel or (output[-1] if output[-1:] in tuple("rgba") and len(output) <= 4 else ""), factor
        if node.startswith("separate"):
            channel = {"x": "r", "y": "g", "z": "b", "w": "a"}.get(output[-1], output[-1])
        if node == "extract":
            channel, name = "rgba"[min(max(int(value_of(shader, "index", 0)), 0), 3)], "in"
        elif node == "multiply":
            plain = next((one for one in ("in1", "in2") if _source(shader, one) is None), None)
            if plain is None:
                return None
            value = value_of(shader, plain, 1.0)
            own = (float(value),) * 4 if isinstance(value, int | float) else (*map(float, value), 1.0, 1.0)[:4]
            factor = tuple(a * b for a, b in zip(factor, own, strict=True))
            name = "in2" if plain == "in1" else "in1"
        elif node in _PASSED:
            name = "in"
        else:
            return None
    return None


def _textured(shader: UsdShade.Shader, name: str, channels: Literal["rgb", "r"], images: Images) -> TextureInput | None:
    found = _image_node(shader, name)
    texture = None if found is None else image_of(found[0], images)
    if found is None or texture is None:
        return None
    node, channel, (red, green, blue, alpha) = found
    uv_set, transform = _uvs(node)
    return TextureInput(
        texture=texture,
        channels="rgb" if channels == "rgb" else channel if channel in ("r", "g", "b", "a") else "r",  # type: ignore[arg-type]
        uv_set=uv_set,
        uv_transform=transform,
        scale=(red, green, blue, alpha),
        wrap_s=_ADDRESS.get(str(value_of(node, "uaddressmode", "periodic")), "repeat"),
        wrap_t=_ADDRESS.get(str(value_of(node, "vaddressmode", "periodic")), "repeat"),
    )


def _uvs(node: UsdShade.Shader) -> tuple[str, UvTransform]:
    """The UV set that an image is read at, and what nodes before it do to it."""
    transform = IDENTITY
    if _node(node) == "tiledimage":
        (x, y), (u, v) = value_of(node, "uvtiling", (1, 1)), value_of(node, "uvoffset", (0, 0))
        transform = (float(x), 0.0, -float(u), 0.0, float(y), -float(v))
    name = "st" if node.GetInput("st") else "texcoord"
    for _ in range(_MOST_NODES):
        found = _source(node, name)
        if found is None:
            break
        node, name = found[0], "texcoord"
        if _node(node) != "place2d":
            break
        transform = composed(transform, _placed(node))
    return str(value_of(node, "geomprop", None) or value_of(node, "varname", "st")), transform


def _placed(node: UsdShade.Shader) -> UvTransform:
    """``R(-rotate) ((uv - pivot) / scale) - offset + pivot``: place2d in its order of operations 0, scale first."""
    (p, q), (x, y) = value_of(node, "pivot", (0, 0)), value_of(node, "scale", (1, 1))
    (u, v), degrees = value_of(node, "offset", (0, 0)), float(value_of(node, "rotate", 0.0))
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    wide, high = (1.0 / float(one) if one else 1.0 for one in (x, y))
    about = (1.0, 0.0, -float(p), 0.0, 1.0, -float(q))
    turned = (cosine * wide, sine * high, float(p) - float(u), -sine * wide, cosine * high, float(q) - float(v))
    return composed(turned, about)
