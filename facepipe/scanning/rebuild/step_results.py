"""What each step of a rebuild finds and keeps, as arrays and JSON; what lies in a work folder may be anyone's."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from facepipe.core.arrays import AnyArray, FloatArray
from facepipe.core.errors import InputError
from facepipe.core.reports import Report
from facepipe.geometry.similarity import Similarity
from facepipe.records import ArrayReader, from_json
from facepipe.scanning.rebuild.fit_neutral import NeutralReport
from facepipe.scanning.rebuild.refine_neutral import RefineReport
from facepipe.scanning.rebuild.register_scans import Composite, CompositeReport, NeutralScan
from facepipe.scanning.rebuild.split_expressions import SplitReport

_MORE = ("together",)  # of a report of all scans together


@dataclass(frozen=True, kw_only=True)
class Kept:
    """Arrays and JSON of one kind of step."""

    points: tuple[str, ...] = ()  # arrays (n, 3)
    matched: bool = False  # and one of (n,) integers
    shapes: bool = False  # and one of (n, 3) a name
    place: bool = False
    report: type[Report] | None = None

    def check(self, arrays: Mapping[str, AnyArray], content: Mapping[str, Any], count: int) -> None:
        """:param count: points of the template
        :raises InputError: something else
        """
        names = list(self.points) + ([f"shape/{name}" for name in _names(content)] if self.shapes else [])
        sizes: dict[str, tuple[int, ...]] = dict.fromkeys(names, (count, 3))
        for name, shape in (sizes | ({"matched": (count,)} if self.matched else {})).items():
            if name not in arrays or arrays[name].shape != shape:
                raise InputError(name, f"no array of shape {shape}")
        if self.place:
            _check_place(content.get("place"))
        if self.report is not None:
            own = content.get("report")
            known = {key: one for key, one in own.items() if key not in _MORE} if isinstance(own, dict) else own
            from_json(self.report, known, ArrayReader(b""), "report")


NEUTRAL = Kept(points=("points", "expression"), place=True, report=NeutralReport)
REFINED = Kept(points=("points",), report=RefineReport)
TEMPLATE = Kept(shapes=True)
EXPRESSION = Kept(points=("points",), matched=True, place=True, report=CompositeReport)
SHAPES = Kept(shapes=True, report=SplitReport)


def _names(content: Mapping[str, Any]) -> list[str]:
    names = content.get("names")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError("names", "no list of names")
    return names


def _check_place(content: object) -> None:
    try:
        place = place_of(content if isinstance(content, Mapping) else {})
    except (LookupError, TypeError, ValueError):
        raise InputError("place", "no rotation, translation and scale") from None
    sound = place.rotation.shape == (3, 3) and place.translation.shape == (3,) and 0.0 < place.scale < math.inf
    turns = sound and np.allclose(place.rotation @ place.rotation.T, np.eye(3), atol=1e-3)
    if not turns or not np.isfinite(place.translation).all():
        raise InputError("place", "no rotation, translation and scale")


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """How a result lies on its scan."""

    place: Similarity  # from the scan's coordinates to those of the points
    report: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class FittedNeutral(Fitted):
    """The neutral, as corrected."""

    scan: NeutralScan


@dataclass(frozen=True, kw_only=True)
class FittedExpression(Fitted):
    """An expression, as corrected."""

    composite: Composite


def place_json(place: Similarity) -> dict[str, Any]:
    """A similarity as JSON."""
    return {
        "rotation": place.rotation.tolist(),
        "translation": place.translation.tolist(),
        "scale": place.scale,
    }


def place_of(values: Mapping[str, Any]) -> Similarity:
    """A similarity of JSON."""
    return Similarity(
        rotation=np.array(values["rotation"], np.float64),
        translation=np.array(values["translation"], np.float64),
        scale=float(values["scale"]),
    )


def shape_arrays(shapes: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Shapes by arrays' names; float32, as files hold points."""
    return {f"shape/{name}": np.asarray(delta, np.float32) for name, delta in shapes.items()}


def shapes_of(arrays: Mapping[str, AnyArray], names: list[str]) -> dict[str, FloatArray]:
    """The shapes back, in the order of `names`."""
    return {name: np.asarray(arrays[f"shape/{name}"], np.float64) for name in names}
