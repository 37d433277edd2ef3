"""Depth maps of photos: found with each neighbour, merged, and kept where other photos see the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.scanning.photos.cameras import PhotoCamera
from facepipe.scanning.photos.photos import Photo
from facepipe.scanning.photos.stereo import depth_map, disparities, rectify
from facepipe.scanning.photos.structure import Structure
from facepipe.scanning.photos.subject import Subject

_WINDOW = 5  # pixels a side where contrast is measured
_EVERY = 2  # row and column of a depth map becomes a point: the photos show each place of the skin many times


@dataclass(frozen=True, kw_only=True)
class Seen:
    """Points that one photo shows, and that others confirm."""

    points: FloatArray  # (n, 3)
    pixels: IntArray  # (n, 2) column and row
    apart: FloatArray  # (n,) median distance from the others' surfaces along the view, scan units


def depth_maps(
    photos: Sequence[Photo],
    structure: Structure,
    pairs: Sequence[tuple[int, int]],
    agreement: float,
    texture: float,
    step: Callable[[], None],
) -> list[FloatArray]:
    """(h, w) float32 depth along the axis of every camera, NaN where unknown.

    :param photos: in the order of the cameras
    :param pairs: of cameras
    :param agreement: widths of a pixel by which depths may differ that agree
    :param texture: levels of 255: contrast that a place needs to be matched
    :param step: called before every pair
    """
    cameras = list(structure.cameras.values())
    depths: list[list[FloatArray]] = [[] for _ in cameras]
    maps = [np.full((camera.height, camera.width), np.nan, np.float32) for camera in cameras]
    last = {camera: number for number, pair in enumerate(pairs) for camera in pair}
    for number, (a, b) in enumerate(pairs):
        step()
        pair, swapped = rectify(cameras[a], cameras[b], structure.points)
        left, right = (b, a) if swapped else (a, b)
        both = disparities(pair, photos[left].pixels, photos[right].pixels)
        for camera, view, disparity in zip((left, right), (pair.left, pair.right), both, strict=True):
            depth = depth_map(pair, view, disparity, pixel_rays(cameras[camera]))
            depths[camera].append(depth.astype(np.float32))
            if last[camera] == number:  # merged as soon as all are there: together they are large
                merged = _merged(depths[camera], agreement / cameras[camera].focal[0])
                known = merged.reshape(maps[camera].shape)
                maps[camera] = np.where(_usable(photos[camera], texture), known, np.float32(np.nan))
                depths[camera] = []
    return maps


def pixel_rays(camera: PhotoCamera) -> FloatArray:
    """(h * w, 3) rays with z = 1 through the middles of all pixels, row by row."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    flat = camera.rays(np.stack([columns.ravel(), rows.ravel()], axis=1))
    return np.column_stack([flat, np.ones(len(flat))])


def _usable(photo: Photo, texture: float) -> BoolArray:
    """(h, w) what the mask shows, without plain places: there the matcher only goes on with what is around.

    A place beside a plain one is no place either, or surfaces would grow into the backdrop by a strip.
    """
    import cv2

    grey = cv2.cvtColor(photo.pixels, cv2.COLOR_RGB2GRAY).astype(np.float32)
    mean = cv2.blur(grey, (_WINDOW, _WINDOW))
    variance = cv2.blur(grey * grey, (_WINDOW, _WINDOW)) - mean * mean
    rich = cv2.erode((variance >= texture**2).astype(np.uint8), np.ones((_WINDOW, _WINDOW), np.uint8)) > 0
    return np.asarray(rich if photo.mask is None else rich & photo.mask)


def _merged(depths: Sequence[FloatArray], share: float) -> FloatArray:
    """(n,) the mean of the depths (n,) that most others agree with, to a share of the depth; NaN where none do.

    A single depth stands where no other is known.
    """
    stack = np.stack(depths)
    best, votes = np.full(stack.shape[1], np.nan, np.float32), np.zeros(stack.shape[1], np.int64)
    known = np.isfinite(stack).sum(axis=0)
    for one in stack:
        near = np.abs(stack - one) <= share * one
        count = near.sum(axis=0)
        mean = np.where(near, stack, 0.0).sum(axis=0) / np.maximum(count, 1)
        better = count > votes
        best[better], votes[better] = mean[better], count[better]
    return np.where((votes >= 2) | (known == 1), best, np.float32(np.nan))


def confirmed(
    number: int,
    maps: Sequence[FloatArray],
    cameras: Sequence[PhotoCamera],
    subject: Subject,
    agreement: float,
    support: int,
) -> Seen:
    """The points of one photo's depth map that lie in the subject and in `support` other depth maps or more."""
    camera, depth = cameras[number], maps[number]
    rows, columns = _EVERY * np.array(np.nonzero(np.isfinite(depth[::_EVERY, ::_EVERY])))
    pixels = np.stack([columns, rows], axis=1)
    points = _placed(camera, pixels, depth[rows, columns])
    inside = subject.holds(points)
    points, pixels = points[inside], pixels[inside]
    gaps = np.full((len(cameras), len(points)), np.nan, np.float32)
    for other, one in enumerate(cameras):
        if other != number:
            gaps[other] = _gaps(points, one, maps[other])
    # depth over focal length is a pixel's width there: one tolerance in pixels serves near and far points
    width = agreement * camera.to_camera(points)[:, 2] / camera.focal[0]
    near = np.abs(gaps) <= width
    kept = near.sum(axis=0) >= support
    gaps = np.where(near, np.abs(gaps), np.nan)[:, kept]
    apart = np.nanmedian(gaps, axis=0) if gaps.shape[1] else np.zeros(0)
    return Seen(points=points[kept], pixels=pixels[kept], apart=np.asarray(apart))


def _placed(camera: PhotoCamera, pixels: IntArray, depth: FloatArray) -> FloatArray:
    """(n, 3) points at the middles of pixels (n, 2)."""
    rays = camera.rays(pixels + 0.5)
    local = np.c_[rays, np.ones(len(rays))] * depth[:, None]
    return np.asarray((local - camera.translation) @ camera.rotation)


def _gaps(points: FloatArray, camera: PhotoCamera, depth: FloatArray) -> FloatArray:
    """(n,) how far points lie behind the depth map of a camera; NaN where it has no depth."""
    where = camera.project(points)
    inside = np.isfinite(where).all(axis=1) & (where >= 0).all(axis=1)
    inside &= (where[:, 0] < camera.width) & (where[:, 1] < camera.height)
    column, row = np.where(inside[:, None], where, 0.0).astype(np.int64).T
    return np.where(inside, camera.to_camera(points)[:, 2] - depth[row, column], np.nan)
