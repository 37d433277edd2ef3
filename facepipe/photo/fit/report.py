"""What a photo fit found, as it was authored, and as text."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.atomic import write_bytes
from facepipe.core.reports import Report, not_in_json, table
from facepipe.geometry.colors import to_srgb
from facepipe.geometry.landmarks import eye_distance
from facepipe.geometry.polygons import point_areas, point_normals, point_triangles
from facepipe.geometry.rasterise import rasterise, screen_triangles
from facepipe.networks.masks import face_mask
from facepipe.parts import FaceParts, Material, Mesh, Slider, TextureInput
from facepipe.photo.fit.landmark_file import write_landmarks
from facepipe.photo.fit.person_model import SCHEME
from facepipe.photo.pictures import photo_pictures as pictures
from facepipe.photo.pictures.photo_report import photo_page
from facepipe.pictures import save_png
from facepipe.pictures.occlusion import visible_sky
from facepipe.rig import Rig, build, slide

if TYPE_CHECKING:
    from facepipe.photo.descent.subject import FittedView, PhotoFit, Stopped
    from facepipe.photo.features.extractor import Extractor
    from facepipe.photo.fit.fit_face import Fitted
    from facepipe.photo.fit.person_model import IdentityReport
    from facepipe.photo.fit.photo_file import Photo
    from facepipe.photo.pictures.photo_report import PhotoSheet, SheetPhoto
    from facepipe.photo.renderer.face_model import FaceModel

ENDS = {
    "iterations": "all steps made",
    "loss-threshold": "ended at the loss asked for",
    "not-finite": "ended by a loss that was not finite",
}
_SHOWN = 5  # names of a list
_HIDDEN = 0.5  # share of a region from which on it is named
_OFF = 0.01  # of a slider's range, or a weight: what counts as set
_OVERLAY = 1024  # pixels of an overlay's longer side
_MARK = 1 / 120  # of the landmarks' larger extent, the radius of one
_LEAST = 1.5  # pixels of that
_SIDE = 512  # pixels of a photo's longer side that are looked through
_SLACK = 0.03  # of the eyes' distance: a point so far behind what is nearest still shows
_SKY_RESOLUTION = 256  # map pixels
_OPEN = 0.15  # share of the sky: insides of mouth, nostrils and eye sockets see less
_FACE = 0.5  # share of a pixel
_AT_LIMIT = 0.005  # of a slider's range


def as_text(out: Path, report: PhotoFitReport, sliders: Sequence[Slider]) -> str:
    """How near each photo is, and what was found."""
    count = len(report.photos)
    total = report.losses.get("total")
    loss = f", loss {total.first:.4g} to {total.last:.4g}" if total and report.steps else ""
    steps = f"{report.steps} steps in {report.seconds:.1f} s"
    head = f"{out}: {count} photo{'s' * (count != 1)}, {steps}, {ENDS[report.stopped]}{loss}"
    judged = any(value is not None for value in report.similarities.values())
    titles = [
        "landmarks off by",
        "pixels",
        "of the outer eye corners' distance",
        *["similarity"] * judged,
        "expression",
    ]
    rows: list[list[object]] = [[*titles]]
    for name, photo in report.photos.items():
        alike = [] if not judged else ["none" if photo.similarity is None else f"{photo.similarity:.3f}"]
        figures = (f"{photo.landmark_error_px:.2f}", f"{percent(photo):.1f} %", *alike)
        rows.append([name, *figures, _largest(photo.expressions, {})])
    ranges = {slider.name: slider for slider in sliders}
    off = {name: value - ranges[name].default for name, value in report.sliders.items()}
    spans = {name: ranges[name].maximum - ranges[name].minimum for name in off}
    moved = sum(abs(value) > _OFF * spans[name] for name, value in off.items())
    last = f"{moved} of {len(off)} sliders off their defaults: {_largest(off, spans, report.sliders)}"
    lines = [head, table(rows), last]
    if report.identity is not None:
        lines.append(
            f"sliders leave {report.identity.beyond_sliders_mean_mm:.2f} mm of the person (mean), at most "
            f"{report.identity.beyond_sliders_max_mm:.2f} mm, which is in the neutral"
        )
    if judged and report.similarity_fitted:
        lines.append("the similarity is to a network that the fit was drawn to: --identity 0 keeps them apart")
    if report.at_limit:
        lines.append(f"sliders at a limit: {_some(report.at_limit)}")
    hidden = [f"{name} {share:.0%}" for name, share in report.unseen.items() if share >= _HIDDEN]
    if hidden:
        lines.append(f"no photo shows: {', '.join(hidden)}")
    if report.beyond_limits:
        lines.append(f"beyond bone limits: {_some(report.beyond_limits)}")
    return "\n".join(lines)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")


def _largest(off: Mapping[str, float], spans: Mapping[str, float], values: Mapping[str, float] | None = None) -> str:
    """The names that are furthest off, with their values."""
    shares = {name: abs(value) / max(spans.get(name, 1.0), 1e-9) for name, value in off.items()}
    order = sorted((name for name, share in shares.items() if share > _OFF), key=lambda name: (-shares[name], name))
    shown = ", ".join(f"{name} {(values or off)[name]:.2f}" for name in order[:_SHOWN])
    return (shown + (", ..." if len(order) > _SHOWN else "")) or "none"


@dataclass(frozen=True, kw_only=True)
class PhotoReport:
    """One photo."""

    animation: str  # the pose of the face in the photo; its camera has the same name
    size: tuple[int, int]  # width and height of the photo as it was fitted
    expressions: Mapping[str, float]  # shape -> weight, beside what sliders drive
    landmark_error_px: float  # mean distance of the face's landmarks from the photo's
    eye_distance_px: float  # between the outer corners of the eyes in the photo
    similarity: float | None = None  # of photo and render to the identity network given: cosine, 1 for the same person


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


def off_landmarks(report: PhotoFitReport, threshold: float) -> list[str]:
    """A line for each photo whose landmarks are off by more than `threshold` percent."""
    return [
        f"{name}: landmarks off by {percent(photo):.1f} % of the distance of the outer eye corners, "
        f"expected at most {threshold:g} %"
        for name, photo in report.photos.items()
        if percent(photo) > threshold
    ]


def unlike(similarities: Mapping[str, float | None], threshold: float | None) -> list[str]:
    """A line for each photo that the face is less like than a threshold."""
    return [
        f"{name}: similarity of {'no number' if value is None else f'{value:.3f}'}, expected at least {threshold:g}"
        for name, value in similarities.items()
        if threshold is not None and (value is None or value < threshold)
    ]


def implausible(report: PhotoFitReport) -> list[str]:
    """A line where the person is like hardly anyone."""
    identity = report.identity
    if identity is None or identity.deviations <= identity.usual:
        return []
    found = f"{identity.deviations:.2f} standard deviations (root mean square over {identity.modes} modes)"
    return [f"the person is {found} from the average, expected at most {identity.usual:.2f}"]


def percent(photo: PhotoReport) -> float:
    """The mean landmark error, percent of the distance of the outer eye corners."""
    return 100 * photo.landmark_error_px / max(photo.eye_distance_px, 1e-9)


def loss_ends(history: Sequence[Mapping[str, float]]) -> dict[str, Loss]:
    """First and last value of each term, by name; steps with a loss that is not finite don't count."""
    ends: dict[str, Loss] = {}
    for step in history:
        if np.isfinite([float(one) for one in step.values()]).all():
            for name, value in step.items():
                first = ends[name].first if name in ends else float(value)
                ends[name] = Loss(first=first, last=float(value))
    return {name: ends[name] for name in sorted(ends)}


def report_sheet(parts: FaceParts, fit: PhotoFit, photos: Sequence[Photo]) -> PhotoSheet:
    """What `facepipe.pictures.photo_page` shows of a fit.

    :param parts: the face that was fitted, without the result
    :param photos: that were fitted, one a view
    :raises InputError: sliders, shapes or materials that the face does not have
    """
    from facepipe.photo.pictures.photo_report import PhotoSheet
    from facepipe.photo.renderer.face_model import FaceModel

    tinted = replace(
        parts, materials=tuple(_tinted(material, fit.tint.get(material.name)) for material in parts.materials)
    )
    rig, model = build(tinted), FaceModel(tinted)
    return PhotoSheet(
        parts=tinted,
        neutral=fitted_points(rig, tinted, fit),
        photos=tuple(_photo(rig, tinted, fit, model, *one) for one in zip(photos, fit.views, strict=True)),
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


def _photo(rig: Rig, parts: FaceParts, fit: PhotoFit, model: FaceModel, photo: Photo, view: FittedView) -> SheetPhoto:
    from facepipe.geometry.landmarks import eye_distance
    from facepipe.photo.descent.working_photo import project, view_image
    from facepipe.photo.pictures.photo_report import SheetPhoto

    points = fitted_points(rig, parts, fit, view)
    height, width = photo.pixels.shape[:2]
    return SheetPhoto(
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


def _tinted(material: Material, tint: tuple[float, float, float] | None) -> Material:
    """The material with its colour multiplied."""
    color = material.diffuse_color
    if tint is None:
        return material
    if not isinstance(color, TextureInput):
        return replace(material, diffuse_color=_product(color, tint))
    scale, bias = ((*_product(each[:3], tint), each[3]) for each in (color.scale, color.bias))
    return replace(material, diffuse_color=replace(color, scale=scale, bias=bias))


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
        save_png(overlay_image(one, sheet), folder / f"{name}.overlay.png")
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


def overlay_image(photo: SheetPhoto, sheet: PhotoSheet) -> Image.Image:
    """The photo, darker, with the edges of the fitted face, its landmarks, and those that it was given as rings."""
    height, width = photo.photo.shape[:2]
    crop = pictures.whole(width, height, _OVERLAY)
    image = pictures.wireframe_picture(photo.photo, crop, sheet.parts, photo.screen)
    given, fitted = crop.place(photo.targets), crop.place(photo.landmarks)
    radius = max(_LEAST, _MARK * float(np.ptp(given, axis=0).max()))
    pictures.given_mark(image, given, radius)
    pictures.fitted_mark(image, fitted, radius)
    (left, top), (right, bottom) = np.rint(crop.place(np.array([(0.0, 0.0), (width, height)]))).astype(int).tolist()
    return image.crop((left, top, max(right, left + 1), max(bottom, top + 1)))


def with_similarities(report: PhotoFitReport, fitted: Fitted, network: Extractor) -> PhotoFitReport:
    """The report with how like each photo the render in its camera and light is."""
    from facepipe.photo.features.extractor import similarity

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
    from facepipe.photo.descent.working_photo import project

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
