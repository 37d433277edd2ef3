"""What lies inside a head, and no scan shows, goes with the skin around it when a neutral is fitted; what does not is
found."""

from __future__ import annotations

from unittest import mock

import numpy as np
import pytest

from facepipe.heads.assembly import make
from facepipe.scanning.rebuild.built_in_head import mouth_contacts, mouth_lines
from facepipe.scanning.rebuild.template import Template
from facepipe.verbs.whole_faces import whole_face


@pytest.fixture(scope="module")
def template() -> Template:
    return Template.of(make(0), "head")


def test_the_mouths_inside_goes_back_with_the_chin(template: Template) -> None:
    base = template.points[template.rows]
    seen = np.zeros(len(base), bool)
    seen[template.seen] = True
    lips = base[template.landmarks[48:60]].mean(axis=0)
    away = np.zeros_like(base)
    away[:, 2] = -10.0 / (1.0 + np.exp((base[:, 1] - lips[1] + 10.0) / 4.0))  # mm, all below the lips
    alone = np.where(seen[:, None], away, 0.0)  # what a fit that knows the skin alone does
    moves = template.with_inside(base, alone)
    np.testing.assert_array_equal(moves[seen], away[seen])
    inside = ~seen & (np.abs(base[:, 0] - lips[0]) < 25) & (np.abs(base[:, 1] - lips[1] + 12) < 8) & (base[:, 2] > 70)
    assert inside.sum() > 100
    assert np.abs(alone - away)[inside, 2].max() > 8.0
    assert np.abs(moves - away)[inside, 2].mean() < 0.3 * np.abs(alone - away)[inside, 2].mean()


def test_one_move_of_all_is_everyones(template: Template) -> None:
    base, way = template.points[template.rows], np.array([1.0, -2, 3])
    np.testing.assert_allclose(template.with_inside(base, np.tile(way, (len(base), 1))), np.tile(way, (len(base), 1)))


def test_teeth_through_lips_are_found(template: Template) -> None:
    """By how far they come through; of a shape that leaves them where they are, nothing is found."""
    own = whole_face(template.parts, "head").deltas
    starts = np.cumsum([0, *(len(mesh.points) for mesh in template.parts.meshes)])
    names = [mesh.name for mesh in template.parts.meshes]
    teeth = slice(*starts[names.index("Teeth") :][:2])
    pushed = own["mouthSmileLeft"].copy()
    pushed[teeth, 2] += 12.0  # mm
    shapes = {"mouthSmileLeft": pushed, "jawOpen": own["jawOpen"]}
    found = mouth_contacts(template, template.points, shapes, own)
    assert set(found) == {"mouthSmileLeft"}
    contact = found["mouthSmileLeft"]
    assert contact["template_mm"] < 0.3
    assert 2.0 < contact["depth_mm"] < 12.0
    assert contact["cells"] > 1000
    assert list(mouth_lines(found)) == [
        f"mouthSmileLeft: teeth, gums or tongue come through the skin by {contact['depth_mm']:.1f} mm (the template's "
        f"by {contact['template_mm']:.1f} mm)"
    ]


def test_contacts_are_with_all_of_the_skin(template: Template) -> None:
    triangles = template.topology.triangles
    sheet = "facepipe.scanning.rebuild.built_in_head.Sheet.of"
    with mock.patch(sheet, side_effect=StopIteration) as made, pytest.raises(StopIteration):
        mouth_contacts(template, template.points, {}, {})
    skin = triangles[np.isin(triangles, template.rows).all(axis=1)]
    assert (skin == template.rows[0]).any()
    np.testing.assert_array_equal(made.call_args.args[0], skin)
