"""Sliders of a blend are set as its person is, and move the blended neutral no second time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from blend_faces import changed
from faces import replace_mesh, tiny_face
from network_faces import SLIDERS, network

import facepipe
from facepipe.parts import FaceParts, Mesh, Slider
from facepipe.rig import build, person_of, set_face, slide
from facepipe.stage import Face, save_parts
from facepipe.verbs.blend import Blend, BlendSession, Weights

GLOBAL = Weights(default=(0.25, 0.75))


def person(seed: int, sliders: tuple[Slider, ...] = SLIDERS, **values: float) -> FaceParts:
    """A face of sliders with curves and a network, some of them set."""
    made = tuple(replace(one, value=values.get(one.name)) for one in sliders)
    return replace(tiny_face(seed), sliders=made, slider_network=network() if sliders is SLIDERS else None)


def blend(*parts: FaceParts, weights: Weights = GLOBAL) -> FaceParts:
    face = Face.from_parts(parts[0])
    Blend(weights=weights)(face, BlendSession([Face.from_parts(one) for one in parts]))
    return Face(face.stage).parts()


def defaults(parts: FaceParts) -> Mapping[str, float]:
    assert all(one.value is None for one in parts.sliders)
    return {one.name: one.default for one in parts.sliders}


def test_values_are_the_mean_of_the_sources_and_are_in_the_neutral_once() -> None:
    one, other = person(0, smile=0.4, lip=0.9), person(1, smile=0.8, lip=-0.5, straight=-1.0)
    result = blend(one, other)
    expected = {"smile": 0.7, "lip": -0.15, "straight": -0.75, "jaw": 0.0, "still": 0.5}
    assert defaults(result) == pytest.approx(expected, abs=1e-6)
    assert person_of(result).is_rest
    baked = blend(*(replace(set_face(face).parts, sliders=(), slider_network=None) for face in (one, other)))
    np.testing.assert_allclose(Face.from_parts(result).evaluate(), Face.from_parts(baked).evaluate(), atol=1e-6)


def test_sliders_add_nothing_where_they_rest_and_what_they_did_beyond() -> None:
    """Curves and a network too; from what the base's do at the mean."""
    one, other = person(0, smile=0.4, lip=0.9), person(1, smile=0.8, lip=-0.5)
    result, own = blend(one, other), set_face(one).parts
    joints = result.skeleton.joints
    rest, weights = slide(result.sliders, joints, network=result.slider_network)
    np.testing.assert_allclose(rest, np.tile([0.0] * 6 + [1.0] * 3, (len(joints), 1)), atol=1e-6)
    assert all(abs(value) < 1e-6 for value in weights.values())
    start = slide(own.sliders, joints, defaults(result), own.slider_network)
    for values in ({"smile": 1.0}, {"jaw": 0.3, "lip": 1.2}):
        there = slide(own.sliders, joints, {**defaults(result), **values}, own.slider_network)
        found = slide(result.sliders, joints, values, result.slider_network)
        np.testing.assert_allclose(found[0] - rest, there[0] - start[0], atol=1e-6)
        for shape, weight in found[1].items():
            assert weight == pytest.approx(there[1][shape] - start[1][shape], abs=1e-6)


def test_a_slider_takes_the_weights_of_what_it_moves() -> None:
    """Of its shapes' points, by how far they move, or of its joints; one that moves nothing of the default."""

    def halves(parts: FaceParts) -> FaceParts:
        def masked(mesh: Mesh) -> Mesh:
            left = (mesh.points[:, 0] < np.median(mesh.points[:, 0])).astype(np.float32)
            return replace_mesh(mesh, regions={"mouth": left, "neck": 1 - left}, point_subsets={})

        return changed(parts, masked)

    sliders = Slider(name="smile", shapes=(("mouthSmileLeft", 1.0),)), Slider(name="idle")
    faces = [halves(person(seed, sliders, smile=seed, idle=seed)) for seed in range(2)]
    weights = Weights(regions={"mouth": (1.0, 0.0), "neck": (0.2, 0.8)}, default=(0.5, 0.5))
    session = BlendSession([Face.from_parts(face) for face in faces])
    shares = session.neutral(weights).shares
    smile = next(one for one in session.sculpts if one.name == "mouthSmileLeft")
    squares = (smile.offsets**2).sum(axis=2).mean(axis=0)
    found = defaults(blend(*faces, weights=weights))
    assert found["smile"] == pytest.approx(np.average(shares[smile.points, 1], weights=squares), abs=1e-6)
    assert 0.0 < found["smile"] < 0.8
    assert found["idle"] == 0.5


def test_sliders_of_another_kind_have_no_say() -> None:
    """Another range, other shapes, or none of that name: their share goes to the rest."""
    own = (Slider(name="smile", shapes=(("mouthSmileLeft", 1.0),)),)
    wide, jaw = replace(own[0], maximum=2.0), replace(own[0], shapes=(("jawOpen", 1.0),))
    first = person(0, own, smile=0.5)
    for others in ((wide,), (jaw,), ()):
        assert defaults(blend(first, person(1, others, smile=1.0))) == {"smile": 0.5}
    faces = first, person(1, (jaw,), smile=1.0), person(2, own, smile=1.0)
    three = blend(*faces, weights=Weights(default=(0.2, 0.6, 0.2)))
    assert defaults(three)["smile"] == pytest.approx(0.75)


def test_values_beyond_the_range_stay_within_it_and_a_blend_of_blends_goes_on() -> None:
    own = (Slider(name="smile", shapes=(("mouthSmileLeft", 1.0),)),)
    faces = [person(0, own, smile=0.2), person(1, own, smile=0.9)]
    assert defaults(blend(*faces, weights=Weights(default=(-1.0, 2.0)))) == {"smile": 1.0}
    half = blend(*faces, weights=Weights(default=(0.5, 0.5)))
    again = blend(half, faces[1], weights=Weights(default=(0.5, 0.5)))
    assert defaults(again)["smile"] == pytest.approx(0.725)


def test_a_layer_over_the_first_source_takes_its_value_back(tmp_path: Path) -> None:
    """Where nothing is set, sliders stay as they are."""
    for name, face in (("a", person(0, smile=0.4)), ("b", person(1, smile=0.8)), ("plain", person(2))):
        save_parts(face, tmp_path / f"{name}.usda")
    for names, authored in (("ab", True), (("plain", "b"), True), (("plain",), False)):
        sources = [facepipe.open(tmp_path / f"{name}.usda") for name in names]
        out = tmp_path / f"{'_'.join(names)}_out.usda"
        with sources[0].deriving(out) as face:
            Blend(weights=Weights())(face, sources)
        parts = facepipe.open(out).parts()
        assert person_of(parts).is_rest
        assert ("slider:smile" in out.read_text().replace("facepipe:", "")) == authored
        shown = facepipe.open(out).evaluate()
        np.testing.assert_allclose(shown, build(parts).evaluate(), atol=1e-6)
