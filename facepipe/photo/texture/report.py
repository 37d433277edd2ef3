"""What was baked from photos."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from facepipe.core.arrays import Float32Array, FloatArray
from facepipe.core.atomic import write_bytes
from facepipe.core.images import open_image
from facepipe.core.markup import Markup, heading, joined, page, tag
from facepipe.core.reports import Report, not_in_json, table
from facepipe.parts import FaceParts, PhotoView, TextureInput
from facepipe.photo.fit import read_photo
from facepipe.photo.fit.report import render_image
from facepipe.photo.pictures import photo_pictures
from facepipe.photo.pictures.photo_pictures import photo_render
from facepipe.photo.pictures.photo_report import SIZE, grid, three_sides
from facepipe.pictures import save_png
from facepipe.pictures.figures import figure
from facepipe.stage import Face
from facepipe.textures.seen_skin import to_camera, to_pixels
from facepipe.textures.skin_surface import SCHEME

if TYPE_CHECKING:
    from facepipe.photo.features.extractor import Extractor


@dataclass(frozen=True, kw_only=True)
class BakePhotoReport(Report):
    """What was baked."""

    textures: Mapping[str, tuple[str, ...]]  # file -> the materials that show it
    photos: Mapping[str, float]  # file name -> share of the face that it shows
    seen: float  # share of the face that some photo shows
    hidden: tuple[str, ...] = ()  # materials of cards that are transparent now
    hair: tuple[float, float, float] | None = None  # linear colour, where photos show it
    hair_style: str | None = None  # of the built-in head, the nearest to the photos'
    similarities: Mapping[str, float | None] = field(default_factory=dict)  # file name -> of photo and render, cosine
    seconds: float = 0.0
    sheet: BakeSheet = not_in_json()  # where a report or a similarity is asked for


def as_text(out: Path, report: BakePhotoReport) -> str:
    """The textures, and what each photo gave."""
    alike = {name: "none" if value is None else f"{value:.3f}" for name, value in report.similarities.items()}
    rows = [("photo", "face that it shows", *(["similarity"] if alike else []))]
    rows += [(name, f"{share:.0%}", *([alike[name]] if alike else [])) for name, share in report.photos.items()]
    hair = "" if report.hair_style is None else f"\nhair: {report.hair_style}"
    return f"{out}: {', '.join(report.textures)} in {report.seconds:.1f} s\n{table(rows)}{hair}"


@dataclass(frozen=True, kw_only=True)
class ShownPhoto:
    """A photo, and the textured face as it shows it. Pixels count from the photo's top left corner, y down."""

    view: PhotoView
    photo: Float32Array  # (h, w, 3) sRGB
    render: FloatArray  # (rh, rw, 4) linear colour on black and coverage, of all that the photo shows
    screen: FloatArray  # (n, 2) pixels of the points of all meshes
    landmarks: FloatArray  # (68, 2) pixels, of the face


@dataclass(frozen=True, kw_only=True)
class BakeSheet:
    """All that a report page shows beside the figures."""

    parts: FaceParts  # textured
    neutral: FloatArray  # (n, 3) world points of the person without expression
    photos: tuple[ShownPhoto, ...]


def bake_sheet(face: Face, photos: Sequence[tuple[PhotoView, Path]]) -> BakeSheet:
    """What a face shows that textures were just baked to, within `Face.deriving`.

    :param photos: of the face before, whose cameras and poses it has
    """
    parts, textured = face.parts_so_far(), Face(face.stage, face.prim)
    views = {view.name: view for view in parts.photos}
    first, marks = _landmarks(parts)
    shown = []
    for before, path in photos:
        view = views[before.name]
        assert view.animation is not None
        transforms, weights = textured.sample(view.animation)
        points = textured.evaluate(weights, joint_transforms=transforms)
        screen, _ = to_pixels(view, to_camera(view, points))
        shown.append(
            ShownPhoto(
                view=view,
                photo=read_photo(path).pixels,
                render=photo_render(parts, view, points),
                screen=screen,
                landmarks=screen[first + marks],
            )
        )
    return BakeSheet(parts=parts, neutral=textured.evaluate(pose="set"), photos=tuple(shown))


def _landmarks(parts: FaceParts) -> tuple[int, FloatArray]:
    """The first point of the mesh with landmarks, and their points on it."""
    first = 0
    for mesh in parts.meshes:
        if SCHEME in mesh.landmarks:
            return first, np.asarray(mesh.landmarks[SCHEME].indices)
        first += len(mesh.points)
    raise AssertionError("skin has landmarks")


def with_similarities(report: BakePhotoReport, network: Extractor) -> BakePhotoReport:
    """The report with how like each photo the textured face is."""
    from facepipe.photo.features.extractor import similarity

    found = {
        shown.view.image: similarity(network, shown.photo, shown.render, shown.landmarks)
        for shown in report.sheet.photos
    }
    return replace(report, similarities=found)


def write_folder(folder: Path, report: BakePhotoReport) -> None:
    """Write report.html, report.json and, called as the poses of the photos, the face as it is in them."""
    for shown in report.sheet.photos:
        save_png(render_image(shown.render), folder / f"{shown.view.name}.render.png")
    parts = report.sheet.parts
    title = f"Baked photos: {parts.name}"
    facts = f"{report.seen:.0%} of the face in {len(report.photos)} photo{'s' * (len(report.photos) != 1)}"
    write_bytes(
        folder / "report.html",
        page(
            title,
            joined(tag("h1", title), tag("p", facts, class_="muted")),
            *(grid(_of_photo(shown, report), 3) for shown in report.sheet.photos),
            heading("Without expression", "in studio light"),
            grid(three_sides(parts, report.sheet.neutral), 3),
            heading("Textures"),
            grid(list(_textures(parts, report.textures)), 3),
        ),
    )
    figures = report.to_dict()
    del figures["seconds"]  # the same input gives the same bytes
    write_bytes(folder / "report.json", f"{json.dumps(figures, sort_keys=True, indent=2)}\n".encode())


def _of_photo(shown: ShownPhoto, report: BakePhotoReport) -> list[Markup]:
    """The photo, and the face in its camera and light, alone and on it."""
    height, width = shown.photo.shape[:2]
    near = photo_pictures.portrait(shown.landmarks, shown.screen, width, height, SIZE)
    alike = report.similarities.get(shown.view.image)
    renders = [photo_pictures.render_picture(shown.render, shown.photo, near, on_photo=on) for on in (False, True)]
    seen = f"{report.photos[shown.view.image]:.0%} of the face"
    return [
        figure(photo_pictures.photo_picture(shown.photo, near), shown.view.image, seen),
        figure(renders[0], "render, same camera", "" if alike is None else f"similarity {alike:.3f}"),
        figure(renders[1], "render on the photo"),
    ]


def _textures(parts: FaceParts, files: Mapping[str, Sequence[str]]) -> list[Markup]:
    """Those baked, by their files."""
    sources = {material.name: material.diffuse_color for material in parts.materials}
    figures = []
    for name, materials in files.items():
        source = sources[materials[0]]
        assert isinstance(source, TextureInput)
        image = open_image(source.texture.image(), name).convert("RGB")
        small = image.resize((SIZE, SIZE), Image.Resampling.LANCZOS)
        figures.append(figure(small, name, f"{image.width} x {image.height}"))
    return figures
