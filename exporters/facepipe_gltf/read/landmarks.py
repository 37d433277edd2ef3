"""Landmarks and the anchor of a mesh, which our exporter puts into ``mesh.extras.facepipe``."""

from __future__ import annotations

import numpy as np

from facepipe.core.errors import InputError
from facepipe.parts import Landmarks
from facepipe_gltf.read.document import Document
from facepipe_gltf.read.primitives import Geometry
from facepipe_gltf.read.values import Value
from facepipe_gltf.read.weld import Weld


def landmarks(document: Document, geometry: Geometry, weld: Weld) -> dict[str, Landmarks]:
    """Landmarks by scheme."""
    ours, place = _ours(document, geometry, weld)
    listed = None if ours is None else ours.get("landmarks")
    if listed is None:
        return {}
    found = {}
    for scheme in listed.member_names():
        try:
            entry = listed.require(scheme)
            points = [place[one.integer()] for one in entry.require("points").items()]
            names = tuple(one.text() for one in entry.require("names").items())
            if names and len(names) != len(points):
                raise entry.error(f"{len(names)} names, expected {len(points)}")
            found[scheme] = Landmarks(indices=np.array(points, np.int32), names=names)
        except (InputError, KeyError) as error:
            _warn(document, listed, error)
    return found


def anchor(document: Document, geometry: Geometry, weld: Weld) -> int | None:
    """The anchor; None where there is none."""
    ours, place = _ours(document, geometry, weld)
    value = None if ours is None else ours.get("anchor")
    if value is None:
        return None
    try:
        return place[value.integer()]
    except (InputError, KeyError) as error:
        _warn(document, value, error)
        return None


def _warn(document: Document, value: Value, error: InputError | KeyError) -> None:
    if isinstance(error, InputError):
        document.warn(error.where, f"{error.what}: left out")
    else:
        document.warn(value, f"point {error.args[0]} is in no triangle: left out")


def _ours(document: Document, geometry: Geometry, weld: Weld) -> tuple[Value | None, dict[int, int]]:
    """What our exporter says of the mesh, and the point of each of its point numbers."""
    extras, numbers = geometry.value.get("extras"), geometry.vertices.point_numbers
    ours = extras.get("facepipe") if extras is not None and isinstance(extras.data, dict) else None
    if ours is None or not isinstance(ours.data, dict):
        return None, {}
    if numbers is None:
        document.warn(ours, "no _FACEPIPE_POINT in the file any more: landmarks and anchor are left out")
        return None, {}
    return ours, dict(zip(numbers[weld.vertices].tolist(), range(len(weld.vertices)), strict=True))
