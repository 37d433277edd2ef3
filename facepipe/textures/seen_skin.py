"""What a photo shows of the skin: where each point is in it, and how far from anything that is no skin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from facepipe.core.arrays import BoolArray, Float32Array, FloatArray
from facepipe.geometry.rasterise import rasterise, screen_triangles
from facepipe.networks.masks import FaceMask, face_mask
from facepipe.parts import PhotoView
from facepipe.textures.skin_surface import SkinSurface

_JUMP = 0.07  # of the eyes' distance, in depth: an edge
_SLACK = 0.03  # of the eyes' distance, in depth: a point so far behind the surface still is on it
_OUTLINE = (0.015, 0.08)  # of the eyes' distance off the outline: where confidence begins, where it is full
_CREASE = (0.005, 0.03)  # the same where the face hides a part of itself: wings of the nose, lips
_OPENING = (0.004, 0.02)  # the same off eyes, teeth and the mouth's inside
_FACING = (0.10, 0.40)  # cosine to the viewer
_FRAME = 4.0  # pixels off the photo's border
_FACE = (0.3, 0.7)  # share of a pixel that is face, by the network of masks


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
        column, row = np.clip(pixels, 0, [width - 1, height - 1]).astype(np.int64).T
        seen = depth <= self.depth[row, column] + _SLACK * self.eye_distance
        border = np.minimum(pixels, np.array([width, height]) - pixels).min(axis=1)
        eyes = self.eye_distance * self.view.focal / np.maximum(depth, 1e-9)  # in pixels
        trust = seen * step(border / _FRAME, 0, 1) * step(facing, *_FACING) * step(self.mask.face[row, column], *_FACE)
        for distance, limits in ((self.outline, _OUTLINE), (self.crease, _CREASE), (self.opening, _OPENING)):
            trust = trust * step(distance[row, column] / eyes, *limits)
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
    depth = np.maximum(-local[:, 2], 1e-9)
    return np.asarray(view.center + view.focal * local[:, :2] * [1.0, -1.0] / depth[:, None]), np.asarray(-local[:, 2])


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
    opening = covered & ~_is_skin(skin)[np.maximum(raster.triangle, 0)]
    return SeenSkin(
        view=view,
        eye_distance=eyes,
        depth=far,
        outline=_distance(~covered),
        crease=_distance(_outlines(far, _JUMP * eyes)),
        opening=_distance(opening),
        mask=face_mask(pixels, landmarks),
    )


def _is_skin(skin: SkinSurface) -> BoolArray:
    """(o,) whether each opaque triangle is on the outside of the skin."""
    outside = np.zeros(int(skin.opaque.max(initial=0)) + len(skin.points) + 1, bool)
    outside[skin.span] = skin.outside
    return np.asarray(outside[skin.opaque].all(axis=1))


def _outlines(depth: Float32Array, jump: float) -> BoolArray:
    """(h, w) where depth jumps to a neighbour's."""
    finite = np.where(np.isfinite(depth), depth, 1e9)
    edge = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        across = np.abs(np.diff(finite, axis=axis)) > jump
        for first in (slice(None, -1), slice(1, None)):
            part = (first, slice(None)) if axis == 0 else (slice(None), first)
            edge[part] |= across
    return edge


def _distance(marked: BoolArray) -> Float32Array:
    """(h, w) pixels to the nearest one marked; large where none is."""
    if not marked.any():
        return np.full(marked.shape, 1e6, np.float32)
    return np.asarray(distance_transform_edt(~marked), np.float32)
