"""A face beside the scan that it was fitted to, and the distances between the two."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.coarse_surface import disc_look
from facepipe.parts import FaceParts, Mesh
from facepipe.pictures import overlay
from facepipe.pictures.camera import Camera, Frame, View, portrait
from facepipe.pictures.face_picture import PictureOptions, picture
from facepipe.pictures.heatmap import HeatMap
from facepipe.pictures.overlay import contact_sheet
from facepipe.scans import Scan

if TYPE_CHECKING:
    from PIL.Image import Image


_VIEWS: tuple[View, ...] = ("front", (-0.66, 0.07))  # the face looks to the colour bar's side, the neck away from it
_MARGIN = np.array([0.62, 0.62, 0.5])  # of the landmarks' size, to either side: what is looked at
_ROUND = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_DISC = 0.7  # of the way to the next points: radius of what is drawn for a point of a cloud
_NEIGHBOURS = 6
_CLEAR = 0.5  # opacity of what a scanner looks through


@dataclass(frozen=True, kw_only=True)
class FitPicture:
    """A face and its scan in one place: millimetres, Y up."""

    parts: FaceParts  # meshes at the fitted points
    landmarks: FloatArray  # (l, 3) of the face, which set what to look at
    scan: Scan
    distances: FloatArray  # (n,) mm of all points from the scan, NaN where it doesn't show them
    neutral: FaceParts | None = None  # where the scan shows more than it: drawn last
    largest_mm: float | None = None  # of the heat map; None: a round number that few distances are beyond
    size: int = 400  # pixels a picture


def fit_sheet(fit: FitPicture) -> Image:
    """Scan, face and distances, from the front and from between front and side; then the neutral, where it differs.

    Faces are without their clear parts (tears, lashes), which no scan shows.

    :raises InputError: points or distances that don't fit, or a size out of range
    """
    scan = scan_parts(fit.scan)
    known = fit.distances[np.isfinite(fit.distances)]
    mean = f", mean {known.mean():.2f} mm" if len(known) else ""
    fitted, distances = opaque(fit.parts, fit.distances)
    heat = HeatMap(values=distances, range=(0.0, fit.largest_mm or round_above(known)))
    images = []
    for view in _VIEWS:
        options = PictureOptions(size=fit.size, camera=_camera(fit, view, 0))
        beside = replace(options, heatmap=heat, camera=_camera(fit, view, overlay.bar_width(fit.size)))
        images += [
            (f"scan {fit.scan.name}", picture(scan, None, options)),
            ("fitted", picture(fitted, None, options)),
            (f"distance from the scan{mean}", picture(fitted, None, beside)),
        ]
        images += (
            [] if fit.neutral is None else [("neutral", picture(opaque(fit.neutral, fit.distances)[0], None, options))]
        )
    return contact_sheet(images, columns=len(images) // len(_VIEWS))


def opaque(parts: FaceParts, values: FloatArray) -> tuple[FaceParts, FloatArray]:
    """A face without meshes that are nearly clear, and the values of its points (n,) that are left.

    :raises InputError: another number of values
    """
    clear = {one.name for one in parts.materials if isinstance(one.opacity, float) and one.opacity < _CLEAR}
    seen = [
        not ({one.material for one in mesh.material_faces} or {mesh.material or ""}) <= clear for mesh in parts.meshes
    ]
    kept = np.repeat(seen, [len(mesh.points) for mesh in parts.meshes])
    if len(values) != len(kept):
        raise InputError("heat map", f"{len(values)} values, expected one for each of {len(kept)} points")
    meshes = tuple(mesh for mesh, there in zip(parts.meshes, seen, strict=True) if there)
    return replace(parts, meshes=meshes, sliders=()), values[kept]


def round_above(known: FloatArray) -> float:
    """A round number of millimetres that 98 % of the distances are below."""
    wanted = float(np.percentile(known, 98)) if len(known) else 1.0
    return next((one for one in _ROUND if one >= wanted), _ROUND[-1])


def _camera(fit: FitPicture, view: View, right: int) -> Camera:
    """A camera on the face, with room for a bar of `right` pixels."""
    middle = (fit.landmarks.min(axis=0) + fit.landmarks.max(axis=0)) / 2
    half = np.ptp(fit.landmarks, axis=0) * _MARGIN
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    return portrait(middle + corners * half, view, Frame(width=fit.size, height=fit.size, right=right))


def scan_parts(scan: Scan) -> FaceParts:
    """A scan as a face, for the renderer; small discs for a cloud."""
    points, triangles = scan.points, scan.triangles
    if scan.is_cloud:
        from scipy.spatial import cKDTree

        apart = cKDTree(points).query(points, k=_NEIGHBOURS + 1)[0][:, 1:].mean(axis=1)
        look = disc_look(points, np.asarray(scan.normals), _DISC * apart, None)
        points, triangles = look.points, look.triangles
    mesh = Mesh(
        name="Scan",
        points=points,
        face_vertex_counts=np.full(len(triangles), 3, np.int32),
        face_vertex_indices=np.asarray(triangles, np.int32).ravel(),
        double_sided=True,
    )
    return FaceParts(name="Scan", meters_per_unit=0.001, up_axis="Y", meshes=(mesh,))
