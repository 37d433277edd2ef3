"""Textures from photos, authored on a stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.threads import one_thread
from facepipe.heads.people import STYLES
from facepipe.heads.surfaces import brow_color, kind_of, other_cards
from facepipe.kinds import Watch
from facepipe.parts import PhotoView, Recipe, TextureInput
from facepipe.photo.fit import Photo, read_photo
from facepipe.photo.texture.eyes import eye_colors, eye_whites, recolored
from facepipe.photo.texture.hair_style import nearest_style
from facepipe.photo.texture.report import BakePhotoReport
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes, author_mesh_in_place
from facepipe.stage.materials import author_color_scale, author_opacity
from facepipe.textures.bake import Baked, Baker
from facepipe.textures.brow_cards import brow_cards, hide_brow_cards
from facepipe.textures.hair import HairCards, hair_cards, painted_scalp, scale_of
from facepipe.textures.observed import expose
from facepipe.textures.skin_surface import SkinSurface, skin_of

_BROWS = slice(17, 27)  # landmarks
_LOWER = 0.08  # of the way from the chin to the root of the nose
_LITTLE = 0.1  # share of the face
_SHOWN = 0.3  # mean confidence at brows
_MOVED = 1.0  # cm that hair which went with a fit's neutral may lie beside where it was laid


def author_textures(
    face: Face, photos: Sequence[tuple[PhotoView, Path]], size: int | None, recipe: Recipe, watch: Watch
) -> BakePhotoReport:
    """Bake photos, and author the textures on a face within `Face.deriving`.

    :raises InputError: a photo that can't be read or has another size than it was fitted at, or a face without
        textures or landmarks
    """
    with watch("bake", len(photos) + 2) as bar, one_thread():
        neutral, parts = face.evaluate(pose="set"), face.parts()
        skin = skin_of(parts, neutral, size)
        bar.update()
        cards, exposures, posed = hair_cards(skin, face.meshes, face.materials, neutral), [], []
        for view, path in photos:
            points = _points(face, view)
            exposure = expose(skin, view, _pixels(view, path).pixels, points)
            exposures.append(replace(exposure, eye_whites=eye_whites(parts, exposure)))
            posed.append(points[skin.span])
            bar.update()
        baker, scalp, style = Baker(skin), None, None
        if cards is not None:
            scalp = painted_scalp(skin, baker.template, neutral[cards.span])
            now = _style_now(face, skin, cards)
            style = None if now is None else nearest_style(skin, exposures, posed, scalp, now)
        baked = baker(exposures, scalp, bald=style == "bald")
        bar.update()
    relit = _relit(face, [view.name for view, _ in photos], baked)
    author_changes(face, replace(parts, photos=relit, recipe=recipe))
    files: dict[str, tuple[str, ...]] = {}
    for texture, picture in zip(skin.textures, baked.pictures, strict=True):
        name = f"{Path(texture.source.texture.name).stem}_photo.png"
        face.new_texture(texture.materials, name, _png(picture))
        files[name] = texture.materials
    for eyes in eye_colors(parts, exposures, baked.scales):
        name = f"{Path(eyes.texture.source.texture.name).stem}_photo.png"
        face.new_texture(eyes.materials, name, recolored(eyes.texture, eyes.factor))
        files[name] = eyes.materials
    hidden: tuple[str, ...] = ()
    if _shows_brows(skin, baked.trust):
        hidden = hide_brow_cards(face, skin)
    elif baked.hair is not None:
        _color_brow_cards(face, skin, brow_color(baked.hair, baked.skin))
    if cards is not None and _author_hair(face, skin, cards, baked.hair, style):
        hidden = (*hidden, cards.material.name)
    return replace(_report(photos, baked, files), hidden=hidden, hair_style=style)


def _author_hair(face: Face, skin: SkinSurface, cards: HairCards, color: FloatArray | None, style: str | None) -> bool:
    """Give hair a linear colour (3,) and a style where they are known, within `Face.deriving`; whether it is hidden."""
    (path,) = (path for path, material in face.material_names.items() if material == cards.material.name)
    prim = face.stage.GetPrimAtPath(path)
    if color is not None:
        author_color_scale(prim, scale_of(cards.material, color))
    if style is not None and not STYLES[style][1]:
        author_opacity(prim, 0.0)
        return True
    if style not in (None, _style_now(face, skin, cards)):
        author_mesh_in_place(face, other_cards(cards.mesh, style, skin.mesh))
    return False


def _style_now(face: Face, skin: SkinSurface, cards: HairCards) -> str | None:
    """The style of the built-in head that hair has; None for other hair, or where units or axes are others."""
    if face.up_axis != "Y" or not np.isclose(face.meters_per_unit, 0.01):
        return None
    kind = kind_of(cards.mesh, skin.mesh, _MOVED)
    return kind if kind in STYLES else None


def _pixels(view: PhotoView, path: Path) -> Photo:
    photo = read_photo(path)
    height, width = photo.pixels.shape[:2]
    if (width, height) != (view.width, view.height):
        raise InputError(path, f"is {width} x {height} pixels, expected {view.width} x {view.height} as it was fitted")
    return photo


def _points(face: Face, view: PhotoView) -> FloatArray:
    """(n, 3) world points of all meshes as they are in a photo."""
    if view.animation is None:
        raise InputError(f"{face.where} -> {view.name}", "no pose of the face in the photo, expected one")
    transforms, weights = face.sample(view.animation)
    return face.evaluate(weights, joint_transforms=transforms)


def _relit(face: Face, names: Sequence[str], baked: Baked) -> tuple[PhotoView, ...]:
    """The photos in the light under which the textures look as they do, and materials have their own colours."""
    found = dict(zip(names, zip(baked.scales, baked.lights, strict=True), strict=True))
    return tuple(_in_light(view, *found[view.name]) if view.name in found else view for view in face.photos)


def _in_light(view: PhotoView, scale: FloatArray, light: FloatArray) -> PhotoView:
    if view.key is None:
        return replace(view, light=light, tint={})
    red, green, blue = (np.array(view.key.color) * scale).tolist()
    return replace(view, light=light, key=replace(view.key, color=(red, green, blue)), tint={})


def _shows_brows(skin: SkinSurface, trust: FloatArray) -> bool:
    marks = skin.points[skin.landmarks]
    below = marks[_BROWS] - _LOWER * (marks[27] - marks[8])  # brows lie below their landmarks
    return bool(trust[cKDTree(skin.points).query(below)[1]].mean() >= _SHOWN)


def _color_brow_cards(face: Face, skin: SkinSurface, color: FloatArray) -> None:
    """Give cards that lie on the brows a linear colour (3,), within `Face.deriving`."""
    for prim, material in brow_cards(face, skin).items():
        if isinstance(material.diffuse_color, TextureInput):
            author_color_scale(face.stage.GetPrimAtPath(prim), scale_of(material, color))


def _png(picture: FloatArray) -> bytes:
    from PIL import Image

    stream = BytesIO()
    levels = (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)
    Image.fromarray(levels).save(stream, format="PNG", compress_level=6)
    return stream.getvalue()


def _report(
    photos: Sequence[tuple[PhotoView, Path]], baked: Baked, files: Mapping[str, tuple[str, ...]]
) -> BakePhotoReport:
    shares = {path.name: share for (_, path), share in zip(photos, baked.shares, strict=True)}
    little = tuple(f"{name}: shows {share:.0%} of the face" for name, share in shares.items() if share < _LITTLE)
    report = BakePhotoReport(textures=files, photos=shares, seen=baked.seen, warnings=little)
    if baked.hair is None:
        return report
    red, green, blue = baked.hair.round(4).tolist()
    return replace(report, hair=(red, green, blue))
