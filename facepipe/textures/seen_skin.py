"""What a photo shows of the skin: where each point is in it, how far from what is no skin, and its colours unlit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from facepipe.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from facepipe.geometry.colors import from_srgb
from facepipe.geometry.polygons import point_normals
from facepipe.geometry.rasterise import rasterise, screen_triangles
from facepipe.geometry.texels import Texels
from facepipe.geometry.vectors import unit_vectors
from facepipe.networks.files import FaceMask, face_mask
from facepipe.parts import PhotoView
from facepipe.pictures.lighting import PhotoLight, returned
from facepipe.textures.skin_surface import SkinSurface

_JUMP = 0.07  # of the eyes' distance, in depth: an edge
_SLACK = 0.03  # of the eyes' distance, in depth: a point so far behind the surface still is on it
_OUTLINE = (0.015, 0.08)  # of the eyes' distance off the outline: where confidence begins, where it is full
_CREASE = (0.005, 0.03)  # the same where the face hides a part of itself: wings of the nose, lips
_OPENING = (0.004, 0.02)  # the same off eyes, teeth and the mouth's inside
_FACING = (0.10, 0.40)  # cosine to the viewer
_FRAME = 4.0  # pixels off the photo's border
_FACE = (0.3, 0.7)  # share of a pixel that is face, by the network of masks
GREY = np.array([0.2126, 0.7152, 0.0722])  # brightness of linear light
DARKEST = 0.004  # linear: of texels and photos, below which a ratio means nothing
_DIM = (0.03, 0.15)  # of the light where much arrives: where confidence begins, where it is full
_AROUND = 0.35  # of the eyes' distance, off an eye's middle
_BLOWN = (0.955, 0.995)  # sRGB: full confidence up to here, none from here


@dataclass(frozen=True, kw_only=True)
class SeenSkin:
    """The skin in a photo."""

    view: PhotoView
    eye_distance: float  # stage units
    depth: Float32Array  # (h, w) of the nearest surface, infinite where there is none
    outline: Float32Array  # (h, w) pixels to where there is no face
    crease: Float32Array  # (h, w) pixels to the nearest edge before another part of the face
    opening: Float32Array  # (h, w) pixels to the nearest surface that is no skin
    mask: FaceMask  # what the photo shows there

    def confidence(self, pixels: FloatArray, depth: FloatArray, facing: FloatArray) -> FloatArray:
        """(m,) of 0..1 in what the photo shows at pixels (m, 2) of skin at a depth (m,).

        :param facing: (m,) cosine between its normal and the direction to the viewer
        """
        height, width = self.depth.shape
        x, y = pixels.T
        at = np.clip(y, 0, height - 1).astype(np.int32) * width + np.clip(x, 0, width - 1).astype(np.int32)
        seen = depth <= self.depth.ravel()[at] + _SLACK * self.eye_distance
        border = np.minimum(np.minimum(x, width - x), np.minimum(y, height - y))
        eyes = self.eye_distance * self.view.focal / np.maximum(depth, 1e-9)  # in pixels
        trust = seen * step(border / _FRAME, 0, 1) * step(facing, *_FACING) * step(self.mask.face.ravel()[at], *_FACE)
        for distance, limits in ((self.outline, _OUTLINE), (self.crease, _CREASE), (self.opening, _OPENING)):
            trust = trust * step(distance.ravel()[at] / eyes, *limits)
        return np.asarray(trust)


def step(values: FloatArray, low: float, high: float) -> FloatArray:
    """0 up to `low`, 1 from `high`, smooth between them."""
    share = np.clip((values - low) / (high - low), 0, 1)
    return np.asarray(share * share * (3 - 2 * share))


def to_camera(view: PhotoView, points: FloatArray) -> FloatArray:
    """(n, 3) world points in camera coordinates."""
    to_world = np.asarray(view.transform, dtype=np.float64)
    return np.asarray((points - to_world[:3, 3]) @ np.linalg.inv(to_world[:3, :3]).T)


def to_pixels(view: PhotoView, local: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 2) pixels of camera coordinates (n, 3), and depths (n,)."""
    scale = view.focal / np.maximum(-local[:, 2], 1e-9)
    x, y = view.center[0] + scale * local[:, 0], view.center[1] - scale * local[:, 1]
    return np.stack([x, y], axis=1), np.asarray(-local[:, 2])


def seen_skin(skin: SkinSurface, view: PhotoView, pixels: Float32Array, points: FloatArray) -> SeenSkin:
    """The skin of a face in a photo.

    :param pixels: (h, w, 3) sRGB 0..1
    :param points: (n, 3) world points of all meshes as they are in the photo
    """
    local = to_camera(view, points)
    depth = -local[:, 2]
    landmarks, _ = to_pixels(view, local[skin.span][skin.landmarks])
    flat = view.focal * local[:, :2] * [1.0, -1.0] + np.array(view.center) * depth[:, None]
    screen = np.column_stack([flat, np.ones(len(points)), depth])
    raster = rasterise(screen_triangles(screen, skin.opaque), view.width, view.height)
    covered = raster.key > 0
    far = np.full(covered.shape, np.inf, np.float32)
    far[covered] = 1 / raster.nearness[covered]
    eyes = skin.eye_distance(points[skin.span])
    outside = np.zeros(int(skin.opaque.max(initial=0)) + len(skin.points) + 1, bool)
    outside[skin.span] = skin.outside
    opening = covered & ~np.asarray(outside[skin.opaque].all(axis=1))[np.maximum(raster.triangle, 0)]
    # where depth jumps to a neighbour's
    finite = np.where(np.isfinite(far), far, 1e9)
    edge = np.zeros(far.shape, bool)
    for axis in (0, 1):
        across = np.abs(np.diff(finite, axis=axis)) > _JUMP * eyes
        for first in (slice(None, -1), slice(1, None)):
            part = (first, slice(None)) if axis == 0 else (slice(None), first)
            edge[part] |= across
    return SeenSkin(
        view=view,
        eye_distance=eyes,
        depth=far,
        outline=_distance(~covered),
        crease=_distance(edge),
        opening=_distance(opening),
        mask=face_mask(pixels, landmarks),
    )


def _distance(marked: BoolArray) -> Float32Array:
    """(h, w) pixels to the nearest one marked; large where none is."""
    if not marked.any():
        return np.full(marked.shape, 1e6, np.float32)
    return np.asarray(distance_transform_edt(~marked), np.float32)


@dataclass(frozen=True, kw_only=True)
class Observed:
    """Texels of one texture that a photo shows."""

    place: IntArray  # (k,) into the texels of the surface
    ratio: Float32Array  # (k, 3) natural logarithm of the colour over the template's
    trust: Float32Array  # (k,) 0..1


@dataclass(frozen=True, kw_only=True)
class Exposure:
    """A photo, where its camera stood, and its light on a face."""

    pixels: Float32Array  # (h, w, 3) sRGB 0..1
    seen: SeenSkin
    light: PhotoLight
    points: FloatArray  # (n, 3) of the skin, camera coordinates
    normals: FloatArray  # (n, 3) unit
    facing: FloatArray  # (n,) cosine between them and the direction to the viewer
    trust: FloatArray  # (n,) 0..1, by geometry
    white: FloatArray  # (n, 3) linear light that white matt points show
    all_points: FloatArray  # of all meshes, as `points`
    all_white: FloatArray  # as `white`
    eye_whites: FloatArray | None = None  # (3,) logarithms of what whites of eyes show over that, where any are seen

    def light_around(self, span: slice) -> FloatArray:
        """(3,) median light of the skin around some points of all meshes: what lids let through is hardly known."""
        off = np.linalg.norm(self.points - self.all_points[span].mean(axis=0), axis=1)
        near = (off < _AROUND * self.seen.eye_distance) & (self.trust > 0)
        return np.asarray(np.median(self.white[near], axis=0)) if near.any() else np.ones(3)

    @property
    def eye_pixels(self) -> float:
        """Pixels of the photo between the eyes."""
        return self.seen.eye_distance * self.view.focal / float(np.median(-self.points[:, 2]))

    @property
    def clarity(self) -> float:
        """Pixels between the eyes, less where the skin is in little light."""
        lit = self.white[self.trust > 0]
        bright = float(np.median(lit @ GREY)) if len(lit) else 0.0
        return self.eye_pixels * min(1.0, bright)

    @property
    def view(self) -> PhotoView:
        """The photo's camera and light."""
        return self.seen.view


def expose(skin: SkinSurface, view: PhotoView, pixels: Float32Array, points: FloatArray) -> Exposure:
    """What a photo shows of the skin.

    :param points: (n, 3) world points of all meshes as they are in the photo
    """
    seen = seen_skin(skin, view, pixels, points)
    everything = to_camera(view, points)
    normals = point_normals(everything, skin.opaque)
    whole = PhotoLight.on_points(view, everything, normals, skin.opaque)
    light = PhotoLight(view=view, hidden=whole.hidden[skin.span], arriving=whole.arriving[skin.span])
    local, own = everything[skin.span], normals[skin.span]
    places, depth = to_pixels(view, local)
    facing = (own * unit_vectors(-local)).sum(axis=1)
    trust = seen.confidence(places, depth, facing) * skin.outside
    white = whole.white(normals, whole.hidden, whole.arriving)
    return Exposure(
        pixels=pixels,
        seen=seen,
        light=light,
        points=local,
        normals=own,
        facing=facing,
        trust=trust,
        white=white[skin.span],
        all_points=everything,
        all_white=white,
    )


def observe(skin: SkinSurface, photo: Exposure, number: int, template: FloatArray) -> Observed:
    """What a photo shows of one of the skin's textures, in float32: its pixels have 256 levels.

    :param template: (m, 3) linear colours of the texture's texels
    """
    texels, grey = skin.textures[number].texels, GREY.astype(np.float32)
    marked = photo.trust > 0
    beside = np.zeros(len(marked), bool)
    for one, other in (skin.edges.T, skin.edges.T[::-1]):
        beside[one[marked[other]]] = True

    light = np.column_stack([photo.points, photo.normals, photo.light.arriving, photo.light.hidden]).astype(np.float32)
    place_of = np.column_stack([light[:, :6], skin.outside])  # what texels take of points, in one product

    def where(part: Texels) -> FloatArray:
        """(k, 3) pixels, and the trust in what they show by geometry."""
        local, normals, outside = np.split(part.carried(place_of), [3, 6], axis=1)
        pixels, depth = to_pixels(photo.view, local)
        facing = np.einsum("mc,mc->m", unit_vectors(normals), unit_vectors(-local))
        return np.column_stack([pixels, photo.seen.confidence(pixels, depth, facing) * (outside[:, 0] > 0.999)])

    first, second, third = (np.take(marked | beside, corner) for corner in texels.corners.T)
    place = np.flatnonzero(first | second | third)
    part = texels.taken(place)
    there = part.by_runs(where)
    kept = np.flatnonzero(there[:, 2] > 0)
    place, part, there = place[kept], part.taken(kept), np.take(there, kept, axis=0)
    pixels = there[:, :2]
    following = np.flatnonzero(np.diff(part.at) == 1)  # texels side by side, and pixels of the photo between them
    apart = np.hypot(*(pixels[following + 1] - pixels[following]).T)
    shown = sampled(photo.pixels, pixels, float(np.median(apart)) if len(apart) else 1.0)
    bright = float(np.quantile(photo.white[marked] @ GREY, 0.8)) if marked.any() else 1.0

    def unlit(part: Texels, shown: Float32Array, trust: Float32Array, own: Float32Array) -> FloatArray:
        """(k, 4) ratios to colours of the template's, and the trust in them."""
        local, normals, arriving, hidden = np.split(part.carried(light), [3, 6, 7], axis=1)
        normals, arriving = unit_vectors(normals), arriving[:, 0]
        white = photo.light.white(normals, hidden, arriving)
        linear = from_srgb(np.clip(shown, 0, 1))
        mirrored = photo.light.mirrored(normals, unit_vectors(-local), arriving)
        most = np.maximum(np.maximum(shown[:, 0], shown[:, 1]), shown[:, 2])
        trust = trust * step(white @ grey / bright, *_DIM) * (1 - step(most, *_BLOWN) * 0.9)
        matt = np.maximum(linear - np.minimum(mirrored, 0.4 * linear), DARKEST) / np.maximum(white, _DIM[0] * bright)
        return np.column_stack([np.log(matt / (1 + returned(hidden) * matt)) - np.log(own), trust])

    found = part.by_runs(unlit, shown, there[:, 2], np.take(template, place, axis=0))
    return Observed(place=place, ratio=found[:, :3], trust=found[:, 3])


def sampled(pixels: Float32Array, places: FloatArray, spacing: float) -> Float32Array:
    """(m, 3) of a photo (h, w, 3) at places (m, 2), cubic, blurred where texels are wider than its pixels."""
    if not len(places):
        return np.zeros((0, 3), np.float32)
    low = np.maximum(np.floor(places.min(axis=0)).astype(int) - 8, 0)
    high = np.ceil(places.max(axis=0)).astype(int) + 8
    part = pixels[low[1] : high[1], low[0] : high[0]]
    if spacing > 1.2:
        part = gaussian_filter(part, (0.45 * spacing, 0.45 * spacing, 0))
    at = np.stack([places[:, 1] - low[1] - 0.5, places[:, 0] - low[0] - 0.5]).astype(np.float32)
    channels = [map_coordinates(part[..., channel], at, order=3, mode="nearest") for channel in range(3)]
    return np.stack(channels, axis=1).astype(np.float32)
