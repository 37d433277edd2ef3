"""Sliders kept ready: what they give is what the commands make of the same values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facepipe.core.errors import InputError
from facepipe.heads import make
from facepipe.heads.asset import asset
from facepipe.hosting.live_sliders import LiveSliders
from facepipe.parts import Slider
from facepipe.payload.person import decode_person
from facepipe.rig import set_face
from facepipe.stage import open_face, save_parts
from facepipe.verbs.person import encoded_person
from facepipe.verbs.person_basis import head_basis
from facepipe.verbs.whole_faces import whole_points

NAMES = tuple(asset().parts)  # meshes of the basis


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A person with an identity slider and a measure that are set."""
    path = tmp_path_factory.mktemp("live") / "person.usdc"
    parts = make(7)
    own = {one.name: 0.4 * one.maximum for one in (modes_of(parts.sliders)[2], measures_of(parts.sliders)[4])}
    sliders = tuple(replace(one, value=own.get(one.name, one.value)) for one in parts.sliders)
    save_parts(replace(parts, sliders=sliders), path)
    return path


def modes_of(sliders: Sequence[Slider]) -> list[Slider]:
    """Sliders of identity."""
    return [one for one in sliders if one.modes]


def measures_of(sliders: Sequence[Slider]) -> list[Slider]:
    """Sliders of shapes."""
    return [one for one in sliders if one.shapes and not one.modes]


def test_points_are_those_of_the_face_with_these_values(stage: Path) -> None:
    live, face = LiveSliders(stage), open_face(stage)
    count = sum(len(mesh.points) for mesh in live.base.meshes if mesh.name in NAMES)
    start = face.evaluate(pose="set")
    one, other = modes_of(live.sliders)[5], measures_of(live.sliders)[9]
    first = live.offsets({one.name: 0.7 * one.maximum, other.name: 0.6 * other.minimum})
    for values in ({other.name: 0.5 * other.maximum}, {one.name: 0.7 * one.maximum, other.name: 0.6 * other.minimum}):
        expected = 10 * (face.evaluate(sliders=values) - start)  # centimetres
        found = live.offsets(values)
        assert np.abs(expected).max() > 0.5
        assert np.abs(found - expected)[:count].max() < 0.05
        assert np.abs(found - expected).max() < 1.0  # cards of hair are fitted by the command alone
    assert np.array_equal(found, first)  # whatever was asked for between
    assert not live.offsets({}).any()


def test_a_payload_is_the_person_that_the_values_make(stage: Path) -> None:
    live = LiveSliders(stage)
    one, other = modes_of(live.sliders)[5], measures_of(live.sliders)[9]
    values = {one.name: 0.7 * one.maximum, other.name: 0.6 * other.minimum}
    sliders = tuple(replace(each, value=values.get(each.name, each.value)) for each in live.sliders)
    parts, basis = replace(live.base, sliders=sliders), head_basis()

    def rebuilt(data: bytes) -> np.ndarray:
        return basis.rebuilt(decode_person(data, "payload"), "payload")

    found, commands = rebuilt(live.payload(values)), rebuilt(encoded_person(parts, "person")[0])
    assert np.linalg.norm(found - commands, axis=1).mean() < 0.1  # millimetres: points go by steps of one
    expected = whole_points(basis.known(set_face(parts).parts, "expected"))
    assert np.linalg.norm(found - expected, axis=1).max() < 1.02


def test_values_that_no_slider_takes_are_refused(stage: Path) -> None:
    live = LiveSliders(stage)
    name = measures_of(live.sliders)[0].name
    for values, told in (({name: 1e3}, f"slider {name}"), ({name: float("nan")}, f"slider {name}"), ({"x": 1}, "'x'")):
        with pytest.raises(InputError, match=told):
            live.offsets(values)
