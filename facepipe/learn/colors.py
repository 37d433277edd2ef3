"""The colours of a face's materials at the pixels that show them; bilinear lookups in textures, with gradients."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from facepipe.core.images import open_image, pixels
from facepipe.geometry.colors import from_srgb
from facepipe.learn.rasterise import Raster, interpolate, take
from facepipe.learn.surfaces import Surfaces
from facepipe.parts import TextureInput

Wrap = Literal["repeat", "mirror", "clamp"]


def bilinear(texels: Tensor, uv: Tensor, wrap_s: Wrap = "repeat", wrap_t: Wrap = "repeat") -> Tensor:
    """(m, c) values of texels (h, w, c), top row first, at UVs (m, 2) with v up.

    The same lookup as the pictures of `facepipe.pictures`: texel centres are half a texel inside.
    """
    height, width, channels = texels.shape
    x = uv[:, 0] * width - 0.5
    y = (1 - uv[:, 1]) * height - 0.5
    left, above = x.detach().floor(), y.detach().floor()
    fx, fy = (x - left)[:, None], (y - above)[:, None]
    columns = [_wrap(left.long() + step, width, wrap_s) for step in (0, 1)]
    rows = [_wrap(above.long() + step, height, wrap_t) * width for step in (0, 1)]
    flat = texels.reshape(-1, channels)
    upper, lower = (
        torch.lerp(take(flat, row + columns[0]), take(flat, row + columns[1]), fx.expand(-1, channels)) for row in rows
    )
    return torch.lerp(upper, lower, fy.expand(-1, channels))


def _wrap(index: Tensor, size: int, mode: Wrap) -> Tensor:
    if mode == "clamp":
        return index.clamp(0, size - 1)
    if mode == "mirror":
        folded = index % (2 * size)
        return torch.where(folded < size, folded, 2 * size - 1 - folded)
    return index % size


class SurfaceColors:
    """Linear diffuse colours: one a material, or a texture."""

    def __init__(self, surfaces: Surfaces, largest: int, dtype: torch.dtype, device: torch.device | str) -> None:
        """
        :param largest: pixels a side beyond which textures are halved
        :raises InputError: a texture that can't be read as an image
        """
        self.names = surfaces.names
        self.colors = torch.as_tensor(surfaces.colors, dtype=dtype, device=device)
        self.textures: dict[str, Tensor] = {}
        self._inputs = {
            i: source for i, source in enumerate(surfaces.textures) if source and (surfaces.materials == i).any()
        }
        for i, source in self._inputs.items():
            self.textures[self.names[i]] = torch.as_tensor(linear_texels(source, largest), dtype=dtype, device=device)
        self.materials = torch.as_tensor(surfaces.materials, device=device)
        self._uv = torch.as_tensor(surfaces.uv, dtype=dtype, device=device)
        self._corners = torch.as_tensor(surfaces.uv_corners, device=device)

    def __call__(
        self, raster: Raster, weights: Tensor, tint: Tensor | None = None, textures: Mapping[str, Tensor] | None = None
    ) -> Tensor:
        """(p, 3) colours at the covered pixels.

        :param weights: (p, 3) barycentric coordinates
        :param tint: (m, 3) what the colour of each material is multiplied by
        :param textures: (h, w, 3) linear texels instead of a material's own, by its name
        """
        material = self.materials[raster.triangles]
        result = take(self.colors if tint is None else self.colors * tint, material)
        images = {**self.textures, **(textures or {})}
        for number, source in self._inputs.items():
            pixels = (material == number).nonzero()[:, 0]
            if not len(pixels):
                continue
            part = Raster(
                height=raster.height,
                width=raster.width,
                pixels=raster.pixels[pixels],
                triangles=raster.triangles[pixels],
                nearness=raster.nearness,
            )
            uv = interpolate(self._uv, self._corners, part, weights.index_select(0, pixels))
            texels = bilinear(images[self.names[number]], uv, source.wrap_s, source.wrap_t)
            factor = torch.ones_like(result).index_copy(0, pixels, texels)
            result = result * factor
        return result


def linear_texels(source: TextureInput, largest: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """(h, w, 3) linear colours of a texture's input, top row first: 8-bit sRGB decoded (IEC 61966-2-1).

    :raises InputError: the bytes are not an image that can be read
    """
    where = f"texture {source.texture.name}"
    image = open_image(source.texture.image(), where)
    texels = pixels(image, "RGB", where, max(1, max(image.size) // max(largest, 1)))
    table = from_srgb(np.arange(256) / 255.0)
    return np.asarray((table[texels] * source.scale[:3] + source.bias[:3]).astype(np.float32))
