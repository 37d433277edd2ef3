"""The report page of a fit to photos: what was found, and how well it shows what the photos do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.markup import Markup, heading, joined, page, tag
from facepipe.geometry.rasterise import NEAR
from facepipe.parts import FaceParts, Slider
from facepipe.photo.pictures import photo_pictures as pictures
from facepipe.pictures.camera import View
from facepipe.pictures.face_picture import PictureOptions
from facepipe.pictures.face_picture import pictures as face_pictures
from facepipe.pictures.figures import TOTAL, bar, figure, loss_chart, table_of_bars

SIZE = 640  # pixels of a picture
ACTIVE = 0.02  # share of the range (of 1 for a weight) beyond which a control counts as moved
HIDDEN = 0.05  # share of a region that is in no photo, from which on it is listed
SIDES: tuple[View, ...] = ("front", "three-quarter", "side")  # that the neutral is seen from
FRAMED = 0.85  # a crop smaller than this share of the photo is framed in it


@dataclass(frozen=True, kw_only=True)
class SheetPhoto:
    """One photo, and what the fit makes of it. Pixels count from the photo's top left corner, y down."""

    name: str
    photo: FloatArray  # (h, w, 3) sRGB 0..1
    render: FloatArray  # (rh, rw, 4) linear colour on black and coverage 0..1, of all that the photo shows, any size
    screen: FloatArray  # (n, 3) pixel x, y and depth of the posed points of all meshes, in mesh order
    targets: FloatArray  # (l, 2) landmarks that the fit was given, pixels
    landmarks: FloatArray  # (l, 2) landmarks of the fitted face, pixels
    landmark_error: float  # mean, pixels
    eye_distance: float  # pixels between the outer eye corners, what the error is a percentage of
    expressions: Mapping[str, float]  # shape -> weight, of the shapes that were free
    similarity: float | None = None  # of photo and render to a recognition network, cosine


@dataclass(frozen=True, kw_only=True)
class PhotoSheet:
    """All that a report page shows."""

    parts: FaceParts
    neutral: FloatArray  # (n, 3) world points of the person without expression
    photos: tuple[SheetPhoto, ...]  # one at least
    sliders: Mapping[str, float]  # name -> value, of the sliders that were free
    history: Sequence[Mapping[str, float]]  # by step: "total" and each weighted term; NaN: not known
    kept: int = 0  # step that the face is of
    note: str = ""  # how the fit ended
    unseen: Mapping[str, float] = field(default_factory=dict)  # region -> share of it that no photo shows


def photo_page(sheet: PhotoSheet) -> bytes:
    """One HTML page: pictures of every photo, the neutral, expressions, losses and sliders."""
    title = f"Photo fit: {sheet.parts.name}"
    losses = heading("Losses", "weighted terms, by step"), loss_chart(sheet.history)
    found = tag("section", *_expressions(sheet)), tag("section", *losses)
    beside = tag("div", *found, class_="columns" if len(sheet.photos) == 1 else None)
    head = joined(tag("h1", title), tag("p", "  ·  ".join(facts(sheet)), class_="muted"))
    return page(title, head, *_pictures(sheet), beside, *_unseen(sheet), *_sliders(sheet))


def facts(sheet: PhotoSheet) -> list[str]:
    """What one wants to know first."""
    known = [_count(len(sheet.photos), "photo"), _count(max(len(sheet.history) - 1, 0), "step")]
    kept = [step.get(TOTAL, np.nan) for step in sheet.history[sheet.kept : sheet.kept + 1]]
    if np.isfinite(kept).any():
        known.append(f"loss {kept[0]:.3g} at step {sheet.kept}")
    errors = [photo.landmark_error for photo in sheet.photos]
    shares = [photo.landmark_error / photo.eye_distance for photo in sheet.photos]
    known.append(
        f"landmark error {np.mean(errors):.2f} px, {np.mean(shares):.1%} of the distance of the outer eye corners"
    )
    return known + ([sheet.note] if sheet.note else [])


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _pictures(sheet: PhotoSheet) -> Iterator[Markup]:
    """One photo: two rows of four with the neutral. Several: a row of five for each, and the neutral."""
    neutral = three_sides(sheet.parts, sheet.neutral)
    if len(sheet.photos) == 1:
        yield grid([*_of_photo(sheet, sheet.photos[0]), *neutral], 4)
        return
    yield from (grid(_of_photo(sheet, photo), 5) for photo in sheet.photos)
    yield joined(heading("Without expression"), grid(neutral, 5))


def grid(figures: Sequence[Markup], columns: int) -> Markup:
    """Figures in rows."""
    style = f"grid-template-columns:repeat({columns},minmax(0,1fr));margin-top:24px"
    return tag("div", *figures, class_="grid", style=style)


def _of_photo(sheet: PhotoSheet, photo: SheetPhoto) -> list[Markup]:
    """The five pictures of a photo, with captions."""
    height, width = photo.photo.shape[:2]
    whole = pictures.whole(width, height, SIZE)
    marks = np.concatenate([photo.targets, photo.landmarks])
    near = pictures.portrait(marks, photo.screen[photo.screen[:, 2] > NEAR, :2], width, height, SIZE)
    close = pictures.close_up(marks, width, height, SIZE)
    image = pictures.photo_picture(photo.photo, whole)
    if near.side < FRAMED * max(width, height):
        image = pictures.framed(image, whole, near)
    landmarks = pictures.landmark_picture(photo.photo, close, photo.targets, photo.landmarks)
    error = f"{photo.landmark_error:.2f} px, {photo.landmark_error / photo.eye_distance:.1%}"
    alike = "" if photo.similarity is None else f"similarity {photo.similarity:.3f}"
    return [
        figure(image, photo.name, f"{width} x {height}"),
        figure(landmarks, joined(_mark(given=True), " given ", _mark(given=False), " fitted"), error),
        figure(pictures.wireframe_picture(photo.photo, near, sheet.parts, photo.screen), "fitted mesh"),
        figure(pictures.render_picture(photo.render, photo.photo, near, on_photo=False), "render, same camera", alike),
        figure(pictures.render_picture(photo.render, photo.photo, near, on_photo=True), "render on the photo"),
    ]


def _mark(*, given: bool) -> Markup:
    """A landmark as the picture has it, for its legend."""
    casing = tag("circle", cx=7, cy=7, r=7, fill="rgb(24,26,32)")
    ring = tag("circle", cx=7, cy=7, r=4.5, fill="none", stroke="#fff", stroke_width=2)
    dot = tag("circle", cx=7, cy=7, r=4, fill="rgb(226,40,52)")
    return tag("svg", *((casing, ring) if given else (dot,)), width=14, height=14, style="vertical-align:-2px")


def three_sides(parts: FaceParts, neutral: FloatArray) -> list[Markup]:
    """The person without expression in studio light."""
    ground = (pictures.GROUND[0] / 255, pictures.GROUND[1] / 255, pictures.GROUND[2] / 255)
    options = [PictureOptions(size=SIZE, view=view, background=ground, samples=2) for view in SIDES]
    images = face_pictures(parts, neutral, options)
    return [figure(image, "without expression", str(view)) for view, image in zip(SIDES, images, strict=True)]


def _unseen(sheet: PhotoSheet) -> Iterator[Markup]:
    """Regions of which a part is in no photo: that part is what is likeliest given the rest."""
    shares = {name: share for name, share in sheet.unseen.items() if share >= HIDDEN}
    if not shares:
        return
    yield heading("In no photo", "share of the region, turned away, hidden or cut off")
    order = sorted(shares, key=lambda name: (-shares[name], name))
    yield tag(
        "section", table_of_bars([(name, [(bar((0.0, 1.0), 0.0, shares[name]), shares[name])]) for name in order])
    )


def _expressions(sheet: PhotoSheet) -> Iterator[Markup]:
    """Weights, the largest first: one row a shape, one bar a photo."""
    weights = [photo.expressions for photo in sheet.photos]
    names = sorted({name for each in weights for name in each})
    largest = {name: max(abs(each.get(name, 0.0)) for each in weights) for name in names}
    used = sorted((name for name in names if largest[name] > ACTIVE), key=lambda name: -largest[name])
    yield heading("Expression", f"{len(used)} of {len(names)} shapes in use" if names else "none fitted")
    values = [each[name] for each in weights for name in used if name in each]
    limits = min([0.0, *values]), max([1.0, *values])
    rows = [
        (name, [(bar(limits, 0.0, each[name]), each[name]) if name in each else None for each in weights])
        for name in used
    ]
    titles = [photo.name for photo in sheet.photos] if len(weights) > 1 else []
    yield table_of_bars(rows, titles=titles)
    yield _counted({f"at {ACTIVE:g} or less": len(names) - len(used)})


def _sliders(sheet: PhotoSheet) -> Iterator[Markup]:
    """The sliders that have moved, by group; the others are counted."""
    sliders = sheet.parts.sliders
    free = [slider for slider in sliders if slider.name in sheet.sliders]
    moved = [slider for slider in free if _moved(slider, sheet.sliders[slider.name]) > ACTIVE]
    yield heading("Sliders", f"{len(moved)} of {len(free)} moved from the default" if free else "none fitted")
    tables = []
    for group in dict.fromkeys(slider.group for slider in moved):
        rows = []
        for slider in (one for one in moved if one.group == group):
            value = sheet.sliders[slider.name]
            rows.append((slider.name, [(bar((slider.minimum, slider.maximum), slider.default, value), value)]))
        tables.append(table_of_bars(rows, group or "other"))
    yield tag("div", *tables, class_="flow")
    still = f"within {ACTIVE:.0%} of the range from their default"
    yield _counted({still: len(free) - len(moved), "not fitted": len(sliders) - len(free)})


def _moved(slider: Slider, value: float) -> float:
    """Distance from the default as a share of the range."""
    reach = slider.maximum - slider.minimum
    return abs(value - slider.default) / reach if reach > 0 else 0.0


def _counted(counts: Mapping[str, int]) -> Markup:
    """How many controls are not in the table, and why."""
    return tag("p", "; ".join(f"{count} {why}" for why, count in counts.items() if count), class_="muted")
