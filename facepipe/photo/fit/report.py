"""What a photo fit found: its report, the page and the pictures of it, and which regions no photo shows."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from PIL import Image

from facepipe.core.arrays import FloatArray
from facepipe.core.atomic import write_bytes
from facepipe.core.reports import Report, not_in_json
from facepipe.geometry.colors import to_srgb
from facepipe.geometry.landmarks import eye_distance
from facepipe.geometry.polygons import point_areas, point_normals, point_triangles
from facepipe.geometry.rasterise import rasterise, screen_triangles
from facepipe.networks.files import face_mask
from facepipe.parts import FaceParts, TextureInput
from facepipe.photo import pictures
from facepipe.photo.fit.person_model import SCHEME
from facepipe.photo.fit.photo_landmarks import write_landmarks
from facepipe.photo.pictures import PhotoSheet, SheetPhoto, photo_page
from facepipe.pictures import save_png
from facepipe.pictures.occlusion import visible_sky
from facepipe.rig import Rig, build, slide

if TYPE_CHECKING:
    from facepipe.networks.onnx_file import Kind
    from facepipe.photo.descent.subject import FittedView, PhotoFit, Stopped
    from facepipe.photo.features.extractor import Extractor
    from facepipe.photo.fit.person_model import IdentityReport
    from facepipe.photo.fit.photo_file import Photo
    from facepipe.photo.fit.photo_landmarks import Landmarks68

ENDS = {
    "iterations": "all steps made",
    "loss-threshold": "ended at the loss asked for",
    "not-finite": "ended by a loss that was not finite",
}
_OVERLAY = 1024  # pixels of an overlay's longer side
_MARK = 1 / 120  # of the landmarks' larger extent, the radius of one
_LEAST = 1.5  # pixels of that
_SIDE = 512  # pixels of a photo's longer side that are looked through
_SLACK = 0.03  # of the eyes' distance: a point so far behind what is nearest still shows
_SKY_RESOLUTION = 256  # map pixels
_OPEN = 0.15  # share of the sky: insides of mouth, nostrils and eye sockets see less
_FACE = 0.5  # share of a pixel


@dataclass(frozen=True, kw_only=True)
class PhotoReport:
    """One photo."""

    animation: str  # the pose of the face in the photo; its camera has the same name
    size: tuple[int, int]  # width and height of the photo as it was fitted
    expressions: Mapping[str, float]  # shape -> weight, beside what sliders drive
    landmark_error_px: float  # mean distance of the face's landmarks from the photo's
    eye_distance_px: float  # between the outer corners of the eyes in the photo
    similarity: float | None = None  # of photo and render to the identity network given: cosine, 1 for the same person

    @property
    def percent(self) -> float:
        """The mean landmark error, percent of the distance of the outer eye corners."""
        return 100 * self.landmark_error_px / max(self.eye_distance_px, 1e-9)


@dataclass(frozen=True, kw_only=True)
class Loss:
    """A term of the joint loss, weighted."""

    first: float  # at the first step that had it
    last: float


@dataclass(frozen=True, kw_only=True)
class PhotoFitReport(Report):
    """What a photo fit did."""

    animation: str  # the neutral: the pose of the sliders alone
    sliders: Mapping[str, float]  # that were free
    photos: Mapping[str, PhotoReport]  # by file name
    steps: int
    stopped: Stopped
    losses: Mapping[str, Loss] = field(default_factory=dict)  # "total" and each term
    beyond_limits: tuple[str, ...] = ()  # "joint:channel" where the neutral is beyond the face's limits
    authored: tuple[str, ...] = ()
    seconds: float = 0.0
    identity: IdentityReport | None = None  # where the face has identity modes
    similarity_fitted: bool = False  # the network of the similarities was a term of the fit too
    unseen: Mapping[str, float] = field(default_factory=dict)  # region -> share of it that no photo shows
    at_limit: tuple[str, ...] = ()  # sliders
    fitted: Fitted = not_in_json()  # of the report of an action

    @property
    def similarities(self) -> dict[str, float | None]:
        """Of each photo."""
        return {name: photo.similarity for name, photo in self.photos.items()}

    @property
    def missed(self) -> bool:
        """Whether the fit ended before its time."""
        return self.stopped == "not-finite"


class PhotoInputs(NamedTuple):
    """What is fitted to."""

    photos: list[Photo]
    landmarks: list[Landmarks68]
    extractors: Mapping[Kind, Extractor]  # by kind of features
    warnings: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """A fit, for what is written of it."""

    parts: FaceParts  # of the face that was fitted
    fit: PhotoFit
    inputs: PhotoInputs

    @cached_property
    def sheet(self) -> PhotoSheet:
        """What the report page shows of it."""
        return report_sheet(self.parts, self.fit, self.inputs.photos)


def report_sheet(parts: FaceParts, fit: PhotoFit, photos: Sequence[Photo]) -> PhotoSheet:
    """What `facepipe.photo.pictures.photo_page` shows of a fit.

    :param parts: the face that was fitted, without the result
    :param photos: that were fitted, one a view
    :raises InputError: sliders, shapes or materials that the face does not have
    """
    from facepipe.photo.descent.working_photo import project, view_image
    from facepipe.photo.renderer.face_model import FaceModel

    # the tint goes into the materials, so that the neutral's pictures have it too
    materials = []
    for material in parts.materials:
        color, tint = material.diffuse_color, fit.tint.get(material.name)
        if tint is not None and isinstance(color, TextureInput):
            scale, bias = ((*_product(each[:3], tint), each[3]) for each in (color.scale, color.bias))
            material = replace(material, diffuse_color=replace(color, scale=scale, bias=bias))
        elif tint is not None and not isinstance(color, TextureInput):
            material = replace(material, diffuse_color=_product(color, tint))
        materials.append(material)
    tinted = replace(parts, materials=tuple(materials))
    rig, model, shown = build(tinted), FaceModel(tinted), []
    for photo, view in zip(photos, fit.views, strict=True):
        points = fitted_points(rig, tinted, fit, view)
        height, width = photo.pixels.shape[:2]
        sheet = SheetPhoto(
            name=photo.name,
            photo=photo.pixels,
            render=view_image(model, view, points, (width, height)),
            screen=project(view.camera, points),
            targets=np.asarray(view.targets),
            landmarks=np.asarray(view.landmarks),
            landmark_error=view.landmark_error,
            eye_distance=eye_distance(view.targets),
            expressions=view.expressions,
        )
        shown.append(sheet)
    return PhotoSheet(
        parts=tinted,
        neutral=fitted_points(rig, tinted, fit),
        photos=tuple(shown),
        sliders=fit.sliders,
        history=fit.history,
        kept=fit.kept,
        note=ENDS[fit.stopped],
    )


def fitted_points(rig: Rig, parts: FaceParts, fit: PhotoFit, view: FittedView | None = None) -> FloatArray:
    """(n, 3) world points of the neutral, or of the person in a view."""
    coefficients, weights = slide(parts.sliders, rig.joints, fit.sliders)
    for name, weight in (view.expressions if view else {}).items():
        weights[name] = weights.get(name, 0.0) + weight
    return rig.evaluate(weights, coefficients=coefficients)


def _product(color: tuple[float, float, float], tint: tuple[float, float, float]) -> tuple[float, float, float]:
    return color[0] * tint[0], color[1] * tint[1], color[2] * tint[2]


def write_folder(folder: Path, fitted: Fitted, report: PhotoFitReport) -> None:
    """Write report.html, report.json and, called as the poses of the photos, their renders, overlays and landmarks."""
    photos, names = fitted.inputs.photos, [one.animation for one in report.photos.values()]
    alike = [photo.similarity for photo in report.photos.values()]
    both = zip(fitted.sheet.photos, alike, strict=True)
    sheet = replace(
        fitted.sheet, photos=tuple(replace(photo, similarity=one) for photo, one in both), unseen=report.unseen
    )
    for name, one, photo, marks in zip(names, sheet.photos, photos, fitted.inputs.landmarks, strict=True):
        save_png(render_image(one.render), folder / f"{name}.render.png")
        # the photo, darker, with the edges of the fitted face, its landmarks, and those that it was given as rings
        height, width = one.photo.shape[:2]
        crop = pictures.whole(width, height, _OVERLAY)
        image = pictures.wireframe_picture(one.photo, crop, sheet.parts, one.screen)
        given, found = crop.place(one.targets), crop.place(one.landmarks)
        radius = max(_LEAST, _MARK * float(np.ptp(given, axis=0).max()))
        pictures.given_mark(image, given, radius)
        pictures.fitted_mark(image, found, radius)
        corners = crop.place(np.array([(0.0, 0.0), (width, height)]))
        (left, top), (right, bottom) = np.rint(corners).astype(int).tolist()
        overlay = image.crop((left, top, max(right, left + 1), max(bottom, top + 1)))
        save_png(overlay, folder / f"{name}.overlay.png")
        write_landmarks(folder / f"{name}.landmarks.json", marks, photo)
    write_bytes(folder / "report.html", photo_page(sheet))
    figures = report.to_dict()
    del figures["seconds"]  # the same input gives the same bytes
    write_bytes(folder / "report.json", f"{json.dumps(figures, sort_keys=True, indent=2)}\n".encode())


def render_image(render: FloatArray) -> Image.Image:
    """An 8-bit picture, transparent around the face, of linear colour on black and coverage (h, w, 4)."""
    cover = np.clip(render[..., 3:], 0, 1)
    color = to_srgb(np.clip(render[..., :3] / np.maximum(cover, 1e-6), 0, 1))
    return Image.fromarray((np.concatenate([color * (cover > 0), cover], axis=2) * 255 + 0.5).astype(np.uint8))


def unseen_regions(fitted: Fitted) -> dict[str, float]:
    """Region -> share of its outside that no photo shows: turned away, cut off, or behind hair, glasses or hands.

    What hides it may be another part of the face too.
    """
    from facepipe.photo.descent.working_photo import project

    parts = fitted.parts
    skin = next(mesh for mesh in parts.meshes if SCHEME in mesh.landmarks)
    if not skin.regions:
        return {}
    first = sum(len(mesh.points) for mesh in parts.meshes[: parts.meshes.index(skin)])
    span = slice(first, first + len(skin.points))
    opacity = {material.name: material.opacity for material in parts.materials}
    start, solid = 0, []
    for mesh in parts.meshes:
        # what lets light through hides nothing
        if mesh is skin or opacity.get(mesh.material or "", 1.0) == 1.0:
            solid.append(start + point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices))
        start += len(mesh.points)
    triangles, rig = np.concatenate(solid), build(parts)
    neutral = fitted_points(rig, parts, fitted.fit)
    shown = np.zeros(len(skin.points), bool)
    for photo, view in zip(fitted.inputs.photos, fitted.fit.views, strict=True):
        height, width = photo.pixels.shape[:2]
        share = min(1.0, _SIDE / max(width, height))
        screen = project(view.camera, fitted_points(rig, parts, fitted.fit, view)) * [share, share, 1.0]
        slack = _SLACK * eye_distance(view.targets) * float(np.median(screen[span, 2])) / view.camera.focal
        # points with nothing before them in the photo
        size, depth = (round(width * share), round(height * share)), screen[:, 2]
        flat = np.column_stack([screen[:, :2] * depth[:, None], np.ones(len(screen)), depth])
        nearest = 1 / np.maximum(rasterise(screen_triangles(flat, triangles), *size).nearness, 1e-12)
        inside = (depth > 0) & (screen[:, :2] >= 0).all(axis=1) & (screen[:, :2] < size).all(axis=1)
        column, row = np.clip(screen[:, :2], 0, np.array(size) - 1).astype(np.int64).T
        front = (inside & (depth <= nearest[row, column] + slack))[span]
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
