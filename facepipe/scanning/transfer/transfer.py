"""Shapes, regions, landmarks and sliders of a template put on a head of others, whose own points and names stay."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.core.reports import Report, not_in_json, table
from facepipe.core.threads import one_thread
from facepipe.geometry.closest_points import closest_places, place_shares
from facepipe.parts import Blendshape, FaceParts, Inbetween, Landmarks, Mesh, Recipe, Slider, all_regions
from facepipe.rig.conventions import ARKIT_SHAPES, match_shapes, shapes_of
from facepipe.scanning.database import FaceDatabase, QualityLimits, misses
from facepipe.scanning.rebuild.built_in_head import bare_head, people, with_inside_fitted
from facepipe.scanning.rebuild.fit_neutral import FitNeutralReport
from facepipe.scanning.rebuild.template import Template
from facepipe.scanning.transfer.carry import carried
from facepipe.scanning.transfer.companions import motion_of
from facepipe.scanning.transfer.finish import MADE, Finished, ShapeVerdict, finished
from facepipe.scanning.transfer.fit import HeadFit, fit_head
from facepipe.scanning.transfer.head import Head
from facepipe.scanning.transfer.people import people_on
from facepipe.scanning.transfer.pieces import EYE_LEFT, EYE_RIGHT, HELPER, STILL, outer_skin, pieces_of
from facepipe.scans import LANDMARK_SCHEME
from facepipe.stage import Face
from facepipe.verbs.author_neutral import AuthorNeutral
from facepipe.verbs.skin.skin_face import SkinFace
from facepipe.verbs.whole_faces import Topology, to_millimetres, whole_face

_Key = TypeVar("_Key")
_Moves = TypeVar("_Moves")
# Of the fit. A head 5 mm off all people, smoothly, is 3.2 mm beyond the model and 4.9 standard deviations from the mean
# person; a head with a beak of 80 mm is 7.7 and 4.9, a ball with landmarks on it 3.1 and 11.
_RANGE = QualityLimits(max_surface_mean_mm=0.6, max_surface_p95_mm=2.0, min_coverage=0.5, max_flipped_triangles=200)
_BEYOND_MM, _DEVIATIONS, _LANDMARKS_MM = 6.0, 8.0, 3.0
_ODD_SIZE = 0.5  # logarithm: children's faces are 0.3 smaller
_CANDIDATES = 30  # points of the head that may stand for a landmark: enough that no two take the same
KINDS = ("shapes", "regions", "landmarks", "sliders")


@dataclass(frozen=True, kw_only=True)
class TransferReport(Report):
    """What a head got, and what it could not get."""

    landmarks: str  # where they come from
    fit_mean_mm: float  # between the face of the head and the template that was fitted to it
    fit_p95_mm: float
    fit_coverage: float  # share of the template's face that lies on the head
    beyond_mm: float  # mean distance of the face from all people
    shapes: Mapping[str, Mapping[str, object]]  # shape -> verdict, and figures in millimetres
    not_made: Mapping[str, str]  # shape -> why it can't be
    kept: Mapping[str, str] = field(default_factory=dict)  # shape -> the head's own, which stays
    regions: tuple[str, ...] = ()
    sliders: tuple[str, ...] = ()
    joints: int = 0
    authored: tuple[str, ...] = ()
    missed: tuple[str, ...] = ()  # what of the fit is out of the range of people, one line each
    shown: Any = not_in_json()  # (n,) whole points that are no hair, clothes or helpers
    place: Any = not_in_json()  # `Similarity` from whole points to the template's place
    framing: Any = not_in_json()  # (68, 3) landmarks there, of which pictures are taken

    def as_text(self, out: Path) -> str:
        """The report as tables for people."""
        made = [name for name in self.shapes if name not in self.not_made]
        rows = [
            ("landmarks", self.landmarks),
            ("fit", f"mean {self.fit_mean_mm:.2f} mm, 95 % below {self.fit_p95_mm:.2f} mm"),
            ("beyond the model", f"mean {self.beyond_mm:.2f} mm"),
            ("shapes", f"{len(made)} made" + (f", {len(self.kept)} the head's own" if self.kept else "")),
            *([("regions", ", ".join(self.regions))] if self.regions else []),
            *([("sliders", f"{len(self.sliders)}")] if self.sliders else []),
            *([("joints", f"{self.joints}")] if self.joints else []),
        ]
        said = {name: str(one["verdict"]) for name, one in self.shapes.items() if one["verdict"] != MADE}
        by_verdict = {verdict: [name for name in said if said[name] == verdict] for verdict in said.values()}
        lines = [f"{verdict}: {', '.join(named)}" for verdict, named in by_verdict.items()]
        return "\n".join([str(out), table(rows), *lines])


def wanted_shapes(
    template: FaceParts, head: FaceParts, shapes: Sequence[str], *, anew: bool
) -> tuple[tuple[str, ...], dict[str, str]]:
    """The template's shapes to bring, and those that the head has: shape -> the head's name.

    :param shapes: none: ARKit's, where the template has some; ("all",): every one
    :param anew: also those that the head has as one
    :raises InputError: a shape that the template lacks
    """
    names: Sequence[str] = [name for name in template.shapes if name in ARKIT_SHAPES] or template.shapes
    if shapes:
        names = template.shapes if tuple(shapes) == ("all",) else shapes
    for name in names:
        if name not in template.shapes:
            raise InputError("--shapes", unknown(name, template.shapes, "shape of the template"))
    own = match_shapes(names, head.shapes, shapes_of(head.meshes))
    if anew:  # one that the head has in halves stays: both would move it
        own = {
            name: found
            for name, found in own.items()
            if any(sum(one in group for one in found) > 1 for group in shapes_of(head.meshes))
        }
    return tuple(name for name in names if name not in own), {name: ", ".join(found) for name, found in own.items()}


@one_thread()
def transfer(
    face: Face,
    recipe: Recipe,
    step: Callable[[], object],
    *,
    template: Path | None = None,
    landmarks: Path | None = None,
    shapes: Sequence[str] = (),
    only: Sequence[str] = (),
    joints: bool = False,
    anew: bool = False,
) -> TransferReport:
    """Author on `face`, a layer over a head of others, what a template brings.

    :param step: called after each step of the fit and each shape
    :param template: a face stage; None: the built-in head
    :param landmarks: their file; None: the head's own, or found on it
    :param shapes: as for `wanted_shapes`
    :param only: some of `KINDS`; none: all
    :param joints: bring the template's joints, with weights, to a head that has none
    :param anew: shapes, regions, landmarks and sliders that the head has are made too
    :raises FacepipeError: no landmarks, a head that the template can't be fitted to, or nothing to bring
    """
    parts = face.parts()
    if joints and parts.skeleton.joints:
        what = f"the head has {len(parts.skeleton.joints)} joints of its own, expected none"
        raise InputError(f"{face.where} -> --joints", what)
    body, database = _template(template)
    names, kept = wanted_shapes(body.parts, parts, shapes, anew=anew)
    head = Head.of(parts, face.where, landmarks)
    skin, wanted = head.skin(), only or KINDS
    surface = head.sewn[skin], head.surface.part_triangles(skin), head.landmarks
    fit = fit_head(body, database, *surface, name=face.where, progress=lambda number: _done(step))
    made, face_points = Finished(deltas={}, inbetweens={}, verdicts=(), notes=()), np.ones(len(head.sewn), bool)
    if "shapes" in wanted and names:
        made, face_points = _shapes_of(head, skin, body, fit, names, kept, step)
        if anew:
            made = _by_own_names(made, match_shapes(names, parts.shapes, shapes_of(parts.meshes)), head)
    deltas = {name: head.whole(delta) for name, delta in made.deltas.items()}
    settled = partial(
        _settled, head=head, skin=skin, fit=fit, body=body.parts, between=made.inbetweens, wanted=wanted, anew=anew
    )
    authored = AuthorNeutral(shapes=deltas, settled=settled)(face, head.points, recipe=recipe)
    if joints:
        fitted = AuthorNeutral().changed(body.parts, fit.place.undo(fit.points))
        SkinFace(source=Face.from_parts(fitted))(Face(face.stage, face.prim), recipe=recipe)
    report = _report(parts, Face(face.stage, face.prim).parts(), head, skin, body, fit, made)
    return replace(
        report,
        kept=kept,
        joints=report.joints if joints else 0,
        authored=authored.authored,
        shown=head.whole(face_points),
        warnings=(*report.warnings, *authored.warnings),
    )


def _report(
    before: FaceParts, after: FaceParts, head: Head, skin: IntArray, body: Template, fit: HeadFit, made: Finished
) -> TransferReport:
    """What is known of a transfer by the head before and after it."""
    quality = fit.report.quality
    missed = out_of_range(fit.report)
    return TransferReport(
        landmarks=head.source,
        fit_mean_mm=quality.surface_mean_mm,
        fit_p95_mm=quality.surface_p95_mm,
        fit_coverage=quality.coverage,
        beyond_mm=fit.report.residual_mean_mm,
        shapes={one.name: _row(one, made.deltas, fit.place.scale) for one in made.verdicts},
        not_made={one.name: one.verdict.removeprefix("not made: ") for one in made.verdicts if not one.made},
        regions=tuple(name for name in all_regions(after.meshes) if name not in all_regions(before.meshes)),
        joints=len(after.skeleton.joints),
        sliders=tuple(one.name for one in after.sliders if one not in before.sliders),
        missed=missed,
        place=fit.place,
        framing=fit.points[body.rows[body.landmarks]],
        warnings=(*missed, *head.notes, *skin_lines(head, skin), *_of_fit(fit), *made.notes),
    )


def skin_lines(head: Head, skin: IntArray) -> list[str]:
    """What is to be said of the skin's triangles; the mouth's own sheet faces inward by right."""
    turned = int(head.turned[np.isin(head.surface.triangles[:, 0], skin)].sum())
    return [f"{turned} triangles face inward: they are taken as turned, and stay as they are"] if turned else []


def _of_fit(fit: HeadFit) -> list[str]:
    """What a fit warns of; of the unit only where it is wrong, since a head keeps its own."""
    lines = [line for line in fit.report.warnings if "--unit" not in line and "no usual unit" not in line]
    scale = fit.place.scale
    if abs(np.log(scale)) > _ODD_SIZE:
        lines.append(
            f"by its face the head is people's size if it is {scale:.3g} times as large: its unit may be wrong"
        )
    return lines


def out_of_range(fit: FitNeutralReport) -> tuple[str, ...]:
    """A line for each measure of a fit that no head has which is like people's."""
    lines = list(misses(fit.quality, _RANGE))
    deviations = max(map(abs, fit.coefficients), default=0.0)
    if deviations > _DEVIATIONS:
        lines.append(
            f"the face is {deviations:.1f} standard deviations from the mean person, expected at most {_DEVIATIONS:g}"
        )
    if fit.residual_mean_mm > _BEYOND_MM:
        lines.append(
            f"the face is {fit.residual_mean_mm:.1f} mm (mean) from all people, expected at most {_BEYOND_MM:g}"
        )
    if fit.fit.landmark_mean_mm > _LANDMARKS_MM:
        off = f"{fit.fit.landmark_mean_mm:.1f} mm (mean) off, expected at most {_LANDMARKS_MM:g}"
        lines.append(f"landmarks are {off}: are they of this head?")
    return tuple(f"fit: {line}" for line in lines)


def _shapes_of(
    head: Head,
    skin: IntArray,
    body: Template,
    fit: HeadFit,
    names: Sequence[str],
    kept: Mapping[str, str],
    step: Callable[[], object],
) -> tuple[Finished, BoolArray]:
    """Shapes `names` of the template as `whole_shapes` makes them, with the jawOpen that mouthClose belongs to."""
    own = whole_face(body.parts, body.where).deltas
    more = ("jawOpen",) if _closes_alone(names, own, kept) else ()
    wished = {name: own[name] for name in (*names, *more)}
    skin_deltas = dict(carried(body, fit, wished, lambda name: _done(step)).deltas)
    jaw = skin_deltas.pop("jawOpen") if more else _own_jaw(head, kept, skin)
    return whole_shapes(head, skin, body, fit, own, skin_deltas, jaw)


def _by_own_names(made: Finished, own: Mapping[str, Sequence[str]], head: Head) -> Finished:
    """The shapes by the names that the head has for them, in whose place they come.

    :param own: name -> the head's, of meshes that call it differently several
    """
    groups = shapes_of(head.parts.meshes)

    def renamed(deltas: Mapping[str, _Moves], part: Callable[[_Moves, BoolArray], _Moves]) -> dict[str, _Moves]:
        found: dict[str, _Moves] = {}
        for name, moves in deltas.items():
            for number, called in enumerate(own.get(name, (name,))):
                others = [one for one in own.get(name, ()) if one != called]
                there = [called in group or (number == 0 and not {*others} & {*group}) for group in groups]
                found[called] = part(moves, np.array(there)[head.surface.mesh])
        return found

    def of_points(delta: FloatArray, there: BoolArray) -> FloatArray:
        return np.where(there[:, None], delta, 0.0)

    return replace(
        made,
        deltas=renamed(made.deltas, of_points),
        inbetweens=renamed(
            made.inbetweens, lambda ways, there: {way: of_points(one, there) for way, one in ways.items()}
        ),
        verdicts=tuple(replace(one, name=own.get(one.name, (one.name,))[0]) for one in made.verdicts),
    )


def _done(step: Callable[[], object]) -> None:
    step()


def _row(one: ShapeVerdict, deltas: Mapping[str, FloatArray], scale: float) -> dict[str, object]:
    """A shape's verdict and figures, in true millimetres whatever unit the file says."""
    row: dict[str, object] = {"verdict": one.verdict}
    if one.name in deltas:
        row["largest_mm"] = scale * float(np.linalg.norm(deltas[one.name], axis=1).max(initial=0.0))
        row["flips"] = one.flips
    figures = {"lids": one.lids, "lips": one.lips}
    return row | {what: asdict(value) for what, value in figures.items() if value is not None}


def _closes_alone(names: Sequence[str], own: Mapping[str, FloatArray], kept: Mapping[str, str]) -> bool:
    """Whether mouthClose is wanted without the jawOpen that it belongs to, which the head has not either."""
    return "mouthClose" in names and "jawOpen" in own and "jawOpen" not in {*names, *kept}


def _own_jaw(head: Head, kept: Mapping[str, str], skin: IntArray) -> FloatArray | None:
    """(m, 3) of the head's own jawOpen at the sewn points `skin`; None: it has none."""
    if "jawOpen" not in kept:
        return None
    deltas = whole_face(head.parts, head.where).deltas
    whole = sum((deltas[name] for name in kept["jawOpen"].split(", ")), np.zeros_like(head.points))
    return np.asarray(whole[np.unique(head.surface.group, return_index=True)[1]][skin])


def whole_shapes(
    head: Head,
    skin: IntArray,
    body: Template,
    fit: HeadFit,
    own: Mapping[str, FloatArray],
    carried: Mapping[str, FloatArray],
    jaw: FloatArray | None = None,
) -> tuple[Finished, BoolArray]:
    """Shapes of all pieces of a head, in its own coordinates; and which sewn points are of its face and head itself.

    :param skin: (m,) sewn points that the shapes were carried to
    :param own: name -> (n, 3) whole deltas of the template, millimetres
    :param carried: name -> (m, 3) of the head's skin
    :param jaw: (m, 3) of jawOpen, where that is not carried
    """
    place = fit.place
    points, marks = place.apply(head.sewn), place.apply(head.landmarks.points)
    marks = np.where(head.landmarks.known[:, None], marks, fit.points[body.rows[body.landmarks]])
    own_marks = body.points[body.rows[body.landmarks]]
    laid = fit.points if bare_head(body.parts) is None else with_inside_fitted(fit.points)
    motion = motion_of(body.points, body.topology.triangles, own_marks, own, laid)
    outer = outer_skin(points, head.surface.triangles, skin, fit.points[body.rows], body.triangles)
    pieces = pieces_of(points, head.surface.triangles, marks, head.hints(), motion.inside, outer)

    def there(delta: FloatArray) -> FloatArray:
        whole = np.zeros_like(points)
        whole[skin] = place.scale * delta @ place.rotation.T
        return whole

    whole = {name: there(delta) for name, delta in carried.items()}
    opened = None if jaw is None else there(jaw)
    made = finished(points, head.surface.triangles, marks, pieces, motion, whole, opened)

    for side, kind in (("Left", EYE_LEFT), ("Right", EYE_RIGHT)):
        # where a joint turns the eyeball, shapes that turn it too would turn it twice
        turned = head.carried_by(f"{side}Eye")
        if turned is not None:
            ball = pieces.of(kind)
            for name in (one for one in made.deltas if one.startswith("eyeLook") and one.endswith(side)):
                made.deltas[name][ball] *= 1.0 - turned[ball, None]

    def back(deltas: Mapping[_Key, FloatArray]) -> dict[_Key, FloatArray]:
        return {key: np.asarray(delta @ place.rotation / place.scale) for key, delta in deltas.items()}

    between = {name: back(ways) for name, ways in made.inbetweens.items()}
    face_points = np.ones(len(points), bool)
    face_points[pieces.of(STILL, HELPER)] = False
    return replace(made, deltas=back(made.deltas), inbetweens=between), face_points


def _template(path: Path | None) -> tuple[Template, FaceDatabase]:
    """The template, of the built-in head's topology without hair and lashes, and who its people may be.

    :raises FacepipeError: a file that can't be used, or a face without landmarks or that is like none of people
    """
    from facepipe.heads import make
    from facepipe.importers import read_face

    parts, where = (make(), "built-in head") if path is None else (read_face(path).parts(), str(path))
    own = bare_head(parts)
    template = Template.of(parts, where)
    if own is None:
        return template, people_on(template)
    database = people(own)
    return template.body(database.topology), database


def _settled(
    changed: FaceParts,
    *,
    head: Head,
    skin: IntArray,
    fit: HeadFit,
    body: FaceParts,
    between: Mapping[str, Mapping[float, FloatArray]],
    wanted: Sequence[str],
    anew: bool,
) -> FaceParts:
    """The head with its new shapes, and with regions, landmarks and sliders."""
    counts = [len(mesh.points) for mesh in changed.meshes]
    splits = np.cumsum(counts)[:-1]
    places = fit.place.apply(head.points)
    masks: list[dict[str, FloatArray]] = [{} for _ in counts]
    if "regions" in wanted and (anew or not all_regions(changed.meshes)):
        carried = carried_masks(all_regions(body.meshes), fit.points, Topology.of(body).triangles, places)
        for name, mask in carried.items():
            for own, part in zip(masks, np.split(mask, splits), strict=True):
                own[name] = part
    # of the mesh that has most of the skin: landmarks of a scheme lie on one mesh
    on_skin = np.isin(head.surface.group, skin)
    chosen = int(np.argmax([part.sum() for part in np.split(on_skin, splits)]))
    start = int(np.sum(counts[:chosen]))
    rows = start + np.flatnonzero(on_skin[start : start + counts[chosen]])
    meshes = [replace(mesh, regions=own or mesh.regions) for mesh, own in zip(changed.meshes, masks, strict=True)]
    meshes = [
        replace(mesh, blendshapes=tuple(_between(shape, head, number, between) for shape in mesh.blendshapes))
        for number, mesh in enumerate(meshes)
    ]
    if "landmarks" in wanted and (anew or not any(mesh.landmarks for mesh in meshes)):
        marked = meshes[chosen] if not anew else replace(meshes[chosen], anchor=None)
        meshes[chosen] = _marked(marked, body, fit.points, places[rows], rows - start)
    known = {name for mesh in meshes for name in (shape.name for shape in mesh.blendshapes)}
    sliders = {one.name: one for one in changed.sliders}
    made = [_by_shapes(one) for one in body.sliders if "sliders" in wanted and (anew or one.name not in sliders)]
    sliders |= {one.name: one for one in made if one.shapes and known.issuperset(dict(one.shapes))}
    return replace(changed, meshes=tuple(meshes), sliders=tuple(sliders.values()), photos=head.parts.photos)


def _between(shape: Blendshape, head: Head, mesh: int, between: Mapping[str, Mapping[float, FloatArray]]) -> Blendshape:
    """The shape with what it is at weights below 1, where it was made with that."""
    if shape.name not in between:
        return shape
    back = np.linalg.inv(to_millimetres(head.parts)[mesh])[:3, :3]
    start = sum(len(one.points) for one in head.parts.meshes[:mesh])
    inbetweens = tuple(
        Inbetween(
            name=f"at{round(100 * weight)}",
            weight=weight,
            offsets=delta[head.surface.group[start + shape.point_indices]] @ back.T,
        )
        for weight, delta in between[shape.name].items()
    )
    return replace(shape, inbetweens=inbetweens)


def _marked(mesh: Mesh, body: FaceParts, points: FloatArray, places: FloatArray, own: IntArray) -> Mesh:
    """The mesh with the template's landmarks, and its anchor where the mesh has none.

    :param points: (n, 3) whole points of the template, lying on the head
    :param places: (k, 3) of the mesh's points `own` (k,), in the same space
    """
    landmarks, anchor, start = dict(mesh.landmarks), mesh.anchor, 0
    for part in body.meshes:
        for scheme, marks in part.landmarks.items():
            chosen = own[own_points(points[start + marks.indices], places)]
            if scheme == LANDMARK_SCHEME:
                landmarks[scheme] = Landmarks(indices=chosen.astype(np.int32), names=marks.names)
        if part.anchor is not None and mesh.anchor is None:
            nearest = np.linalg.norm(places - points[start + part.anchor], axis=1).argmin()
            anchor = int(own[nearest])
        start += len(part.points)
    return replace(mesh, landmarks=landmarks, anchor=anchor)


def _by_shapes(slider: Slider) -> Slider:
    """The slider without what it does to joints, which the head has none of, or others."""
    return replace(slider, channels=(), channel_curves=(), value=None)


def carried_masks(
    masks: Mapping[str, FloatArray], points: FloatArray, triangles: IntArray, places: FloatArray
) -> dict[str, FloatArray]:
    """Region -> (m,) mask at `places` (m, 3): that of the template's surface where it is nearest. They sum to 1 where
    those of the template do.

    :param masks: region -> (n,) mask of the template
    :param points: (n, 3) of the template, lying on the head
    """
    nearest = closest_places(places, points, triangles)
    corners, shares = triangles[nearest.triangles], place_shares(nearest, points, triangles)
    return {name: np.asarray((mask[corners] * shares).sum(axis=1)) for name, mask in masks.items()}


def own_points(marks: FloatArray, places: FloatArray) -> IntArray:
    """(l,) the points of `places` (m, 3) that stand for `marks` (l, 3), no two the same: those that are nearest in all.

    On coarse meshes one point is the nearest to two landmarks; either would then move the other's.
    """
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial import cKDTree

    count = min(max(_CANDIDATES, len(marks)), len(places))
    near = np.unique(cKDTree(places).query(marks, k=np.arange(1, count + 1))[1])
    distances = np.linalg.norm(marks[:, None] - places[near][None], axis=2)
    rows, columns = linear_sum_assignment(distances**2)
    chosen = np.full(len(marks), -1)
    chosen[rows] = near[columns]
    return chosen
