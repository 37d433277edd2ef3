"""Pictures of several materials side by side in one, for meshes that are drawn with one material."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.images import open_image, pixels
from facepipe.geometry.colors import from_srgb, to_srgb
from facepipe.parts import Color, Material, Texture, TextureInput
from facepipe_gltf.images import Pixels, packed_image

_ORM = ("occlusion", "roughness", "metallic")  # red, green, blue of one picture
# what an atlas holds; all else of its materials is the same
PICTURED = ("diffuse_color", "opacity", *_ORM, "normal", "clearcoat")
_GUTTER = 8  # pixels around each picture, so that smaller levels of it don't mix
_LEAST = 64  # pixels a side, of which the gutter takes a quarter
_CHANNEL = {"r": 0, "g": 1, "b": 2, "a": 3}
_FLAT = (0.5, 0.5, 1.0)  # the picture of a normal that is the surface's


class Atlas:
    """Cells of one size, row by row from the top; pictures of each material fill one of them.

    :param materials: at least one, all opaque or none
    :param uv_set: of the mesh, that they all read
    """

    def __init__(self, materials: Sequence[Material], uv_set: str) -> None:
        self._materials, self._uv_set = materials, uv_set
        self._opened: dict[bytes, Pixels] = {}
        self._columns = int(np.ceil(len(materials) ** 0.5))
        self._rows = -(-len(materials) // self._columns)
        sides = [max(self._pixels(used).shape[:2]) for one in materials for used in one.textured.values()]
        # as large as the largest picture, and no cell larger than its share of that
        share = max(max(sides, default=_LEAST) / max(self._columns, self._rows), _LEAST)
        self._size = 1 << int(np.ceil(np.log2(share)))

    def uvs(self, number: int, values: FloatArray) -> FloatArray:
        """(n, 2) UVs, v up, of the material `number`, whose own are 0..1."""
        inset = _GUTTER / self._size
        cell = [number % self._columns, self._rows - 1 - number // self._columns]
        return np.asarray((inset + (1 - 2 * inset) * values + cell) / [self._columns, self._rows])

    def material(self, name: str) -> Material:
        """The material whose pictures are those of all."""
        first = self._materials[0]
        clear = isinstance(first.opacity, TextureInput) or first.opacity < 1.0
        color = self._input(f"{name}_base", [self._base(one, clear=clear) for one in self._materials])
        found = replace(first, name=name, diffuse_color=color)
        if clear:
            found = replace(found, opacity=replace(color, channels="a"))
        constant = {
            field: all(getattr(one, field) == getattr(first, field) for one in self._materials) for field in _ORM
        }
        if not all(constant[field] and not isinstance(getattr(first, field), TextureInput) for field in _ORM):
            packed = self._input(f"{name}_orm", [self._orm(one) for one in self._materials])
            channels: tuple[Literal["r", "g", "b"], ...] = ("r", "g", "b")
            values: dict[str, Any] = {
                field: replace(packed, channels=channel)
                for field, channel in zip(_ORM, channels, strict=True)
                if not constant[field] or isinstance(getattr(first, field), TextureInput)
            }
            found = replace(found, **values)
        coat = first.clearcoat
        if isinstance(coat, TextureInput) or any(one.clearcoat != coat for one in self._materials):
            cells = [np.stack([self._scaled(one.clearcoat)] * 3, axis=-1) for one in self._materials]
            found = replace(found, clearcoat=replace(self._input(f"{name}_coat", cells), channels="r"))
        normal = next((one.normal for one in self._materials if one.normal is not None), None)
        if normal is not None:
            own = self._input(f"{name}_normal", [self._normal(one) for one in self._materials])
            found = replace(found, normal=replace(own, scale=normal.scale, bias=normal.bias))
        return found

    def _input(self, name: str, cells: Sequence[FloatArray]) -> TextureInput:
        """A picture of cells (size, size, channels) of 0..1."""
        whole = np.zeros((self._rows * self._size, self._columns * self._size, cells[0].shape[2]))
        for number, cell in enumerate(cells):
            y, x = number // self._columns * self._size, number % self._columns * self._size
            padded = np.pad(cell, ((_GUTTER, _GUTTER), (_GUTTER, _GUTTER), (0, 0)), mode="edge")
            whole[y : y + self._size, x : x + self._size] = padded
        data = packed_image(np.rint(np.clip(whole, 0, 1) * 255).astype(np.uint8), "png")
        return TextureInput(texture=Texture(name=f"{name.lower()}.png", data=data), uv_set=self._uv_set)

    def _base(self, material: Material, *, clear: bool) -> FloatArray:
        color = material.diffuse_color
        if isinstance(color, TextureInput):
            planes = [self._plane(color, channel) for channel in range(3)]
            scales = [color.scale[0 if color.channels == "rgb" else _CHANNEL[color.channels]]] * 3
            scales = list(color.scale[:3]) if color.channels == "rgb" else scales
            if any(scale != 1.0 for scale in scales):
                planes = [to_srgb(from_srgb(own) * scale) for own, scale in zip(planes, scales, strict=True)]
        else:
            planes = [to_srgb(self._plane(color, channel)) for channel in range(3)]
        if clear:
            planes.append(self._scaled(material.opacity))
        return np.stack(planes, axis=-1)

    def _orm(self, material: Material) -> FloatArray:
        return np.stack([self._scaled(getattr(material, field)) for field in _ORM], axis=-1)

    def _normal(self, material: Material) -> FloatArray:
        normal = material.normal
        inner = self._size - 2 * _GUTTER
        if normal is None:
            return np.broadcast_to(_FLAT, (inner, inner, 3))
        return np.stack([self._plane(normal, channel) for channel in range(3)], axis=-1)

    def _scaled(self, value: float | TextureInput) -> FloatArray:
        """(size, size) of one number or one channel of a picture, with its scale and bias."""
        if not isinstance(value, TextureInput):
            return self._plane(value, 0)
        channel = _CHANNEL.get(value.channels, 0)
        return self._plane(value, 0) * value.scale[channel] + value.bias[channel]

    def _plane(self, value: float | Color | TextureInput, channel: int) -> FloatArray:
        """(size, size) of a channel, 0..1, without the gutter."""
        inner = self._size - 2 * _GUTTER
        if not isinstance(value, TextureInput):
            return np.full((inner, inner), float(np.asarray(value).reshape(-1)[channel]))
        from PIL import Image as Pillow

        number = channel if value.channels == "rgb" else _CHANNEL[value.channels]
        own = Pillow.fromarray(np.ascontiguousarray(self._pixels(value)[..., number]))
        return np.asarray(own.resize((inner, inner), Pillow.Resampling.LANCZOS)) / 255.0

    def _pixels(self, used: TextureInput) -> Pixels:
        texture = used.texture
        if texture.data not in self._opened:
            self._opened[texture.data] = pixels(open_image(texture.image(), texture.name), "RGBA", texture.name)
        return self._opened[texture.data]
