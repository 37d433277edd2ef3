"""Faces whose teeth and eyeballs are held against their skin: what may come through, and whether it does."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facepipe.geometry.contacts import Contact, Sheet
from facepipe.geometry.polygons import point_triangles
from facepipe.importers.ict import EXPRESSIONS, shape_name
from facepipe.parts import FaceParts
from facepipe.rig.conventions import ARKIT_SHAPES
from facepipe.rig.rig import Rig, build

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

SINGLE = (4, 0.3)  # cells and mm that a shape alone may have
COMBINED = (20, 0.5)  # and that a combination may have
SHAPES = (5, 9)  # of a combination, by a weight from 0 to 1 each
PRESSED = dict.fromkeys(("mouthPressLeft", "mouthPressRight"), 1.0)  # lips without the gap that they have at rest
BLINKS = ("eyeBlinkLeft", "eyeBlinkRight")
PARTLY = (0.25, 0.5, 0.75)

Weights = Mapping[str, float]


class Subject:
    """A face in millimetres with its meshes in one index space: Head, Teeth, EyeballLeft, EyeballRight.

    :param shapes: those that count; None: all
    """

    def __init__(self, parts: FaceParts, shapes: tuple[str, ...] | None = None) -> None:
        self._rig: Rig = build(parts)
        self._scale = 1000.0 * parts.meters_per_unit
        starts = np.cumsum([0, *(len(mesh.points) for mesh in parts.meshes)])
        self._meshes = {mesh.name: (mesh, int(start)) for mesh, start in zip(parts.meshes, starts, strict=False)}
        self.shapes: tuple[str, ...] = shapes or tuple(self._rig.shapes)
        self.neutral = self.points({})

    def points(self, weights: Mapping[str, float]) -> FloatArray:
        """(n, 3) mm of weights of shapes."""
        return np.asarray(self._rig.evaluate(weights) * self._scale)

    def triangles(self, name: str) -> IntArray:
        """(t, 3) of a mesh."""
        mesh, start = self._meshes[name]
        return point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices).astype(np.int64) + start


@dataclass(frozen=True)
class Eyes:
    """A blink of a person."""

    shown: float  # share of what the open eyes show, in the view where it is the largest
    through: Contact  # the worst of the partly closed lids


def expressions(subject: Subject) -> tuple[str, ...]:
    """Shapes of expressions, by the names of ARKit or of its halves: a head may have others for who it is."""
    known = ARKIT_SHAPES | {shape_name(name) for name in EXPRESSIONS}
    return tuple(name for name in subject.shapes if name in known)


def mouth_sheet(average: Subject) -> Sheet:
    """Teeth behind closed lips."""
    return Sheet.of(average.triangles("Head"), average.triangles("Teeth"), [average.points(PRESSED)])


def eye_sheets(average: Subject) -> tuple[Sheet, ...]:
    """The eyeballs behind closed lids: the rims that rest on them are between lids then, and do not count."""
    poses = [average.points(dict.fromkeys(BLINKS, 1.0))]
    head = average.triangles("Head")
    return tuple(Sheet.of(head, average.triangles(f"Eyeball{side}"), poses) for side in ("Left", "Right"))


def blink(subject: Subject, sheets: tuple[Sheet, ...]) -> Eyes:
    """How lids go over the eyeballs of a person."""
    closed = subject.points(dict.fromkeys(BLINKS, 1.0))
    shown = max(float((sheet.shown(closed) / sheet.shown(subject.neutral)).max()) for sheet in sheets)
    poses = [subject.points(dict.fromkeys(BLINKS, weight)) for weight in PARTLY]
    found = [sheet.through(points) for sheet in sheets for points in poses]
    return Eyes(shown, worst(found))


def draw_combinations(shapes: tuple[str, ...], count: int) -> Iterator[Weights]:
    """The same for the same arguments."""
    draws = np.random.Generator(np.random.PCG64(0))
    for _ in range(count):
        chosen = draws.choice(len(shapes), draws.integers(SHAPES[0], SHAPES[1] + 1), replace=False)
        yield {shapes[number]: float(draws.uniform()) for number in chosen}


def person(seed: int) -> Subject:
    """A person of the head in the box, with its shapes of expressions; 0 is the average head."""
    from facepipe.heads.assembly import make_head
    from facepipe.heads.asset import asset
    from facepipe.heads.people import draw

    return Subject(make_head(draw(seed).identity), tuple(asset().shapes))


def worst(found: Iterable[Contact]) -> Contact:
    """The most cells, and the largest depth."""
    cells, depths = zip(*((one.cells, one.depth) for one in found), strict=True)
    return Contact(max(cells), max(depths))
