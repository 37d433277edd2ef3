"""The small head as a template of transfer, and heads that lie on it where the answer is known."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt
import small_head

from facepipe.geometry.similarity import Similarity
from facepipe.scanning.rebuild import Template
from facepipe.scanning.transfer import Carried, HeadFit, HeadMesh, carried
from facepipe.verbs.whole_faces import whole_face

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

STILL = Similarity(rotation=np.eye(3), translation=np.zeros(3))
SHAPES = ("jawOpen", "mouthSmileLeft", "eyeBlinkRight")


@cache
def template() -> Template:
    """The small head."""
    return Template.of(small_head.make(), "head")


@cache
def shapes() -> dict[str, FloatArray]:
    """Some of its shapes."""
    deltas = whole_face(small_head.make(), "head").deltas
    return {name: np.asarray(deltas[name], np.float64) for name in SHAPES}


def skin() -> tuple[FloatArray, IntArray]:
    """Its own skin, and the triangles."""
    return template().points[template().rows], template().triangles


def on(points: FloatArray, triangles: IntArray, place: Similarity = STILL, fitted: FloatArray | None = None) -> Carried:
    """The shapes on a head in millimetres, on which the template lies as it is or at `fitted` whole points."""
    fit = HeadFit(
        points=template().points if fitted is None else fitted,
        place=place,
        head=HeadMesh.of(place.apply(points), triangles),
        report=None,  # type: ignore[arg-type]  # no shape depends on it
    )
    return carried(template(), fit, shapes())


@cache
def own() -> Carried:
    """The shapes on its own skin; not to be changed."""
    return on(*skin())
