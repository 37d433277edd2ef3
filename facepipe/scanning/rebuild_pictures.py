"""Pictures of a rebuild: registered faces beside their scans, and shapes by how far they have changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.coarse_surface import disc_look
from facepipe.parts import FaceParts, Mesh
from facepipe.pictures import overlay
from facepipe.pictures.camera import Camera, View, portrait
from facepipe.pictures.face_picture import PictureOptions, picture, pictures
from facepipe.pictures.lighting import PORTRAIT
from facepipe.pictures.overlay import PAPER, HeatMap, contact_sheet
from facepipe.scans import Scan

if TYPE_CHECKING:
    from PIL.Image import Image

_FIT_VIEWS: tuple[View, ...] = (
    "front",
    (-0.66, 0.07),
)  # the face looks to the colour bar's side, the neck away from it
_MARGIN = np.array([0.62, 0.62, 0.5])  # of the landmarks' size, to either side: what is looked at
_ROUND = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_DISC = 0.7  # of the way to the next points: radius of what is drawn for a point of a cloud
_NEIGHBOURS = 6
_CLEAR = 0.5  # opacity of what a scanner looks through
_MOST, _SHAPE_PIXELS = 12, 300  # changed shapes that are drawn, and the size of each picture
# The face's left shows from the right of the picture: a face that turns its head from left to right.
_VIEWS: tuple[View, ...] = ((-0.66, 0.05), (0.0, 0.0), (0.66, 0.05))
_GAP = 10  # pixels
_SAMPLES = 2
# The key stands nearer to the camera than in a portrait: its shadow marks holes, but does not hide a cheek.
_STUDIO = replace(PORTRAIT, boxes=(replace(PORTRAIT.boxes[0], direction=(-0.42, 0.45, 0.95)), *PORTRAIT.boxes[1:]))


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
    """
    scan = _scan_parts(fit.scan)
    known = fit.distances[np.isfinite(fit.distances)]
    mean = f", mean {known.mean():.2f} mm" if len(known) else ""
    fitted, distances = _opaque(fit.parts, fit.distances)
    heat = HeatMap(values=distances, range=(0.0, fit.largest_mm or round_above(known)))
    images = []
    for view in _FIT_VIEWS:
        options = PictureOptions(size=fit.size, camera=_camera(fit, view, 0))
        beside = replace(options, heatmap=heat, camera=_camera(fit, view, overlay.bar_width(fit.size)))
        images += [
            (f"scan {fit.scan.name}", picture(scan, None, options)),
            ("fitted", picture(fitted, None, options)),
            (f"distance from the scan{mean}", picture(fitted, None, beside)),
        ]
        if fit.neutral is not None:
            images.append(("neutral", picture(_opaque(fit.neutral, fit.distances)[0], None, options)))
    return contact_sheet(images, columns=len(images) // len(_FIT_VIEWS))


def _opaque(parts: FaceParts, values: FloatArray) -> tuple[FaceParts, FloatArray]:
    """A face without meshes that are nearly clear, and the values of its points (n,) that are left."""
    clear = {
        material.name
        for material in parts.materials
        if isinstance(material.opacity, float) and material.opacity < _CLEAR
    }
    seen = [
        not ({material_face.material for material_face in mesh.material_faces} or {mesh.material or ""}) <= clear
        for mesh in parts.meshes
    ]
    kept = np.repeat(seen, [len(mesh.points) for mesh in parts.meshes])
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
    return portrait(middle + corners * half, view, fit.size, fit.size, right)


def _scan_parts(scan: Scan) -> FaceParts:
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


def turntable(
    parts: FaceParts, scan: Scan, distances: FloatArray, largest_mm: float, framing: FloatArray, size: int
) -> dict[str, Image]:
    """Scan, registered face and distances, each from the left, the front and the right; the face without its clear
    parts, which no scan shows. Face and scan are in one place: millimetres, Y up.

    :param parts: meshes at the registered points
    :param distances: (n,) mm of all points from the scan, NaN where it doesn't show them
    :param largest_mm: of the heat map
    :param framing: (k, 3) points that all pictures have inside
    :param size: pixels a picture
    """
    face, distances = _opaque(parts, distances)
    shown = {
        "scan": (_scan_parts(scan), None),
        "registered face": (face, None),
        "distance from the scan": (face, HeatMap(values=distances, range=(0.0, largest_mm))),
    }
    images = {}
    for name, (drawn, heat) in shown.items():
        studio = _STUDIO if heat is None else None
        several = [replace(_framed(framing, view, size), heatmap=heat, studio=studio) for view in _VIEWS]
        images[name] = _pasted(pictures(drawn, None, several), 1, 0)
    return images


def stacked(images: Sequence[Image]) -> Image:
    """Pictures of one width on top of each other."""
    return _pasted(images, 0, 1)


def _framed(framing: FloatArray, view: View, size: int) -> PictureOptions:
    camera = portrait(framing, view, size, size)
    return PictureOptions(size=size, camera=camera, samples=_SAMPLES, bar=False)


def _pasted(images: Sequence[Image], right: int, down: int) -> Image:
    from PIL import Image as Images

    width, height = images[0].size
    across, along = (width + _GAP) * right, (height + _GAP) * down
    last = len(images) - 1
    sheet = Images.new("RGB", (width + across * last, height + along * last), PAPER)
    for number, image in enumerate(images):
        sheet.paste(image, (across * number, along * number))
    return sheet


def most_changed(far: Mapping[str, float], most: int = _MOST) -> dict[str, float]:
    """At most `most` of the shapes that have changed, and how far each has (mm), from the largest distance down."""
    names = sorted((name for name in far if far[name] > 0.0), key=lambda name: -far[name])[:most]
    return {name: far[name] for name in names}


def changed_pictures(
    parts: FaceParts,
    faces: Mapping[str, tuple[FloatArray, FloatArray]],
    counted: IntArray,
    framing: FloatArray,
    size: int = _SHAPE_PIXELS,
) -> tuple[dict[str, Image], tuple[float, float]]:
    """Each shape at weight 1, painted with its distance from where it was; and the millimetres of the colours' ends.

    The scale is one for all: from 0 to a round number that nearly all distances are below.

    :param parts: meshes at the neutral, millimetres, Y up
    :param faces: shape -> (n, 3) points, and (n,) how far they are from where they were
    :param counted: points that show, by which shapes count as changed
    :param framing: (k, 3) points that all pictures have inside
    """
    known = np.concatenate([distances[counted] for _, distances in faces.values()])
    limits = 0.0, round_above(known[known > 0.0])
    options = _framed(framing, "front", size)
    images = {}
    for name, (points, distances) in faces.items():
        images[name] = picture(parts, points, replace(options, heatmap=HeatMap(values=distances, range=limits)))
    return images, limits
