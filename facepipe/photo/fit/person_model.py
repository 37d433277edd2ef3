"""Who a face may be: identity modes of its topology as the controls of a fit, and the person that a fit found.

The fit is over standard deviations of the modes, with their Gaussian prior (Blanz and Vetter, "A Morphable Model for
the Synthesis of 3D Faces", SIGGRAPH 1999): what no photo shows stays what is likeliest given the rest. The person
becomes the face's neutral under the nearest values of its own sliders, so that these go on editing it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.reports import Report
from facepipe.geometry.bounded_least_squares import BoxedQuadratic
from facepipe.geometry.nearby_points import NearbyPoints
from facepipe.parts import Blendshape, FaceParts, Slider
from facepipe.registry import databases
from facepipe.rig import build, slide
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes
from facepipe.verbs.author_neutral import AuthorNeutral
from facepipe.verbs.whole_faces import MILLIMETRES, NEXT_MM, in_order, to_millimetres, whole_points, world_to_world

REACH = 3.0  # standard deviations of a mode that a person may have
SCHEME = "multipie68"
_AROUND = 1.2  # times the farthest landmark from their middle
_SLIDER_SPREAD = 0.15  # of its range: standard deviation of a slider
_APART_MM = 1.0  # what sliders may leave of a person's shape at a place
_PLACES = 100  # that are independent of each other
_RARE = 3.09  # quantile of the normal distribution of one in a thousand
_WITHIN_MM = 0.1  # what points of the section may be off: lids by the eyeballs
_ROUNDS = 2  # in which joints under sliders settle


@dataclass(frozen=True, kw_only=True)
class IdentityReport(Report):
    """A person by the face's identity modes."""

    modes: int
    deviations: float  # root mean square of the modes' weights, in standard deviations; 1 is usual for a random person
    beyond_sliders_mean_mm: float  # of the face: what its own sliders don't show, which is in the neutral
    beyond_sliders_max_mm: float
    section_bytes: int = 0  # of the neutral, where sliders over the modes carry the person; 0: it is in the points
    beyond_section_mean_mm: float = 0.0  # of the face: what the section leaves too
    beyond_section_max_mm: float = 0.0

    @property
    def usual(self) -> float:
        """What the deviations of one in a thousand random people exceed.

        Quantile of the chi-squared distribution: Wilson and Hilferty, "The Distribution of Chi-Square", PNAS 1931.
        """
        spread = 2 / (9 * self.modes)
        return float((1 - spread + _RARE * spread**0.5) ** 1.5)


@dataclass(frozen=True, kw_only=True)
class PersonModel:
    """``points = mean + sum_k c_k modes_k`` of a face's n whole points in millimetres, c of a standard normal."""

    parts: FaceParts
    mean: FloatArray  # (n, 3)
    modes: FloatArray  # (k, n, 3)
    face: IntArray  # (m,) whole points of the skin around the landmarks
    count: int  # whole points of the model, which come first; hair and the like follow the skin
    built_in: bool  # the head in the box, whose eyes and mouth are fitted to the skin

    @property
    def names(self) -> tuple[str, ...]:
        """Those of the modes' sliders and shapes."""
        return tuple(f"identityMode{number:03}" for number in range(len(self.modes)))

    def fit_parts(self, expressions: frozenset[str]) -> FaceParts:
        """The average person with sliders of the modes, in standard deviations, and the shapes of expressions."""
        parts = AuthorNeutral().changed(self.parts, self.mean)
        pieces = np.split(self.modes, np.cumsum([len(mesh.points) for mesh in parts.meshes])[:-1], axis=1)
        meshes = []
        for mesh, modes, to in zip(parts.meshes, pieces, to_millimetres(parts), strict=True):
            kept = [shape for shape in mesh.blendshapes if shape.name in expressions]
            back = np.linalg.inv(to[:3, :3])
            # modes (k, m, 3) in millimetres as shapes of a mesh
            rows = np.arange(len(mesh.points), dtype=np.int32)
            own = tuple(
                Blendshape(name=name, point_indices=rows, offsets=offsets @ back.T)
                for name, offsets in zip(self.names, modes, strict=True)
            )
            meshes.append(replace(mesh, blendshapes=(*kept, *own)))
        sliders = tuple(
            Slider(name=name, group="identity", minimum=-REACH, maximum=REACH, shapes=((name, 1.0),))
            for name in self.names
        )
        return replace(
            parts, meshes=tuple(meshes), sliders=sliders, slider_network=None, animations=(), played=None, person=None
        )

    def points(self, weights: FloatArray) -> FloatArray:
        """(n, 3) of the person with weights (k,) of the modes."""
        points = np.asarray(self.mean + np.tensordot(weights, self.modes, axes=1))
        if not self.built_in:
            return points
        from facepipe.heads.assembly import with_parts_fitted

        return np.concatenate([10 * with_parts_fitted(points[: self.count] / 10), points[self.count :]])

    def author(
        self, face: Face, weights: FloatArray, sliders: Sequence[Slider]
    ) -> tuple[dict[str, float], IdentityReport]:
        """Put the person into the neutral of `face`, and find the values of its own sliders that stand for most of it.

        Where sliders over the modes carry all of it, what little they leave goes into the face's section.

        With these values the face is the person; what they don't show is in the neutral. A new `Face` reads it.

        :param sliders: that may move, those of who a person is
        """
        person, change = self.points(weights), AuthorNeutral().changed
        if self.built_in:
            from facepipe.verbs.person_sliders import shows_people

            if shows_people(face.parts()):
                return self._author_sliders(face, weights, person)
        wanted, values = (person - whole_points(self.parts))[self.face], dict[str, float]()
        beyond = wanted
        if sliders:
            # ``min_s |D s - d|^2 / (m sigma^2 / places) + |(s - default) / spread|^2`` of the face's m offsets d and
            # what a slider does at its end, D: sliders work together linearly but for what joints do
            ends = np.array([slider.maximum - slider.default for slider in sliders])
            moved = _moves_by(self.parts, sliders)
            moves = np.stack([moved({slider.name: slider.maximum})[self.face] for slider in sliders])
            flat = moves.reshape(len(sliders), -1) / ends[:, None]
            scale = _PLACES / (len(wanted) * _APART_MM**2)
            spread = _SLIDER_SPREAD * np.array([slider.maximum - slider.minimum for slider in sliders])
            hessian = scale * flat @ flat.T + np.diag(1 / spread**2)
            low, high = (
                np.array([getattr(one, end) - one.default for one in sliders]) for end in ("minimum", "maximum")
            )
            off = BoxedQuadratic(hessian).minimise(-scale * flat @ wanted.ravel(), low, high)
            for slider, value in zip(sliders, off, strict=True):
                values[slider.name] = float(np.float32(slider.default + value))
            beyond = wanted - (off @ flat).reshape(-1, 3)
        apart = np.linalg.norm(beyond, axis=1)
        parts = change(self.parts, person)
        for _ in range(_ROUNDS if values else 0):
            parts = change(self.parts, person - _moves_by(parts, sliders)(values))
        if self.built_in:
            from facepipe.heads.assembly import with_own_lids

            parts = with_own_lids(parts, person[: self.count] / 10)
        meshes = {mesh.name: mesh for mesh in parts.meshes}
        author_changes(face, replace(parts, meshes=tuple(meshes[mesh.name] for mesh in face.meshes)))
        report = IdentityReport(
            modes=len(weights),
            deviations=float(np.sqrt(np.mean(weights**2))),
            beyond_sliders_mean_mm=float(apart.mean()),
            beyond_sliders_max_mm=float(apart.max()),
        )
        return values, report

    def _author_sliders(
        self, face: Face, weights: FloatArray, person: FloatArray
    ) -> tuple[dict[str, float], IdentityReport]:
        """As `author`, where sliders over the modes carry the person (n, 3): what they leave is a section."""
        from facepipe.verbs.person_sliders import person_sliders

        found = person_sliders(face.sliders, person[: self.count], weights=weights, within=_WITHIN_MM)
        author_changes(face, replace(face.parts(), person_basis=found.basis))
        seen = np.intersect1d(self.face, found.rows)  # without the mouth's inside
        off, left = (np.linalg.norm(one[seen], axis=1) for one in (found.sliders_left, found.left))
        report = IdentityReport(
            modes=len(weights),
            deviations=float(np.sqrt(np.mean(weights**2))),
            beyond_sliders_mean_mm=float(off.mean()),
            beyond_sliders_max_mm=float(off.max()),
            section_bytes=len(found.basis.section),
            beyond_section_mean_mm=float(left.mean()),
            beyond_section_max_mm=float(left.max()),
        )
        return found.values, report


def _moves_by(parts: FaceParts, sliders: Sequence[Slider]) -> Callable[[Mapping[str, float]], FloatArray]:
    """From values of some sliders, the others as they are, to (n, 3) millimetres that points of a face move by them."""
    rig, defaults = build(parts), {slider.name: slider.default for slider in sliders}
    to_mm = world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES)[:3, :3]

    def evaluated(values: Mapping[str, float]) -> FloatArray:
        coefficients, weights = slide(parts.sliders, rig.joints, {**defaults, **values}, parts.slider_network)
        return rig.evaluate(weights, coefficients=coefficients)

    rest = evaluated({})
    return lambda values: (evaluated(values) - rest) @ to_mm.T


def person_model(parts: FaceParts, where: str, database: Path | None = None) -> PersonModel | None:
    """The identity modes that a face has: those of a database, or of the head in the box; None: it has none.

    :raises TopologyError: a database of another topology
    :raises InputError: a database that can't be read, or a face without landmarks
    """
    if database is not None:
        faces = databases().load(database)
        base = faces.topology.parts(faces.identity.mean)
        modes = faces.identity.components * faces.identity.deviations[:, None, None]
        return _on(parts, where, base, modes, built_in=False)
    from facepipe.heads.asset import asset

    head = asset()
    if any(name not in {mesh.name for mesh in parts.meshes} for name in head.parts):
        return None
    from facepipe.heads.assembly import average
    from facepipe.heads.assembly import modes as own_modes

    try:
        return _on(parts, where, average(), 10 * own_modes(), built_in=True)
    except TopologyError:
        return None


def _on(parts: FaceParts, where: str, base: FaceParts, modes: FloatArray, *, built_in: bool) -> PersonModel:
    """The model of some meshes of a face, with the others, such as hair, on the skin."""
    first = in_order(base, "the model", parts, where).meshes
    names = {mesh.name for mesh in first}
    ordered = replace(parts, meshes=(*first, *(mesh for mesh in parts.meshes if mesh.name not in names)))
    points, mean = whole_points(ordered), whole_points(base)
    start = 0
    for marked in ordered.meshes:
        if SCHEME in marked.landmarks:
            break
        start += len(marked.points)
    else:
        where = f"{parts.name} -> landmarks"
        raise InputError(where, f"no scheme {SCHEME}, expected it (`facepipe landmarks --help`)")
    skin = slice(start, start + len(marked.points))
    # the face: points of the skin no farther from the landmarks' middle than these are, and some
    marks = points[skin][np.asarray(marked.landmarks[SCHEME].indices)]
    middle = marks.mean(axis=0)
    reach = _AROUND * np.linalg.norm(marks - middle, axis=1).max()
    face = start + np.flatnonzero(np.linalg.norm(points[skin] - middle, axis=1) <= reach)
    others = NearbyPoints.of(points[len(mean) :], points[skin], NEXT_MM)

    def follow(moves: FloatArray) -> FloatArray:
        return others.carried(moves[..., skin, :])

    return PersonModel(
        parts=ordered,
        mean=np.concatenate([mean, points[len(mean) :] + follow(mean - points[: len(mean)])]),
        modes=np.concatenate([modes, follow(modes)], axis=1),
        face=face,
        count=len(mean),
        built_in=built_in,
    )
