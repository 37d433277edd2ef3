"""`facepipe personal-template`: the shapes that a person starts from."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import expression_domes
import numpy as np
import pytest
from command_line import done, run
from expression_domes import OWN
from rebuild_stages import Files

import facepipe
from facepipe.checks import validate
from facepipe.scanning.database import create_database, save_database
from facepipe.scanning.rebuild.personal_template import _change
from facepipe.stage import save_parts
from facepipe.verbs.whole_faces import WholeFace, whole_face, whole_points


def test_starting_shapes_are_the_templates_carried_over(stages: Files) -> None:
    """On other proportions they move about as much, the same way; the neutral is not touched."""
    for shape in OWN:
        own, template = stages.delta("personal.usda", shape), expression_domes.template_motion(shape)
        assert np.abs(own - template).max() < 0.25 * np.abs(template).max()
        assert np.abs(own - template).max() > 1e-3
    before, after = (facepipe.open(stages[name]) for name in ("anna.usda", "personal.usda"))
    assert np.array_equal(whole_points(before.parts()), whole_points(after.parts()))
    assert after.shapes == before.shapes
    assert after.skeleton.joints == before.skeleton.joints
    assert validate(stages["personal.usda"]) == ()


def test_the_change_of_shapes_is_over_the_points_that_the_templates_move() -> None:
    one, way = np.zeros((3, 3)), np.array([0.0, 0.0, 1.0])
    generic = {"open": one + np.array([[2.0], [1.0], [0.0]]) * way, "still": one}
    shapes = {"open": generic["open"] + np.array([[0.5], [0.3], [9.0]]) * way, "still": one + way, "new": one + way}
    assert _change(shapes, generic) == pytest.approx(0.4)


def test_on_the_template_itself_starting_shapes_are_its_own(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    save_parts(expression_domes.face(), files["anna.usda"])
    out = done(capsys, *files.personal("--json"))
    assert json.loads(out)["change_mean_mm"] < 1e-4
    for shape in OWN:
        assert np.abs(files.delta("p.usda", shape) - expression_domes.template_motion(shape)).max() < 1e-3


def test_a_database_with_expressions_gives_the_starting_shapes(
    files: Files, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its people move 1.3 times as much as the template does, and so will this one; what it lacks stays."""
    people = [_mover(seed, 1.3) for seed in range(1, 5)]
    save_database(create_database(people).database, files["faces.fpdb"])
    code, out, err = run(capsys, *files.personal("--database", files["faces.fpdb"], "--json"))
    assert code == 0, err
    assert json.loads(out)["source"] == "from the database"
    assert list(json.loads(out)["motion_mm"]) == ["jawOpen"]
    assert "1 shapes that the source lacks stay as they are: browUp" in err
    from_template = files.delta("personal.usda", "jawOpen")
    assert np.abs(files.delta("p.usda", "jawOpen") - 1.3 * from_template).max() < 0.3
    assert np.array_equal(files.delta("p.usda", "browUp"), files.delta("anna.usda", "browUp"))
    words = files.personal("--database", files["faces.fpdb"], "--shapes-from", "template", "--force", "--json")
    assert json.loads(run(capsys, *words)[1])["source"] == "from the template"
    assert np.array_equal(files.delta("p.usda", "jawOpen"), from_template)


def _mover(seed: int, gain: float) -> Callable[[], WholeFace]:
    parts = expression_domes.face(seed)
    jaw = parts.meshes[0].blendshapes[0]
    head = replace(parts.meshes[0], blendshapes=(replace(jaw, offsets=gain * jaw.offsets),))
    return lambda: whole_face(replace(parts, meshes=(head, *parts.meshes[1:])), f"p{seed}")
