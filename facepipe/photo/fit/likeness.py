"""How like its photos a fitted face is to a recognition network, and what of the face no photo shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.landmarks import eye_distance
from facepipe.geometry.polygons import point_areas, point_normals, point_triangles
from facepipe.geometry.rasterise import rasterise, screen_triangles
from facepipe.networks.masks import face_mask
from facepipe.parts import FaceParts, Mesh, Slider
from facepipe.photo.fit.person_model import SCHEME
from facepipe.pictures.occlusion import visible_sky
from facepipe.rig import build

if TYPE_CHECKING:
    from facepipe.photo.features.extractor import Extractor
    from facepipe.photo.fit.fit_face import Fitted
    from facepipe.photo.fit.report import PhotoFitReport

_SIDE = 512  # pixels of a photo's longer side that are looked through
_SLACK = 0.03  # of the eyes' distance: a point so far behind what is nearest still shows
_SKY_RESOLUTION = 256  # map pixels
_OPEN = 0.15  # share of the sky: insides of mouth, nostrils and eye sockets see less
_FACE = 0.5  # share of a pixel
_AT_LIMIT = 0.005  # of a slider's range


def with_similarities(report: PhotoFitReport, fitted: Fitted, network: Extractor) -> PhotoFitReport:
    """The report with how like each photo the render in its camera and light is."""
    from facepipe.photo.features.likeness import similarity

    photos = {
        name: replace(photo, similarity=similarity(network, shown.photo, shown.render, shown.targets))
        for (name, photo), shown in zip(report.photos.items(), fitted.sheet.photos, strict=True)
    }
    return replace(report, photos=photos)


def sliders_at_limit(sliders: Sequence[Slider], report: PhotoFitReport) -> tuple[str, ...]:
    """Those that the fit moved from their default to an end of their range."""
    names = []
    for slider in sliders:
        value, reach = report.sliders.get(slider.name, slider.default), slider.maximum - slider.minimum
        end = min(value - slider.minimum, slider.maximum - value) <= _AT_LIMIT * reach
        if end and abs(value - slider.default) > _AT_LIMIT * reach:
            names.append(slider.name)
    return tuple(names)


def unseen_regions(fitted: Fitted) -> dict[str, float]:
    """Region -> share of its outside that no photo shows: turned away, cut off, or behind hair, glasses or hands.

    What hides it may be another part of the face too.
    """
    from facepipe.photo.descent.view_image import project
    from facepipe.photo.fit.report_folder import fitted_points

    parts = fitted.parts
    skin = next(mesh for mesh in parts.meshes if SCHEME in mesh.landmarks)
    if not skin.regions:
        return {}
    first = sum(len(mesh.points) for mesh in parts.meshes[: parts.meshes.index(skin)])
    span, triangles = slice(first, first + len(skin.points)), _triangles(parts, skin)
    rig = build(parts)
    neutral = fitted_points(rig, parts, fitted.fit)
    shown = np.zeros(len(skin.points), bool)
    for photo, view in zip(fitted.inputs.photos, fitted.fit.views, strict=True):
        height, width = photo.pixels.shape[:2]
        share = min(1.0, _SIDE / max(width, height))
        screen = project(view.camera, fitted_points(rig, parts, fitted.fit, view)) * [share, share, 1.0]
        slack = _SLACK * eye_distance(view.targets) * float(np.median(screen[span, 2])) / view.camera.focal
        front = _in_front(screen, triangles, (round(width * share), round(height * share)), slack)[span]
        mask = face_mask(photo.pixels, view.targets).face
        column, row = np.clip(screen[span, :2] / share, 0, (width - 1, height - 1)).astype(np.int64).T
        shown |= front & (mask[row, column] > _FACE)
    normals = point_normals(neutral, triangles)
    sky = visible_sky(neutral, normals, triangles, np.zeros(len(neutral), bool), _SKY_RESOLUTION).share(normals)
    own = point_triangles(skin.face_vertex_counts, skin.face_vertex_indices)
    # What lies inside, as the mouth's, no photo can show: it would count as unseen for ever.
    areas = point_areas(neutral[span], own) * (sky[span] > _OPEN)
    weights = {name: np.asarray(values) * areas for name, values in skin.regions.items()}
    return {name: float(each[~shown].sum() / each.sum()) for name, each in sorted(weights.items()) if each.sum() > 0}


def _triangles(parts: FaceParts, skin: Mesh) -> IntArray:
    """(t, 3) of the skin and of other meshes that let no light through."""
    opacity = {material.name: material.opacity for material in parts.materials}
    first, kept = 0, []
    for mesh in parts.meshes:
        if mesh is skin or opacity.get(mesh.material or "", 1.0) == 1.0:
            kept.append(first + point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices))
        first += len(mesh.points)
    return np.concatenate(kept)


def _in_front(screen: FloatArray, triangles: IntArray, size: tuple[int, int], slack: float) -> BoolArray:
    """(n,) points of a picture with nothing before them.

    :param screen: (n, 3) pixels and depths
    :param slack: in depth
    """
    depth = screen[:, 2]
    flat = np.column_stack([screen[:, :2] * depth[:, None], np.ones(len(screen)), depth])
    raster = rasterise(screen_triangles(flat, triangles), *size)
    nearest = 1 / np.maximum(raster.nearness, 1e-12)
    inside = (depth > 0) & (screen[:, :2] >= 0).all(axis=1) & (screen[:, :2] < size).all(axis=1)
    column, row = np.clip(screen[:, :2], 0, np.array(size) - 1).astype(np.int64).T
    return np.asarray(inside & (depth <= nearest[row, column] + slack))
