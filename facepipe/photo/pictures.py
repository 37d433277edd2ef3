"""The report page of a fit to photos, and its pictures of each photo: square areas of it with what was fitted.

Over a picture the edges of the face are drawn without those that its surface hides.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from facepipe.core.arrays import ByteArray, Float32Array, FloatArray, IntArray
from facepipe.core.markup import Markup, heading, joined, page, tag
from facepipe.geometry.colors import from_srgb, to_srgb
from facepipe.geometry.polygons import edges
from facepipe.geometry.rasterise import NEAR, rasterise, screen_triangles
from facepipe.parts import FaceParts, Material, PhotoView, TextureInput
from facepipe.pictures.camera import Camera, View, y_up
from facepipe.pictures.draw import draw
from facepipe.pictures.face_picture import PictureOptions
from facepipe.pictures.face_picture import pictures as face_pictures
from facepipe.pictures.figures import TOTAL, bar, figure, loss_chart, table_of_bars
from facepipe.pictures.lighting import PhotoLights
from facepipe.pictures.scene import build_scene
from facepipe.pictures.shade import Shader

if TYPE_CHECKING:
    from PIL.Image import Image

Samples = TypeVar("Samples", ByteArray, FloatArray)

LARGEST = 1024  # pixels of a render's longer side
_SAMPLES = 2
Color = tuple[int, int, int]

GROUND: Color = (236, 237, 240)  # where there is no photo
GIVEN: Color = (255, 255, 255)  # rings
FITTED: Color = (226, 40, 52)  # dots
ERROR: Color = (255, 214, 64)  # lines between the two
CASING: Color = (24, 26, 32)  # dark outline that keeps light marks legible
WIRE: Color = (196, 240, 255)
CLOSE, HEAD, FAR = 0.16, 0.42, 0.9  # margins around the landmarks, shares of their size
FINE = 4  # marks are drawn this many times as large, in both directions
AROUND = 0.03  # margin around the points of a head, share of their size
SIZE = 640  # pixels of a picture
ACTIVE = 0.02  # share of the range (of 1 for a weight) beyond which a control counts as moved
HIDDEN = 0.05  # share of a region that is in no photo, from which on it is listed
SIDES: tuple[View, ...] = ("front", "three-quarter", "side")  # that the neutral is seen from
FRAMED = 0.85  # a crop smaller than this share of the photo is framed in it
EDGES_FINE = 3  # samples per pixel and direction: lines are three samples, one pixel, wide
EDGES_SLACK = 2e-4  # of the depth: a point is hidden by what is nearer by more than that
EDGES_LONG, EDGES_SHORT = 7.0, 0.25  # pixels from which edges are drawn in full; opacity of the shortest


def photo_render(parts: FaceParts, view: PhotoView, points: FloatArray) -> FloatArray:
    """(h, w, 4) linear colour on black and coverage 0..1 of a face as a photo shows it, with the tints that it has.

    :param points: (n, 3) world points of the face as it is in the photo
    :raises InputError: points that don't fit or aren't finite, a broken texture
    """
    share = min(1.0, LARGEST / max(view.width, view.height))
    width, height = (max(1, round(each * share)) for each in (view.width, view.height))
    fine = max(1, LARGEST // max(width, height))  # small ones are drawn larger, where details are not blurred
    size = fine * max(width, height)
    scene = build_scene(
        replace(parts, materials=tuple(_with_tint(one, view.tint.get(one.name)) for one in parts.materials)),
        points,
        size,
    )
    transform = np.asarray(view.transform, dtype=np.float64)
    axes, eye = y_up(transform[:3, :3].T, parts.up_axis), y_up(transform[None, :3, 3], parts.up_axis)[0]
    camera = Camera(axes=axes, eye=eye, focal=view.focal, center=view.center)
    shader = Shader(scene, camera.scaled(fine * share), lights=PhotoLights(view=view))
    mm = 1000 * parts.meters_per_unit
    drawn = []
    for level in (0.0, 1.0):
        background: Float32Array = np.full((size, size, 3), level, np.float32)
        linear = from_srgb(draw(shader, size, background, _SAMPLES, mm) / np.float32(255))
        drawn.append(np.asarray(linear)[: fine * height, : fine * width])
    on_black, on_white = drawn
    # what a pixel shows of the background is not covered
    coverage = 1 - (on_white - on_black).mean(axis=2, keepdims=True)
    image = np.concatenate([on_black, coverage.clip(0, 1)], axis=2)
    return np.asarray(image.reshape(height, fine, width, fine, 4).mean(axis=(1, 3)))


def _with_tint(material: Material, tint: tuple[float, float, float] | None) -> Material:
    if tint is None:
        return material
    color = material.diffuse_color
    if not isinstance(color, TextureInput):
        red, green, blue = (one * factor for one, factor in zip(color, tint, strict=True))
        return replace(material, diffuse_color=(red, green, blue))
    red, green, blue, alpha = (one * factor for one, factor in zip(color.scale, (*tint, 1.0), strict=True))
    return replace(material, diffuse_color=replace(color, scale=(red, green, blue, alpha)))


@dataclass(frozen=True, kw_only=True)
class Crop:
    """A square of a photo and where it stands in a picture of `size` pixels a side."""

    left: float  # pixels of the photo, may lie outside of it
    top: float
    side: float
    size: int

    @property
    def scale(self) -> float:
        """Pixels of the picture to one of the photo."""
        return self.size / self.side

    def place(self, points: FloatArray) -> FloatArray:
        """(n, 2) pixels of the picture of photo pixels (n, 2)."""
        return np.asarray((points - (self.left, self.top)) * self.scale)


def whole(width: int, height: int, size: int) -> Crop:
    """The square that holds the whole photo."""
    side = float(max(width, height))
    return Crop(left=(width - side) / 2, top=(height - side) / 2, side=side, size=size)


def close_up(landmarks: FloatArray, width: int, height: int, size: int) -> Crop:
    """The square around landmarks (l, 2), kept within the photo as far as it fits."""
    low, high = _extended(landmarks, (width, height), CLOSE)
    return _square(low, high, width, height, size)


def portrait(landmarks: FloatArray, fitted: FloatArray, width: int, height: int, size: int) -> Crop:
    """The square around a head: what lies around its landmarks (l, 2), and the fitted points (n, 2) within reach."""
    low, high = _extended(landmarks, (width, height), HEAD)
    least, most = _extended(landmarks, (width, height), FAR)
    reached = np.clip(np.vstack([fitted, low, high]), least, most)
    low, high = reached.min(axis=0), reached.max(axis=0)
    edge = AROUND * float((high - low).max())
    return _square(low - edge, high + edge, width, height, size)


def _extended(landmarks: FloatArray, reach: tuple[int, int], share: float) -> tuple[FloatArray, FloatArray]:
    """The corners of a square around landmarks, a margin wider; those outside the photo count at its border."""
    inside = np.clip(landmarks, 0, reach)
    low, high = inside.min(axis=0), inside.max(axis=0)
    half = max(float((high - low).max()), 6.0) * (0.5 + share)
    return (low + high) / 2 - half, (low + high) / 2 + half


def _square(low: FloatArray, high: FloatArray, width: int, height: int, size: int) -> Crop:
    side = min(float((high - low).max()), float(max(width, height)))
    # moved into the photo, or to its middle where the square is larger
    left, top = (
        (reach - side) / 2 if side >= reach else min(max(float(start), 0.0), reach - side)
        for start, reach in zip((low + high - side) / 2, (float(width), float(height)), strict=True)
    )
    return Crop(left=left, top=top, side=side, size=size)


def cut(channels: FloatArray, crop: Crop, size: tuple[int, int]) -> FloatArray:
    """(crop.size, crop.size, c) part of an image (h, w, c) of a photo of `size` (width, height); NaN outside it."""
    from PIL import Image

    resampled = np.full((crop.size, crop.size, channels.shape[2]), np.nan)
    low = np.clip((crop.left, crop.top), 0, size)
    high = np.clip((crop.left + crop.side, crop.top + crop.side), 0, size)
    (x0, y0), (x1, y1) = (np.rint(crop.place(each)).astype(int) for each in (low, high))
    x1, y1 = max(x1, x0 + 1), max(y1, y0 + 1)
    ratio = np.array(channels.shape[1::-1]) / size
    (left, top), (right, bottom) = (low * ratio).tolist(), (high * ratio).tolist()
    # Only what the filter reaches is made float: photos are large, and faces small in them.
    reach = 4 + 2 * int(max((right - left) / (x1 - x0), (bottom - top) / (y1 - y0)))
    column, row = max(int(left) - reach, 0), max(int(top) - reach, 0)
    used = channels[row : int(bottom) + reach, column : int(right) + reach]
    box = (left - column, top - row, right - column, bottom - row)
    for number in range(channels.shape[2]):
        plane = Image.fromarray(np.ascontiguousarray(used[..., number], dtype=np.float32))
        resized = plane.resize((x1 - x0, y1 - y0), Image.Resampling.BICUBIC, box=box)
        part = np.asarray(resized)[: crop.size - y0, : crop.size - x0]
        resampled[y0 : y0 + part.shape[0], x0 : x0 + part.shape[1], number] = part
    return resampled


def photo_picture(photo: FloatArray, crop: Crop) -> Image:
    """The photo (h, w, 3), sRGB 0..1, as it is."""
    return _image(cut(photo, crop, photo.shape[1::-1]))


def landmark_picture(photo: FloatArray, crop: Crop, given: FloatArray, fitted: FloatArray) -> Image:
    """Rings at the landmarks given, dots at those of the fitted face, and lines from the one to the other."""
    image = _image(_toned(cut(photo, crop, photo.shape[1::-1]), 0.86))
    radius = max(2.0, crop.size / 200)
    rings, dots = crop.place(given), crop.place(fitted)
    casings, lines = Shapes(image.size), Shapes(image.size)
    for pair in np.stack([rings, dots], axis=1):
        casings.line(pair, radius * 1.2)
        lines.line(pair, radius * 0.65)
    casings.paint(image, CASING, 0.5)
    lines.paint(image, ERROR)
    given_mark(image, rings, radius)
    fitted_mark(image, dots, radius)
    return image


def given_mark(image: Image, centers: FloatArray, radius: float) -> None:
    """Rings around dots of `radius` at (m, 2)."""
    casings, rings = Shapes(image.size), Shapes(image.size)
    for x, y in centers.tolist():
        casings.ring((x, y), radius * 1.95, radius * 1.25)
        rings.ring((x, y), radius * 1.95, radius * 0.65)
    casings.paint(image, CASING, 0.6)
    rings.paint(image, GIVEN)


def fitted_mark(image: Image, centers: FloatArray, radius: float) -> None:
    """Dots of `radius` at (m, 2)."""
    dots = Shapes(image.size)
    for x, y in centers.tolist():
        dots.disc((x, y), radius)
    dots.paint(image, FITTED)


def wireframe(parts: FaceParts, screen: FloatArray, size: tuple[int, int]) -> Image:
    """How much of each pixel is covered by visible edges: a mask of `size` (width, height), 8 bits.

    Short edges are fainter, so that a dense mesh gives a tone, no blot.

    :param screen: (n, 3) pixel x, pixel y (down) and depth of the points of all meshes, in mesh order
    """
    from PIL import Image

    width, height = size[0] * EDGES_FINE, size[1] * EDGES_FINE
    scene = build_scene(parts, None)
    points = np.asarray(screen, dtype=np.float64) * (EDGES_FINE, EDGES_FINE, 1.0)
    solid = scene.triangles[~scene.see_through]
    # (e, 2) polygon edges of opaque surfaces between points that face the camera and are in front of it
    (ax, ay), (bx, by), (cx, cy) = points[solid.T, :2].transpose(0, 2, 1)
    ahead = (points[solid, 2] > NEAR).all(axis=1)
    facing = ahead & ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax) < 0)  # y points down
    seen = np.zeros(len(points), dtype=bool)
    seen[solid[facing]] = True
    meshes: list[IntArray] = [np.zeros((0, 2), np.int64)]
    start = 0
    for mesh in parts.meshes:
        meshes.append(edges(mesh.face_vertex_counts, mesh.face_vertex_indices)[0] + start)
        start += len(mesh.points)
    pairs = np.concatenate(meshes)
    pairs = np.asarray(pairs[seen[pairs].all(axis=1)])
    cover = np.zeros((height, width), np.uint8)
    if len(pairs):
        depth = np.maximum(points[:, 2:], NEAR / 2)
        homogeneous = np.hstack([points[:, :2] * depth, np.ones_like(depth), depth])
        nearness = rasterise(screen_triangles(homogeneous, solid), width, height).nearness
        farthest = _nearby(np.minimum, nearness)  # steep surfaces must not hide their own edges
        ends = points[pairs]
        # set the samples along edges (e, 2, 3) where nothing is nearer
        rows, columns = cover.shape
        low, high = ends[..., :2].min(axis=1), ends[..., :2].max(axis=1)
        ends = ends[(high > 0).all(axis=1) & (low < (columns, rows)).all(axis=1)]
        length = np.linalg.norm(ends[:, 1, :2] - ends[:, 0, :2], axis=1)
        count = np.minimum(np.ceil(length), 4 * (columns + rows)).astype(np.int64) + 1
        which = np.repeat(np.arange(len(ends)), count)
        share = (np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)) / np.maximum(count - 1, 1)[which]
        at = ends[which, 0, :2] * (1 - share[:, None]) + ends[which, 1, :2] * share[:, None]
        line_nearness = (1 - share) / ends[which, 0, 2] + share / ends[which, 1, 2]
        column, row = np.floor(at).astype(np.int64).T
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        column, row, line_nearness, which = column[inside], row[inside], line_nearness[inside], which[inside]
        clear = line_nearness >= farthest[row, column] * (1 - EDGES_SLACK)
        tone = np.clip(length / EDGES_FINE / EDGES_LONG, EDGES_SHORT, 1.0)[which] * 255
        np.maximum.at(cover, (row[clear], column[clear]), np.rint(tone[clear]).astype(np.uint8))
    return Image.fromarray(_nearby(np.maximum, cover)).reduce(EDGES_FINE)


def _nearby(extreme: np.ufunc, samples: Samples) -> Samples:
    """The extreme of each sample (h, w) and its neighbours, with 0 around all of them."""
    padded = np.pad(samples, 1)
    rows = extreme(extreme(padded[:-2], padded[1:-1]), padded[2:])
    return np.asarray(extreme(extreme(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:]))


def wireframe_picture(photo: FloatArray, crop: Crop, parts: FaceParts, screen: FloatArray) -> Image:
    """The photo, darker, with the edges of the fitted face that are not hidden; `screen` as for `wireframe`."""
    image = _image(_toned(cut(photo, crop, photo.shape[1::-1]), 0.68))
    at = np.column_stack([crop.place(screen[:, :2]), screen[:, 2]])
    image.paste(WIRE, (0, 0), wireframe(parts, at, image.size))
    return image


def render_picture(render: FloatArray, photo: FloatArray, crop: Crop, *, on_photo: bool) -> Image:
    """A render (h, w, 4), linear on black with coverage, from the photo's camera, alone or over the photo."""
    pixels = cut(np.asarray(render), crop, photo.shape[1::-1])
    cover = np.clip(pixels[..., 3:], 0, 1)
    ground = cut(photo, crop, photo.shape[1::-1]) if on_photo else np.array(GROUND) / 255
    behind = from_srgb(np.clip(ground, 0, 1))
    return _image(to_srgb(np.clip(np.maximum(pixels[..., :3], 0) + behind * (1 - cover), 0, 1)))


def _toned(pixels: FloatArray, amount: float) -> FloatArray:
    """Darker, with less colour, so that marks stand out."""
    grey = pixels.mean(axis=2, keepdims=True)
    return np.asarray((pixels + (grey - pixels) * (1 - amount)) * amount)


def _image(pixels: FloatArray) -> Image:
    """An 8-bit picture of sRGB values 0..1; NaN is empty ground."""
    from PIL import Image

    filled = np.where(np.isnan(pixels), np.array(GROUND) / 255, pixels)
    return Image.fromarray((np.clip(filled, 0, 1) * 255 + 0.5).astype(np.uint8))


class Shapes:
    """Lines, discs and rings gathered on a fine grid, then painted in one colour with smooth edges.

    Coordinates are pixels of the picture, (0, 0) its top left corner.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        from PIL import Image, ImageDraw

        self.mask = Image.new("L", (size[0] * FINE, size[1] * FINE), 0)
        self.pen = ImageDraw.Draw(self.mask)

    def line(self, points: FloatArray, width: float) -> None:
        """A line with round corners and ends through points (m, 2); one point gives a disc."""
        fine = np.asarray(points, dtype=np.float64) * FINE - 0.5
        if len(fine) > 1:
            self.pen.line([tuple(each) for each in fine.tolist()], fill=255, width=round(width * FINE), joint="curve")
        for end in (points[0], points[-1]):
            self.disc((float(end[0]), float(end[1])), width / 2)

    def disc(self, center: tuple[float, float], radius: float) -> None:
        """A disc."""
        x, y, reach = center[0] * FINE - 0.5, center[1] * FINE - 0.5, radius * FINE
        self.pen.ellipse((x - reach, y - reach, x + reach, y + reach), fill=255)

    def ring(self, center: tuple[float, float], radius: float, width: float) -> None:
        """A circle whose line has its middle at `radius`; what is inside stays as it is."""
        x, y, reach = center[0] * FINE - 0.5, center[1] * FINE - 0.5, (radius + width / 2) * FINE
        self.pen.ellipse((x - reach, y - reach, x + reach, y + reach), outline=255, width=round(width * FINE))

    def paint(self, image: Image, color: Color, opacity: float = 1.0) -> None:
        """Put the shapes onto a picture of the size given at first."""
        cover = self.mask.reduce(FINE).point([round(level * opacity) for level in range(256)])
        image.paste(color, (0, 0), cover)


@dataclass(frozen=True, kw_only=True)
class SheetPhoto:
    """One photo, and what the fit makes of it. Pixels count from the photo's top left corner, y down."""

    name: str
    photo: FloatArray  # (h, w, 3) sRGB 0..1
    render: FloatArray  # (rh, rw, 4) linear colour on black and coverage 0..1, of all that the photo shows, any size
    screen: FloatArray  # (n, 3) pixel x, y and depth of the posed points of all meshes, in mesh order
    targets: FloatArray  # (l, 2) landmarks that the fit was given, pixels
    landmarks: FloatArray  # (l, 2) landmarks of the fitted face, pixels
    landmark_error: float  # mean, pixels
    eye_distance: float  # pixels between the outer eye corners, what the error is a percentage of
    expressions: Mapping[str, float]  # shape -> weight, of the shapes that were free
    similarity: float | None = None  # of photo and render to a recognition network, cosine


@dataclass(frozen=True, kw_only=True)
class PhotoSheet:
    """All that a report page shows."""

    parts: FaceParts
    neutral: FloatArray  # (n, 3) world points of the person without expression
    photos: tuple[SheetPhoto, ...]  # one at least
    sliders: Mapping[str, float]  # name -> value, of the sliders that were free
    history: Sequence[Mapping[str, float]]  # by step: "total" and each weighted term; NaN: not known
    kept: int = 0  # step that the face is of
    note: str = ""  # how the fit ended
    unseen: Mapping[str, float] = field(default_factory=dict)  # region -> share of it that no photo shows


def photo_page(sheet: PhotoSheet) -> bytes:
    """One HTML page: pictures of every photo, the neutral, expressions, losses and sliders."""
    title = f"Photo fit: {sheet.parts.name}"
    losses = heading("Losses", "weighted terms, by step"), loss_chart(sheet.history)
    found = tag("section", *_expressions(sheet)), tag("section", *losses)
    beside = tag("div", *found, class_="columns" if len(sheet.photos) == 1 else None)
    head = joined(tag("h1", title), tag("p", "  ·  ".join(facts(sheet)), class_="muted"))
    return page(title, head, *_pictures(sheet), beside, *_unseen(sheet), *_sliders(sheet))


def facts(sheet: PhotoSheet) -> list[str]:
    """What one wants to know first."""
    known = [_count(len(sheet.photos), "photo"), _count(max(len(sheet.history) - 1, 0), "step")]
    kept = [step.get(TOTAL, np.nan) for step in sheet.history[sheet.kept : sheet.kept + 1]]
    if np.isfinite(kept).any():
        known.append(f"loss {kept[0]:.3g} at step {sheet.kept}")
    errors = [photo.landmark_error for photo in sheet.photos]
    shares = [photo.landmark_error / photo.eye_distance for photo in sheet.photos]
    known.append(
        f"landmark error {np.mean(errors):.2f} px, {np.mean(shares):.1%} of the distance of the outer eye corners"
    )
    return known + ([sheet.note] if sheet.note else [])


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _pictures(sheet: PhotoSheet) -> Iterator[Markup]:
    """One photo: two rows of four with the neutral. Several: a row of five for each, and the neutral."""
    neutral = three_sides(sheet.parts, sheet.neutral)
    if len(sheet.photos) == 1:
        yield grid([*_of_photo(sheet, sheet.photos[0]), *neutral], 4)
        return
    yield from (grid(_of_photo(sheet, photo), 5) for photo in sheet.photos)
    yield joined(heading("Without expression"), grid(neutral, 5))


def grid(figures: Sequence[Markup], columns: int) -> Markup:
    """Figures in rows."""
    style = f"grid-template-columns:repeat({columns},minmax(0,1fr));margin-top:24px"
    return tag("div", *figures, class_="grid", style=style)


def _of_photo(sheet: PhotoSheet, photo: SheetPhoto) -> list[Markup]:
    """The five pictures of a photo, with captions."""
    from PIL import ImageDraw

    height, width = photo.photo.shape[:2]
    square = whole(width, height, SIZE)
    marks = np.concatenate([photo.targets, photo.landmarks])
    near = portrait(marks, photo.screen[photo.screen[:, 2] > NEAR, :2], width, height, SIZE)
    close = close_up(marks, width, height, SIZE)
    image = photo_picture(photo.photo, square)
    if near.side < FRAMED * max(width, height):
        corners = np.array([(near.left, near.top), (near.left + near.side, near.top + near.side)])
        (left, top), (right, bottom) = np.rint(square.place(corners)).astype(int).tolist()
        pen = ImageDraw.Draw(image)
        for wider, color in ((1, CASING), (0, GIVEN)):
            pen.rectangle((left - wider, top - wider, right + wider, bottom + wider), outline=color)
    landmarks = landmark_picture(photo.photo, close, photo.targets, photo.landmarks)
    error = f"{photo.landmark_error:.2f} px, {photo.landmark_error / photo.eye_distance:.1%}"
    alike = "" if photo.similarity is None else f"similarity {photo.similarity:.3f}"
    return [
        figure(image, photo.name, f"{width} x {height}"),
        figure(landmarks, joined(_mark(given=True), " given ", _mark(given=False), " fitted"), error),
        figure(wireframe_picture(photo.photo, near, sheet.parts, photo.screen), "fitted mesh"),
        figure(render_picture(photo.render, photo.photo, near, on_photo=False), "render, same camera", alike),
        figure(render_picture(photo.render, photo.photo, near, on_photo=True), "render on the photo"),
    ]


def _mark(*, given: bool) -> Markup:
    """A landmark as the picture has it, for its legend."""
    casing = tag("circle", cx=7, cy=7, r=7, fill="rgb(24,26,32)")
    ring = tag("circle", cx=7, cy=7, r=4.5, fill="none", stroke="#fff", stroke_width=2)
    dot = tag("circle", cx=7, cy=7, r=4, fill="rgb(226,40,52)")
    return tag("svg", *((casing, ring) if given else (dot,)), width=14, height=14, style="vertical-align:-2px")


def three_sides(parts: FaceParts, neutral: FloatArray) -> list[Markup]:
    """The person without expression in studio light."""
    ground = (GROUND[0] / 255, GROUND[1] / 255, GROUND[2] / 255)
    options = [PictureOptions(size=SIZE, view=view, background=ground, samples=2) for view in SIDES]
    images = face_pictures(parts, neutral, options)
    return [figure(image, "without expression", str(view)) for view, image in zip(SIDES, images, strict=True)]


def _unseen(sheet: PhotoSheet) -> Iterator[Markup]:
    """Regions of which a part is in no photo: that part is what is likeliest given the rest."""
    shares = {name: share for name, share in sheet.unseen.items() if share >= HIDDEN}
    if not shares:
        return
    yield heading("In no photo", "share of the region, turned away, hidden or cut off")
    order = sorted(shares, key=lambda name: (-shares[name], name))
    yield tag(
        "section", table_of_bars([(name, [(bar((0.0, 1.0), 0.0, shares[name]), shares[name])]) for name in order])
    )


def _expressions(sheet: PhotoSheet) -> Iterator[Markup]:
    """Weights, the largest first: one row a shape, one bar a photo."""
    weights = [photo.expressions for photo in sheet.photos]
    names = sorted({name for each in weights for name in each})
    largest = {name: max(abs(each.get(name, 0.0)) for each in weights) for name in names}
    used = sorted((name for name in names if largest[name] > ACTIVE), key=lambda name: -largest[name])
    yield heading("Expression", f"{len(used)} of {len(names)} shapes in use" if names else "none fitted")
    values = [each[name] for each in weights for name in used if name in each]
    limits = min([0.0, *values]), max([1.0, *values])
    rows = [
        (name, [(bar(limits, 0.0, each[name]), each[name]) if name in each else None for each in weights])
        for name in used
    ]
    titles = [photo.name for photo in sheet.photos] if len(weights) > 1 else []
    yield table_of_bars(rows, titles=titles)
    yield _counted({f"at {ACTIVE:g} or less": len(names) - len(used)})


def _sliders(sheet: PhotoSheet) -> Iterator[Markup]:
    """The sliders that have moved, by group; the others are counted."""
    sliders = sheet.parts.sliders
    free = [slider for slider in sliders if slider.name in sheet.sliders]
    moved = []
    for slider in free:
        reach = slider.maximum - slider.minimum
        if reach > 0 and abs(sheet.sliders[slider.name] - slider.default) / reach > ACTIVE:
            moved.append(slider)
    yield heading("Sliders", f"{len(moved)} of {len(free)} moved from the default" if free else "none fitted")
    tables = []
    for group in dict.fromkeys(slider.group for slider in moved):
        rows = []
        for slider in (one for one in moved if one.group == group):
            value = sheet.sliders[slider.name]
            rows.append((slider.name, [(bar((slider.minimum, slider.maximum), slider.default, value), value)]))
        tables.append(table_of_bars(rows, group or "other"))
    yield tag("div", *tables, class_="flow")
    still = f"within {ACTIVE:.0%} of the range from their default"
    yield _counted({still: len(free) - len(moved), "not fitted": len(sliders) - len(free)})


def _counted(counts: Mapping[str, int]) -> Markup:
    """How many controls are not in the table, and why."""
    return tag("p", "; ".join(f"{count} {why}" for why, count in counts.items() if count), class_="muted")
