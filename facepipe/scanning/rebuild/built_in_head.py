"""What the built-in head knows of itself when it is fitted to a scan: who people are, and what goes with their skin."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from facepipe.core import __version__
from facepipe.core.arrays import FloatArray
from facepipe.geometry.contacts import Sheet
from facepipe.geometry.identity_model import IdentityModel
from facepipe.parts import FaceParts
from facepipe.scanning.database import FaceDatabase, Update
from facepipe.scanning.rebuild.template import Template
from facepipe.verbs.whole_faces import Topology, whole_points

_MOUTH = slice(48, 68)  # of multipie68
_PRESSED = ("mouthPressLeft", "mouthPressRight")  # lips without the gap that they may have at rest
_CELLS, _DEPTH_MM = 4, 0.3  # of 0.5 mm, over five views: what a shape of the head in the box may have
_MOVES_MM = 0.5  # shapes that move lips and teeth less don't bring one through the other
_TO_MM = 10.0  # its points are in centimetres
_TOLERANCE_MM = 0.1


def mouth_contacts(
    template: Template, neutral: FloatArray, shapes: Mapping[str, FloatArray], own: Mapping[str, FloatArray]
) -> dict[str, dict[str, float]]:
    """Shape at weight 1, or "neutral" -> how far the mouth's inside comes through the skin, where that is more than a
    shape may have: `depth_mm`, the `cells` of 0.5 mm that show it over five views, and `template_mm`, the depth on the
    template with its own shape.

    :param neutral: (n, 3) whole points
    :param shapes: name -> (n, 3) whole deltas
    :param own: those of the template
    """
    # the mouth's inside: points of loose parts that are nearer to its landmarks than to others
    marks, pieces = template.points[template.rows[template.landmarks]], template.stiff
    inside = [np.zeros(0, np.int64)]
    for piece in range(int(pieces.max(initial=-1)) + 1):
        points = np.flatnonzero(pieces == piece)
        distances = np.linalg.norm(marks - template.points[points].mean(axis=0), axis=1)
        if distances[_MOUTH].min() <= distances.min():
            inside.append(points)
    triangles = template.topology.triangles
    hard = triangles[np.isin(triangles, np.concatenate(inside)).all(axis=1)]
    if not len(hard):
        return {}
    skin = triangles[(template.row_of[triangles] >= 0).all(axis=1)]
    pressed = [own[name] for name in _PRESSED if name in own]
    sheet = Sheet.of(skin, hard, [template.points + np.sum(pressed, axis=0)] if pressed else [template.points])
    around, nothing = np.unique(np.append(sheet.outer, sheet.hard)), np.zeros_like(neutral)
    found = {}
    for name, delta in {"neutral": nothing, **shapes}.items():
        if name == "neutral" or np.abs(delta[around]).max() > _MOVES_MM:
            contact = sheet.before_skin(neutral + delta)
            if contact.cells > _CELLS and contact.depth > _DEPTH_MM:
                before = sheet.before_skin(template.points + own.get(name, nothing))
                found[name] = {"depth_mm": contact.depth, "cells": contact.cells, "template_mm": before.depth}
    return found


def mouth_lines(contacts: Mapping[str, Mapping[str, float]]) -> Iterator[str]:
    """A line for each shape that the template has without, or with less."""
    for name, contact in contacts.items():
        depth, before = contact["depth_mm"], contact["template_mm"]
        if depth > max(_DEPTH_MM, before):
            depths = f"{depth:.1f} mm (the template's by {before:.1f} mm)"
            yield f"{name}: teeth, gums or tongue come through the skin by {depths}"


def bare_head(parts: FaceParts) -> FaceParts | None:
    """The average head without hair, where `parts` are the built-in head with cards of hair or without; None: they are
    another face."""
    from facepipe.heads.assembly import average
    from facepipe.heads.asset import asset

    names = asset().parts
    known = parts.meshes[: len(names)]
    if [mesh.name for mesh in known] != list(names) or (parts.meters_per_unit, parts.up_axis) != (0.01, "Y"):
        return None
    body = average()
    return body if Topology.of(replace(parts, meshes=known)).digest == Topology.of(body).digest else None


def people(body: FaceParts) -> FaceDatabase:
    """Who people may be: the identity modes of the bare head."""
    from facepipe.heads.assembly import modes

    return of_nobody(Topology.of(body), IdentityModel.from_modes(whole_points(body), _TO_MM * modes()))


def of_nobody(topology: Topology, identity: IdentityModel) -> FaceDatabase:
    """A database that knows how people differ, and none of them."""
    return FaceDatabase(
        topology=topology,
        identity=identity,
        coefficients=np.zeros((0, len(identity.deviations))),
        expressions=None,
        entries=(),
        history=(Update(version=1, verb="create", entries=(), facepipe=__version__),),
        tolerance_mm=_TOLERANCE_MM,
    )


def with_inside_fitted(points: FloatArray) -> FloatArray:
    """(n, 3) whole points of the bare head in millimetres, with eyeballs that fit lids, and a mouth behind skin."""
    from facepipe.heads.assembly import with_parts_fitted

    return _TO_MM * with_parts_fitted(points / _TO_MM)
