"""Textures of the skin from photos: observed, evened, merged by confidence, and filled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import Float32Array, FloatArray, IntArray
from facepipe.core.images import open_image
from facepipe.geometry.colors import from_srgb, to_srgb
from facepipe.processors.photo_texture.evened import balance, inner, is_skin, missed_light, one_sided, smoother
from facepipe.processors.photo_texture.filled import filled
from facepipe.processors.photo_texture.observed import DARKEST, GREY, Exposure, Observed, observe
from facepipe.processors.photo_texture.skin_surface import SkinSurface, SkinTexture


@dataclass(frozen=True, kw_only=True)
class Baked:
    """Textures of the skin."""

    pictures: tuple[FloatArray, ...]  # of each (size, size, 3) sRGB 0..1
    scales: tuple[FloatArray, ...]  # (3,) of each photo's light
    trusts: tuple[FloatArray, ...]  # (n,) confidence of each photo at points
    seen: FloatArray  # (n,) of all


def template_texels(texture: SkinTexture) -> FloatArray:
    """(size, size, 3) linear colours of a texture as it is, of its input's scale and bias."""
    from PIL import Image

    source, size = texture.source, texture.texels.size
    picture = open_image(source.texture.image(), f"texture {source.texture.name}").convert("RGB")
    picture = picture.resize((size, size), Image.Resampling.BICUBIC)
    linear = from_srgb(np.asarray(picture, np.float32) / np.float32(255))
    return np.clip(linear * np.array(source.scale[:3]) + np.array(source.bias[:3]), 0, 1).astype(np.float32)


def bake(skin: SkinSurface, photos: Sequence[Exposure]) -> Baked:
    templates = [template_texels(texture) for texture in skin.textures]
    flats = [
        np.maximum(template.reshape(-1, 3)[texture.texels.at], DARKEST)
        for template, texture in zip(templates, skin.textures, strict=True)
    ]
    totals = sum(tx.texels.summed(np.ones((len(tx.texels.at), 1)), len(skin.points))[:, 0] for tx in skin.textures)
    scales, seen, all_colors, all_trust = [], [], [], []
    for photo in photos:
        scale = balance(photo)
        observed = [observe(skin, photo, i, flat, scale) for i, flat in enumerate(flats)]
        colors, trust = at_points(skin, observed, totals)
        light = missed_light(skin, photo, colors, trust)
        colors = colors - light
        trust = trust * is_skin(skin, colors, trust)
        side = one_sided(skin, colors, trust)
        colors = colors - side
        scales.append(scale)
        seen.append([evened(skin, i, o, light + side, trust) for i, o in enumerate(observed)])
        all_colors.append(colors)
        all_trust.append(trust)
    colors, trust = at_points(skin, seen[0], totals)
    whole = filled(skin, colors, trust)
    pictures = []
    for number, (texture, template, flat) in enumerate(zip(skin.textures, templates, flats, strict=True)):
        texels, one = texture.texels, seen[0][number]
        ratio = texels.carried(whole)
        fine = one.ratio - texels.taken(one.place).carried(colors)
        ratio[one.place] += one.trust[:, None] * fine
        linear = np.exp(ratio) * flat
        pictures.append(to_srgb(texels.picture(linear, template)))
    return Baked(pictures=tuple(pictures), scales=tuple(scales), trusts=tuple(all_trust), seen=trust)


def at_points(skin: SkinSurface, observed: Sequence[Observed], totals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 3) mean colours at points and (n,) confidence."""
    sums = np.zeros((len(skin.points), 4))
    for texture, one in zip(skin.textures, observed, strict=True):
        values = np.column_stack([one.ratio * one.trust[:, None], one.trust])
        sums += texture.texels.taken(one.place).summed(values, len(skin.points))
    return sums[:, :3] / np.maximum(sums[:, 3:], 1e-9), sums[:, 3] / np.maximum(totals, 1e-9)


def evened(skin: SkinSurface, number: int, one: Observed, light: FloatArray, trust: FloatArray) -> Observed:
    part = skin.textures[number].texels.taken(one.place)
    mask = part.carried((trust > 0.02)[:, None] * 1.0)[:, 0]
    kept = np.minimum(one.trust, part.carried(trust[:, None])[:, 0] * 1.5) * (mask > 0)
    return Observed(place=one.place, ratio=one.ratio - part.carried(light), trust=kept)
