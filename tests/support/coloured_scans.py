"""Coloured scans of known people of the built-in head, whom its modes can't show: skin, brows and lashes as seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scan_simulator import retriangulated
from smooth_fields import smooth_field

from facepipe.geometry.coarse_surface import surface_look
from facepipe.geometry.colors import from_srgb
from facepipe.geometry.pinhole import Pinhole
from facepipe.geometry.polygons import point_triangles
from facepipe.heads.assembly import average, modes, with_own_lids, with_parts_fitted
from facepipe.heads.asset import asset
from facepipe.heads.people import draw
from facepipe.heads.surfaces import dressed
from facepipe.parts import FaceParts
from facepipe.pictures import PictureOptions
from facepipe.pictures.camera import Camera
from facepipe.pictures.face_picture import pictures
from facepipe.pictures.lighting import EVEN
from facepipe.pictures.surface_view import draw_surface
from facepipe.scanning.rebuild.template import seen_from_outside
from facepipe.scans import Scan
from facepipe.verbs.author_neutral import AuthorNeutral

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

_CM = 10.0  # millimetres
_WARP, _WARP_LENGTH = 2.0, 80.0  # mm: RMS of what no mode holds, as much as real people have, and its wavelength
_NOISE = 0.05  # mm
_PIXELS, _TEXELS = 700, 1024
_YAWS = (0.0, 0.6, -0.6, 1.2, -1.2)
_RADIUS, _DEPTH = 13.0, 0.08  # cm: of what pictures show, and behind what is seen that still counts as seen


def coloured_scan(seed: int) -> tuple[Scan, FloatArray]:
    """A scan in millimetres, upright, and where the points (n, 3) of the built-in head truly are on it."""
    rng = np.random.default_rng([seed, 7])
    person = asset().points + np.tensordot(rng.standard_normal(len(modes())), modes(), axes=1)
    warp = _WARP / np.sqrt(3.0) * smooth_field(_CM * asset().points, _WARP_LENGTH, 3, rng)
    truth = with_parts_fitted(person + warp / _CM)
    bare = with_own_lids(AuthorNeutral().changed(average(), _CM * truth), truth)
    parts = dressed(bare, replace(draw(seed).look, style="crop"), _TEXELS)
    parts = replace(parts, meshes=tuple(mesh for mesh in parts.meshes if mesh.name != "Hair"))
    points, triangles = retriangulated(*_surface(parts), rng)
    colors = _colors(parts, points, triangles)
    outside = seen_from_outside(points, triangles)
    used, triangles = np.unique(triangles[outside[triangles].all(axis=1)], return_inverse=True)
    noisy = _CM * points[used] + _NOISE * rng.standard_normal((len(used), 3))
    return Scan(name="person", points=noisy, triangles=triangles.reshape(-1, 3), colors=colors[used]), _CM * truth


def _surface(parts: FaceParts) -> tuple[FloatArray, IntArray]:
    """Points and triangles of skin and eyeballs, which scanners see."""
    points, triangles, start = [], [], 0
    for mesh in parts.meshes:
        if mesh.name == "Head" or mesh.name.startswith("Eyeball"):
            points.append(np.asarray(mesh.points, np.float64))
            triangles.append(start + point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices))
            start += len(mesh.points)
    return np.concatenate(points), np.concatenate(triangles)


def _colors(parts: FaceParts, points: FloatArray, triangles: IntArray) -> FloatArray:
    """(n, 3) linear, from pictures in even light."""
    look = surface_look(points, triangles, None)
    marks = np.asarray(parts.meshes[0].points)[asset().landmarks]
    views = [_view(marks.mean(axis=0), yaw) for yaw in _YAWS]
    cameras = [Camera(axes=one.axes, eye=one.eye, focal=one.focal, center=(_PIXELS / 2,) * 2) for one in views]
    options = [PictureOptions(size=_PIXELS, samples=2, studio=EVEN, camera=camera) for camera in cameras]
    total, weight = np.zeros((len(points), 3)), np.full((len(points), 1), 1e-9)
    for view, image in zip(views, pictures(parts, None, options), strict=True):
        places, far = view.project(points)
        column, row = np.clip(places.astype(np.int64), 0, _PIXELS - 1).T
        towards = (view.eye - points) / np.linalg.norm(view.eye - points, axis=1, keepdims=True)
        facing = np.maximum(np.einsum("ni,ni->n", towards, look.normals), 0.0)
        seen = ((places >= 0) & (places < _PIXELS)).all(axis=1) & (
            far < draw_surface(look, view)[1][row, column] + _DEPTH
        )
        share = (seen * facing**4)[:, None]
        total += share * from_srgb(np.asarray(image.convert("RGB"))[row, column] / 255.0)
        weight += share
    return np.asarray(total / weight)


def _view(middle: FloatArray, yaw: float) -> Pinhole:
    backward, right = np.array([np.sin(yaw), 0.0, np.cos(yaw)]), np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    return Pinhole.around(middle, np.stack([right, np.cross(backward, right), backward]), _RADIUS, _PIXELS)
