"""What of the mouth's inside, teeth, gums and tongue, comes through the skin of a rebuilt face."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.contacts import Sheet
from facepipe.scanning.rebuild.template import Template

_MOUTH = slice(48, 68)  # of multipie68
_PRESSED = ("mouthPressLeft", "mouthPressRight")  # lips without the gap that they may have at rest
_CELLS, _DEPTH_MM = 4, 0.3  # of 0.5 mm, over five views: what a shape of the head in the box may have
_MOVES_MM = 0.5  # shapes that move lips and teeth less don't bring one through the other


@dataclass(frozen=True, kw_only=True)
class MouthContact:
    """How far the mouth's inside comes through the skin, where that is more than a shape may have."""

    depth_mm: float
    cells: int  # of 0.5 mm that show it, over five views
    template_mm: float  # depth on the template, with its own shape

    @property
    def is_new(self) -> bool:
        """The template has it less."""
        return self.depth_mm > max(_DEPTH_MM, self.template_mm)


def mouth_contacts(
    template: Template, neutral: FloatArray, shapes: Mapping[str, FloatArray], own: Mapping[str, FloatArray]
) -> dict[str, MouthContact]:
    """Shape at weight 1, or "neutral" -> what comes through; without those where nothing does to speak of.

    :param neutral: (n, 3) whole points
    :param shapes: name -> (n, 3) whole deltas
    :param own: those of the template
    """
    triangles, inside = template.topology.triangles, _inside(template)
    hard = triangles[np.isin(triangles, inside).all(axis=1)]
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
                found[name] = MouthContact(depth_mm=contact.depth, cells=contact.cells, template_mm=before.depth)
    return found


def mouth_lines(contacts: Mapping[str, MouthContact]) -> Iterator[str]:
    """A line for each shape that the template has without, or with less."""
    for name, contact in contacts.items():
        if contact.is_new:
            depths = f"{contact.depth_mm:.1f} mm (the template's by {contact.template_mm:.1f} mm)"
            yield f"{name}: teeth, gums or tongue come through the skin by {depths}"


def _inside(template: Template) -> np.ndarray:
    """Points of loose parts that are nearer to the mouth's landmarks than to others."""
    marks = template.points[template.rows[template.landmarks]]
    pieces = template.stiff
    found = [np.zeros(0, np.int64)]
    for piece in range(int(pieces.max(initial=-1)) + 1):
        points = np.flatnonzero(pieces == piece)
        distances = np.linalg.norm(marks - template.points[points].mean(axis=0), axis=1)
        if distances[_MOUTH].min() <= distances.min():
            found.append(points)
    return np.concatenate(found)
