"""The people that `facepipe fit-photo` and `bake-photo` make of portraits, and the pictures of them that are judged."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from likeness_portraits import Portrait
from narrow_face import NARROW
from PIL import Image

import facepipe
from facepipe.core.arrays import FloatArray
from facepipe.geometry.colors import to_srgb
from facepipe.geometry.rasterise import barycentrics, rasterise, screen_triangles
from facepipe.geometry.similarity import fit_similarity
from facepipe.heads import make
from facepipe.heads.surfaces import cards, kind_of
from facepipe.parts import FaceParts, PhotoView
from facepipe.photo.fit import read_photo
from facepipe.photo.pictures import photo_render
from facepipe.pictures import PictureOptions
from facepipe.pictures.face_picture import pictures
from facepipe.stage import Face
from facepipe.textures.evened import inner
from facepipe.textures.seen_skin import to_camera, to_pixels
from facepipe.textures.skin_surface import skin_of

TEXTURED, UNTEXTURED, MEAN_TEXTURED, MEAN = "textured", "untextured", "mean head, textured", "mean head"
LOOKS = (TEXTURED, UNTEXTURED, MEAN_TEXTURED, MEAN)
CAMERA, MASKED, PHOTO = "camera", "camera, masked", "photo, masked"
YAWS = {"front": 0.0, "yaw -30": -30.0, "yaw +30": 30.0}
SIZE = 512  # pixels a side in studio light
_GREY = 0.5  # sRGB, around a face
_SAMPLES = 2
_TEXELS = 64  # hardly any are wanted where the mask is made


@dataclass(frozen=True, kw_only=True)
class Made:
    """A person made of a portrait."""

    portrait: Portrait
    photo: Path  # upright, sRGB
    pictures: Mapping[tuple[str, str], Path]  # by line of the table and look
    narrow: FloatArray  # (m, 3) millimetres, the neutral
    seconds: Mapping[str, float]  # of processor time


def made(portrait: Portrait, head: Path, folder: Path, size: int) -> Made:
    """Fit, bake and picture a person; a fit that is in the folder stays.

    :param head: stage of the average head
    :param size: texels a side of what is baked
    """
    fit, baked, seconds = folder / f"{portrait.name}.usda", folder / f"{portrait.name}.baked.usda", {}
    if not fit.is_file():
        start = time.process_time()
        facepipe.fit_photo(head, photos=[portrait.path], out=fit)
        seconds["fit-photo"] = time.process_time() - start
    start = time.process_time()
    facepipe.bake_photo(fit, photos=[portrait.path], out=baked, size=size, overwrite=True)
    seconds["bake-photo"] = time.process_time() - start
    photo = folder / f"{portrait.name}.photo.png"
    pixels = read_photo(portrait.path).pixels
    _image(pixels).save(photo)
    neutral, mean = facepipe.open(fit).evaluate(pose="set"), facepipe.open(head).evaluate()
    shown: dict[tuple[str, str], Path] = {}
    for look, stage in zip(LOOKS, (baked, fit, baked, fit), strict=True):
        person = PicturedPerson(facepipe.open(stage), mean if look in (MEAN_TEXTURED, MEAN) else None)
        for line, picture in person.pictures(pixels):
            path = folder / f"{portrait.name}.{look}.{line}.png".replace(", ", "-").replace(" ", "-")
            picture.save(path)
            shown[line, look] = path
    mm = 1000 * facepipe.open(fit).meters_per_unit
    return Made(portrait=portrait, photo=photo, pictures=shown, narrow=neutral[:NARROW] * mm, seconds=seconds)


def together(portraits: Sequence[Portrait], head: Path, folder: Path, size: int) -> Path:
    """The front picture of a person made of several portraits at once; a fit that is in the folder stays."""
    name, photos = "-".join(portrait.name for portrait in portraits), [portrait.path for portrait in portraits]
    fit, baked, front = (folder / f"{name}.{end}" for end in ("usda", "baked.usda", "front.png"))
    if not fit.is_file():
        facepipe.fit_photo(head, photos=photos, out=fit)
    facepipe.bake_photo(fit, photos=photos, out=baked, size=size, overwrite=True)
    face = facepipe.open(baked)
    pictures(face.parts(), face.evaluate(pose="set"), [PictureOptions(size=SIZE, samples=_SAMPLES)])[0].save(front)
    return front


class PicturedPerson:
    """A face on a stage, or instead of it another head with its skin and expression."""

    def __init__(self, face: Face, head: FloatArray | None) -> None:
        """:param head: (m, 3) points of that head"""
        self.parts, self.view = face.parts(), face.photos[0]
        assert self.view.animation is not None
        self.posed = face.evaluate(pose=self.view.animation)
        self.neutral = neutral = face.evaluate(pose="set")
        if head is not None:
            placed = fit_similarity(head[:NARROW], neutral[:NARROW]).apply(head)
            self.neutral = _with_hair(self.parts, placed)
            self.posed = self.neutral + self.posed - neutral

    def pictures(self, photo: FloatArray) -> Iterator[tuple[str, Image.Image]]:
        """By line of the table; the masked photo too."""
        image = photo_render(_bald(self.parts), self.view, self.posed)
        cover = image[..., 3:].clip(0, 1)
        render = to_srgb((image[..., :3] + (1 - cover) * _GREY**2.2).clip(0, 1))
        mask = _face_mask(self.parts, self.view, self.neutral, self.posed)
        yield CAMERA, _image(render)
        yield MASKED, _masked(render, mask)
        yield PHOTO, _masked(photo, mask)
        options = [PictureOptions(size=SIZE, samples=_SAMPLES, view=(np.radians(yaw), 0.0)) for yaw in YAWS.values()]
        yield from zip(YAWS, pictures(self.parts, self.neutral, options), strict=True)


def _with_hair(parts: FaceParts, points: FloatArray) -> FloatArray:
    """(n, 3) points (m, 3) of another head, with the hair of a face, the last of its meshes, in place of its own."""
    head, *_, hair = parts.meshes
    style = kind_of(hair, head, 1.0)
    assert style is not None
    held, first = cards(style), sum(len(mesh.points) for mesh in parts.meshes[:-1])
    return np.concatenate([points[:first], held.carry(points[: len(head.points)]) + held.offsets])


def _bald(parts: FaceParts) -> FaceParts:
    """The face without its hair, whose style is no person's."""
    materials = (replace(one, opacity=0.0) if one.name == "Hair" else one for one in parts.materials)
    return replace(parts, materials=tuple(materials))


def _face_mask(parts: FaceParts, view: PhotoView, neutral: FloatArray, posed: FloatArray) -> FloatArray:
    """(h, w) 1 where a photo shows the face, 0 off it and on hair, ears and neck, with a soft border."""
    skin = skin_of(parts, neutral, _TEXELS)
    values = np.ones(len(posed))
    values[skin.span] = inner(skin)
    pixels, depth = to_pixels(view, to_camera(view, posed))
    screen = np.column_stack([pixels * depth[:, None], np.ones(len(posed)), depth])
    raster = rasterise(screen_triangles(screen, skin.opaque), view.width, view.height)
    row, column = np.nonzero(raster.key)
    chosen = raster.triangle[row, column]
    shares = barycentrics(screen, skin.opaque, chosen, column + 0.5, row + 0.5)
    mask = np.zeros((view.height, view.width))
    mask[row, column] = np.clip(2 * (values[skin.opaque[chosen]] * shares).sum(axis=1), 0, 1)
    return mask


def _masked(pixels: FloatArray, mask: FloatArray) -> Image.Image:
    """Pixels (h, w, 3) under a mask (h, w), of a photo that may be larger: that is reduced."""
    size = min(pixels.shape[1], mask.shape[1]), min(pixels.shape[0], mask.shape[0])
    levels = _image(pixels).resize(size, Image.Resampling.LANCZOS)
    share = Image.fromarray((mask * 255 + 0.5).astype(np.uint8)).resize(size, Image.Resampling.BILINEAR)
    grey = Image.new("RGB", size, (round(255 * _GREY),) * 3)
    return Image.composite(levels, grey, share)


def _image(pixels: FloatArray) -> Image.Image:
    return Image.fromarray((np.clip(pixels, 0, 1) * 255 + 0.5).astype(np.uint8))


def other(seed: int, folder: Path, size: int) -> dict[str, Path]:
    """Front pictures of a person drawn from the head in the box, with that person's looks and with the average ones."""
    person, average = make(seed, textures=size), _average(size)
    plain = {material.name: material for material in average.materials}
    skinned = replace(person, materials=tuple(plain.get(each.name, each) for each in person.materials))
    shown = {}
    for look, parts in ((TEXTURED, person), (UNTEXTURED, skinned)):
        shown[look] = folder / f"seed{seed}.{look}.front.png"
        pictures(parts, None, [PictureOptions(size=SIZE, samples=_SAMPLES)])[0].save(shown[look])
    return shown


@cache
def _average(size: int) -> FaceParts:
    return make(0, textures=size)
