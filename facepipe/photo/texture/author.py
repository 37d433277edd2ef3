"""Textures from photos, authored on a stage: of eyes, hair and skin; then the pictures and page of their report."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import zoom
from scipy.spatial import cKDTree

from facepipe.core.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from facepipe.core.atomic import write_bytes
from facepipe.core.errors import InputError
from facepipe.core.images import open_image
from facepipe.core.markup import heading, joined, page, tag
from facepipe.core.reports import Report, Watch, not_in_json
from facepipe.core.threads import one_thread
from facepipe.geometry.colors import from_srgb, to_srgb
from facepipe.geometry.polygons import triangulate
from facepipe.geometry.rasterise import rasterise, screen_triangles
from facepipe.heads.people import STYLES
from facepipe.heads.surfaces import brow_color, card_triangles, cards, kind_of, other_cards, picture_of
from facepipe.parts import FaceParts, PhotoView, Recipe, TextureInput
from facepipe.photo.fit import read_photo
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes, author_mesh_in_place
from facepipe.stage.materials import author_color_scale, author_opacity
from facepipe.textures.bake import Baked, Baker
from facepipe.textures.hair import HairCards, hair_cards, painted_scalp, scale_of
from facepipe.textures.seen_skin import DARKEST, GREY, Exposure, expose, sampled, to_camera, to_pixels
from facepipe.textures.skin_surface import (
    SCHEME,
    SkinSurface,
    SkinTexture,
    brow_cards,
    hide_brow_cards,
    names_of,
    of_faces,
    skin_of,
    template_texels,
    textures_of,
)

PUPILS = "pupils"
_EYE_TEXELS = 96  # a side of the picture as it is compared
_FRONT = 0.012  # of the eyes' distance: a point so far behind the nearest surface is hidden
_PUPIL = 0.3  # of the iris' median brightness: what is darker is the pupil
_FEWEST, _SMALLEST = 60, 4.0  # texels, and pixels across that an iris is seen by
_IRIS_SHARE, _WHITE_SHARE = (0.0, 0.5), (0.3, 0.9)  # quantiles of brightness: what is brighter mirrors lamps
_IRIS_LIMITS, _WHITE_LIMITS = (0.2, 4.0), (0.5, 1.0)  # factors
_WHITES = 0.5, 0.9  # quantiles of brightness between which whites of eyes are
_EYES = 24  # pixels between the eyes, at which hair is compared
_SCALP = 0.5
_HAIR_TEXELS = 32  # a side, of which each covers some strands and the gaps between them
_SHAVED, _UNCOVERED = 0.8, 0.6  # that show face where nothing of hair is: of the scalp's pixels of either, and of all
_LEAST = 0.2  # of all pixels of hair, that the nearest style shares with photos
_BROWS = slice(17, 27)  # landmarks
_LOWER = 0.08  # of the way from the chin to the root of the nose
_LITTLE = 0.1  # share of the face
_SHOWN = 0.3  # mean confidence at brows
_MOVED = 1.0  # cm that hair which went with a fit's neutral may lie beside where it was laid


@dataclass(frozen=True, kw_only=True)
class BakePhotoReport(Report):
    """What was baked."""

    textures: Mapping[str, tuple[str, ...]]  # file -> the materials that show it
    photos: Mapping[str, float]  # file name -> share of the face that it shows
    seen: float  # share of the face that some photo shows
    hidden: tuple[str, ...] = ()  # materials of cards that are transparent now
    hair: tuple[float, float, float] | None = None  # linear colour, where photos show it
    hair_style: str | None = None  # of the built-in head, the nearest to the photos'
    similarities: Mapping[str, float | None] = field(default_factory=dict)  # file name -> of photo and render, cosine
    seconds: float = 0.0
    sheet: BakeSheet = not_in_json()  # where a report or a similarity is asked for


def eye_pictures(
    parts: FaceParts, photos: Sequence[Exposure], scales: Sequence[FloatArray]
) -> list[tuple[SkinTexture, tuple[str, ...], bytes]]:
    """Textures of irises and of whites of eyes, the materials that show them, and their PNGs in photos' colours.

    Without what no photo, whose light has a scale (3,), shows enough of, or what has no picture in common.
    """
    made = []
    for white in (False, True):
        found: list[FloatArray] = [np.zeros((0, 3))]
        textures = _eye_textures(parts, white=white)
        for span, texture in textures:
            for photo, scale in zip(photos, scales, strict=True):
                found.append(_ratios(photo, texture, span.start, photo.light_around(span)) - np.log(scale))
        ratios, names = np.concatenate(found), {texture.source.texture.name for _, texture in textures}
        if len(ratios) < _FEWEST or len(names) > 1:
            continue
        bright = ratios @ GREY
        low, high = np.quantile(bright, _WHITE_SHARE if white else _IRIS_SHARE)
        ratio = np.median(ratios[(bright >= low) & (bright <= high)], axis=0)
        if white:  # lids in their place would redden them
            ratio = np.full(3, ratio @ GREY)
        factor = np.clip(np.exp(ratio), *(_WHITE_LIMITS if white else _IRIS_LIMITS))
        source = textures[0][1].source.texture
        levels = np.asarray(open_image(source.image(), f"texture {source.name}").convert("RGB"))
        linear = from_srgb(np.arange(256, dtype=np.float32)[:, None] / np.float32(255)) * factor
        table = (to_srgb(np.clip(linear, 0, 1)) * 255 + 0.5).astype(np.uint8)  # of 256 levels, not of a million texels
        materials = tuple(dict.fromkeys(name for _, texture in textures for name in texture.materials))
        made.append((textures[0][1], materials, _png(table[levels, np.arange(3)])))
    return made


def eye_whites(parts: FaceParts, photo: Exposure) -> FloatArray | None:
    """(3,) logarithms of how much lighter than in its light a photo shows whites of eyes; None: hardly any."""
    found = [_ratios(photo, texture, span.start) for span, texture in _eye_textures(parts, white=True)]
    ratios = np.concatenate([np.zeros((0, 3)), *found])
    if len(ratios) < _FEWEST:
        return None
    bright = ratios @ GREY  # lids and lashes shade the darker half, lamps' images are few
    low, high = np.quantile(bright, _WHITES)
    return np.asarray(np.median(ratios[(bright >= low) & (bright <= high)], axis=0))


def _eye_textures(parts: FaceParts, *, white: bool) -> list[tuple[slice, SkinTexture]]:
    """Those of eyes' irises, with the span of the eye's points among all.

    An iris is what is next to the middle of its pupil, and lets no light through.

    :param white: the other one of each eye
    """
    textures, first = [], 0
    solid = {material.name for material in parts.materials if material.opacity == 1.0}
    for mesh in parts.meshes:
        span = slice(first, first + len(mesh.points))
        first = span.stop
        if PUPILS not in mesh.landmarks:
            continue
        names, number = names_of(mesh), of_faces(mesh)
        corners, faces = triangulate(mesh.face_vertex_counts)
        middles = mesh.points[mesh.face_vertex_indices[corners]].mean(axis=1)
        off = np.linalg.norm(middles - mesh.points[mesh.landmarks[PUPILS].indices[0]], axis=1)
        off[[names[place] not in solid for place in number[faces]]] = np.inf
        shown = names[number[faces[off.argmin()]]]
        textures += [(span, one) for one in textures_of(parts, mesh, _EYE_TEXELS) if (shown in one.materials) != white][
            :1
        ]
    return textures


def _ratios(photo: Exposure, texture: SkinTexture, first: int, light: FloatArray | None = None) -> FloatArray:
    """(m, 3) logarithms of colours over the template's, of texels of the iris that a photo shows.

    :param first: point of the eye among those of all meshes
    :param light: (3,) there; None: that of each point
    """
    texels, template = texture.texels, template_texels(texture)
    span = slice(first, first + int(texels.corners.max()) + 1)
    places, depth = to_pixels(photo.view, texels.carried(photo.all_points[span]))
    across = np.ptp(places, axis=0).max()
    bright = template @ GREY
    height, width = photo.seen.depth.shape
    column, row = np.clip(places, 0, [width - 1, height - 1]).astype(np.int64).T
    seen = depth <= photo.seen.depth[row, column] + _FRONT * photo.seen.eye_distance
    # Without the pupil: ratios to its black say nothing of the iris's colour.
    seen &= bright > _PUPIL * np.median(bright)
    seen &= ((places > 2) & (places < np.array([width, height]) - 2)).all(axis=1)
    if across < _SMALLEST or not seen.any():
        return np.zeros((0, 3))
    shown = from_srgb(np.clip(sampled(photo.pixels, places[seen], 1.0), 0, 1))
    white = texels.taken(np.flatnonzero(seen)).carried(photo.all_white[span]) if light is None else light
    white = np.maximum(white, DARKEST)
    return np.asarray(np.log(np.maximum(shown, DARKEST) / white) - np.log(np.maximum(template[seen], DARKEST)))


def _png(levels: ByteArray) -> bytes:
    stream = BytesIO()
    # runs alone: of skin, which hardly repeats, 2 to 9 % larger than with compress_level 6, in a quarter of the time
    Image.fromarray(levels).save(stream, format="PNG", compress_type=Image.RLE)
    return stream.getvalue()


def nearest_style(
    skin: SkinSurface, photos: Sequence[Exposure], posed: Sequence[FloatArray], scalp: FloatArray, now: str
) -> str:
    """The style whose outlines share most with the hair in photos; that of now where none shares much.

    Bald is whose scalp shows as face. Outlines do not tell curls: hair stays straight, or curled, as it is.

    :param posed: of each photo (n, 3) world points of the skin
    :param scalp: (n,) how far points of the skin are scalp
    :param now: the style that the face has
    """
    scales = [min(1.0, _EYES / photo.eye_pixels) for photo in photos]  # of small pictures
    hair, face = (
        [
            zoom(
                whole,
                [max(1, round(side * scale)) / side for side in whole.shape],
                order=1,
                mode="nearest",
                grid_mode=True,
            )
            for whole, scale in zip([getattr(photo.seen.mask, kind) for photo in photos], scales, strict=True)
        ]
        for kind in ("hair", "face")
    )

    def drawn(style: str) -> list[BoolArray]:
        views = zip(photos, posed, scales, strict=True)
        return [_drawn(skin, photo, points, scalp > _SCALP, style, scale) for photo, points, scale in views]

    def total(kind: np.ufunc, one: Sequence[FloatArray], other: Sequence[BoolArray]) -> float:
        return float(sum(kind(*pair).sum() for pair in zip(one, other, strict=True)))

    shaved = drawn("stubble")
    bare, haired = (total(np.minimum, kind, shaved) for kind in (face, hair))
    if bare > max(_SHAVED * (bare + haired), _UNCOVERED * sum(map(np.sum, shaved))):
        return "bald"
    alike = {now: _LEAST}
    for style, (painted, picture) in STYLES.items():
        if painted and picture in ("", STYLES[now][1]):
            shown = drawn(style)
            # Intersection over union: by what is shared alone, the largest outline would win.
            share = total(np.minimum, hair, shown) / max(total(np.maximum, hair, shown), 1e-9)
            alike[style] = max(alike.get(style, 0.0), share)
    return max(alike, key=lambda style: alike[style])


@cache
def _dense_triangles(style: str) -> IntArray:
    """(t, 3) of a style's cards, where their picture shows more hair than gaps."""
    grown, picture = cards(style), picture_of(STYLES[style][1])
    small = (
        open_image(picture.image(), picture.name).convert("RGBA").getchannel("A").resize((_HAIR_TEXELS, _HAIR_TEXELS))
    )
    triangles = card_triangles(grown)
    column, row = (grown.uv[triangles].mean(axis=1) * [1, -1] % 1 * _HAIR_TEXELS).astype(int).T
    return np.asarray(triangles[np.asarray(small)[row, column] > 127])


def _drawn(
    skin: SkinSurface, photo: Exposure, points: FloatArray, scalp: BoolArray, style: str, scale: float
) -> BoolArray:
    """(h, w) where a style shows in a small picture."""
    shown, triangles = photo.all_points, skin.opaque
    hair = np.zeros(len(shown), bool)
    hair[skin.span] = scalp & (STYLES[style][0] > 0)
    if STYLES[style][1]:
        grown = cards(style)
        triangles = np.concatenate([triangles, _dense_triangles(style) + len(shown)])
        shown = np.concatenate([shown, to_camera(photo.view, grown.carry(points) + grown.offsets)])
        hair = np.concatenate([hair, np.ones(len(grown.uv), bool)])
    places, depth = to_pixels(photo.view, shown)
    flat = np.column_stack([places * scale * depth[:, None], np.ones(len(depth)), depth])
    height, width = (max(1, round(side * scale)) for side in photo.seen.depth.shape)
    raster = rasterise(screen_triangles(flat, triangles), width, height)
    of_hair = np.asarray(hair[triangles].all(axis=1))
    return np.asarray((raster.key > 0) & of_hair[np.maximum(raster.triangle, 0)])


def author_textures(
    face: Face, photos: Sequence[tuple[PhotoView, Path]], size: int | None, recipe: Recipe, watch: Watch
) -> BakePhotoReport:
    """Bake photos, and author the textures on a face within `Face.deriving`.

    :raises InputError: a photo that can't be read or has another size than it was fitted at, or a face without
        textures or landmarks
    """
    with watch("bake", len(photos) + 2) as bar, one_thread():
        neutral, parts, person = face.evaluate(pose="set"), face.parts(), face.with_identity()
        skin = skin_of(parts, neutral, size)
        bar.update()
        cards, exposures, posed = hair_cards(skin, face.meshes, face.materials, neutral), [], []
        for view, path in photos:
            points, pixels = _seen(person, view, path)
            exposure = expose(skin, view, pixels, points)
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
    lights = {
        view.name: one for (view, _), one in zip(photos, zip(baked.scales, baked.lights, strict=True), strict=True)
    }
    relit = []
    for view in face.photos:
        if view.name in lights:
            scale, light = lights[view.name]
            view = replace(view, light=light, tint={})
            if view.key is not None:
                red, green, blue = (np.array(view.key.color) * scale).tolist()
                view = replace(view, key=replace(view.key, color=(red, green, blue)))
        relit.append(view)
    author_changes(face, replace(parts, photos=tuple(relit), recipe=recipe))
    pictures = [(one, one.materials, _png(level)) for one, level in zip(skin.textures, baked.pictures, strict=True)]
    pictures += eye_pictures(parts, exposures, baked.scales)
    files = {}
    for texture, materials, picture in pictures:
        name = f"{Path(texture.source.texture.name).stem}_photo.png"
        face.new_texture(materials, name, picture)
        files[name] = materials
    shares = {path.name: share for (_, path), share in zip(photos, baked.shares, strict=True)}
    red, green, blue = (0.0, 0.0, 0.0) if baked.hair is None else baked.hair.round(4).tolist()
    return BakePhotoReport(
        textures=files,
        photos=shares,
        seen=baked.seen,
        hidden=_author_cards(face, skin, cards, baked, style),
        hair=None if baked.hair is None else (red, green, blue),
        hair_style=style,
        warnings=tuple(f"{name}: shows {share:.0%} of the face" for name, share in shares.items() if share < _LITTLE),
    )


def _seen(face: Face, view: PhotoView, path: Path) -> tuple[FloatArray, Float32Array]:
    """(n, 3) world points of all meshes as they are in a photo, and its pixels (h, w, 3) sRGB."""
    if view.animation is None:
        raise InputError(f"{face.where} -> {view.name}", "no pose of the face in the photo, expected one")
    transforms, weights = face.sample(view.animation)
    points, pixels = face.evaluate(weights, joint_transforms=transforms), read_photo(path).pixels
    height, width = pixels.shape[:2]
    if (width, height) != (view.width, view.height):
        raise InputError(path, f"is {width} x {height} pixels, expected {view.width} x {view.height} as it was fitted")
    return points, pixels


def _author_cards(
    face: Face, skin: SkinSurface, cards: HairCards | None, baked: Baked, style: str | None
) -> tuple[str, ...]:
    """Brows and hair on cards as photos show them, within `Face.deriving`; materials of cards that are hidden now."""
    hidden: tuple[str, ...] = ()
    marks = skin.points[skin.landmarks]
    below = marks[_BROWS] - _LOWER * (marks[27] - marks[8])  # brows lie below their landmarks
    if bool(baked.trust[cKDTree(skin.points).query(below)[1]].mean() >= _SHOWN):
        hidden = hide_brow_cards(face, skin)
    elif baked.hair is not None:
        color = brow_color(baked.hair, baked.skin)
        for path, material in brow_cards(face, skin).items():
            if isinstance(material.diffuse_color, TextureInput):
                author_color_scale(face.stage.GetPrimAtPath(path), scale_of(material, color))
    if cards is None:
        return hidden
    (hair,) = (path for path, material in face.material_names.items() if material == cards.material.name)
    prim = face.stage.GetPrimAtPath(hair)
    if baked.hair is not None:
        author_color_scale(prim, scale_of(cards.material, baked.hair))
    if style is not None and not STYLES[style][1]:
        author_opacity(prim, 0.0)
        return (*hidden, cards.material.name)
    if style not in (None, _style_now(face, skin, cards)):
        author_mesh_in_place(face, other_cards(cards.mesh, style, skin.mesh))
    return hidden


def _style_now(face: Face, skin: SkinSurface, cards: HairCards) -> str | None:
    """The style of the built-in head that hair has; None for other hair, or where units or axes are others."""
    if face.up_axis != "Y" or not np.isclose(face.meters_per_unit, 0.01):
        return None
    kind = kind_of(cards.mesh, skin.mesh, _MOVED)
    return kind if kind in STYLES else None


@dataclass(frozen=True, kw_only=True)
class ShownPhoto:
    """A photo, and the textured face as it shows it. Pixels count from the photo's top left corner, y down."""

    view: PhotoView
    photo: Float32Array  # (h, w, 3) sRGB
    render: FloatArray  # (rh, rw, 4) linear colour on black and coverage, of all that the photo shows
    screen: FloatArray  # (n, 2) pixels of the points of all meshes
    landmarks: FloatArray  # (68, 2) pixels, of the face


@dataclass(frozen=True, kw_only=True)
class BakeSheet:
    """All that a report page shows beside the figures."""

    parts: FaceParts  # textured
    neutral: FloatArray  # (n, 3) world points of the person without expression
    photos: tuple[ShownPhoto, ...]


def bake_sheet(face: Face, photos: Sequence[tuple[PhotoView, Path]]) -> BakeSheet:
    """What a face shows that textures were just baked to, within `Face.deriving`; photos are of the face before."""
    from facepipe.photo.pictures import photo_render

    parts, textured = face.parts_so_far(), Face(face.stage, face.prim)
    views = {view.name: view for view in parts.photos}
    skin = next(number for number, mesh in enumerate(parts.meshes) if SCHEME in mesh.landmarks)
    marks = sum(len(mesh.points) for mesh in parts.meshes[:skin]) + parts.meshes[skin].landmarks[SCHEME].indices
    shown = []
    for before, path in photos:
        view = views[before.name]
        points, pixels = _seen(textured, view, path)
        screen, _ = to_pixels(view, to_camera(view, points))
        render = photo_render(parts, view, points)
        shown.append(ShownPhoto(view=view, photo=pixels, render=render, screen=screen, landmarks=screen[marks]))
    return BakeSheet(parts=parts, neutral=textured.evaluate(pose="set"), photos=tuple(shown))


def write_folder(folder: Path, report: BakePhotoReport) -> None:
    """Write report.html, report.json and, called as the poses of the photos, the face as it is in them."""
    from facepipe.photo import pictures
    from facepipe.photo.fit.report import render_image
    from facepipe.photo.pictures import SIZE, grid, three_sides
    from facepipe.pictures import save_png
    from facepipe.pictures.figures import figure

    rows, textures, parts = [], [], report.sheet.parts
    for shown in report.sheet.photos:
        save_png(render_image(shown.render), folder / f"{shown.view.name}.render.png")
        height, width = shown.photo.shape[:2]
        near = pictures.portrait(shown.landmarks, shown.screen, width, height, SIZE)
        alike = report.similarities.get(shown.view.image)
        renders = [pictures.render_picture(shown.render, shown.photo, near, on_photo=on) for on in (False, True)]
        seen = f"{report.photos[shown.view.image]:.0%} of the face"
        shows = [
            figure(pictures.photo_picture(shown.photo, near), shown.view.image, seen),
            figure(renders[0], "render, same camera", "" if alike is None else f"similarity {alike:.3f}"),
            figure(renders[1], "render on the photo"),
        ]
        rows.append(grid(shows, 3))
    sources = {material.name: material.diffuse_color for material in parts.materials}
    for name, materials in report.textures.items():
        source = sources[materials[0]]
        assert isinstance(source, TextureInput)
        image = open_image(source.texture.image(), name).convert("RGB")
        small = image.resize((SIZE, SIZE), Image.Resampling.LANCZOS)
        textures.append(figure(small, name, f"{image.width} x {image.height}"))
    title = f"Baked photos: {parts.name}"
    facts = f"{report.seen:.0%} of the face in {len(report.photos)} photo{'s' * (len(report.photos) != 1)}"
    write_bytes(
        folder / "report.html",
        page(
            title,
            joined(tag("h1", title), tag("p", facts, class_="muted")),
            *rows,
            heading("Without expression", "in studio light"),
            grid(three_sides(parts, report.sheet.neutral), 3),
            heading("Textures"),
            grid(textures, 3),
        ),
    )
    figures = report.to_dict()
    del figures["seconds"]  # the same input gives the same bytes
    write_bytes(folder / "report.json", f"{json.dumps(figures, sort_keys=True, indent=2)}\n".encode())
