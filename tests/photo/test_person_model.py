"""Identity modes in a photo fit: the person is in the sliders and a section, and is nearer than the average head."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from photographed_face import SOON, fit_photo
from PIL import Image
from scipy.stats import chi2

import facepipe
from facepipe.core.errors import TopologyError
from facepipe.geometry.similarity import fit_similarity
from facepipe.heads import make
from facepipe.heads.assembly import make_head
from facepipe.heads.asset import asset
from facepipe.parts import FaceParts
from facepipe.photo.fit.person_model import IdentityReport, PersonModel, person_model
from facepipe.stage import save_parts
from facepipe.verbs.person_basis import head_basis
from facepipe.verbs.whole_faces import whole_points

pytestmark = pytest.mark.needs_torch

NARROW = slice(0, 6706)  # ICT-FaceKit's narrow face


@pytest.fixture(scope="module")
def head(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("head") / "head.usdc"
    save_parts(make(0), path)
    return path


@pytest.fixture(scope="module")
def model(head: Path) -> PersonModel:
    found = person_model(facepipe.open(head).parts(), "head")
    assert found is not None
    return found


def someone(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, 0.7, len(asset().modes))


def test_the_person_is_in_the_sliders_and_a_section(head: Path, model: PersonModel, tmp_path: Path) -> None:
    from facepipe.photo.descent.subject import Subject

    person, sliders = model.points(someone(1)), Subject.of(model.parts).free_sliders
    before = facepipe.open(head)
    with before.deriving(tmp_path / "person.usdc") as face:
        values, report = model.author(face, someone(1), sliders)
    assert (tmp_path / "person.usdc").stat().st_size < 2_000
    face = facepipe.open(tmp_path / "person.usdc")
    seen = np.intersect1d(model.face, head_basis().fitted)
    off, left = (np.linalg.norm((10 * one.evaluate(sliders=values) - person)[seen], axis=1) for one in (face, before))
    assert off.mean() == pytest.approx(report.beyond_section_mean_mm, abs=1e-3)
    assert off.mean() < 0.03
    assert left.mean() == pytest.approx(report.beyond_sliders_mean_mm, abs=0.01)
    assert left.mean() < 0.3
    ranges = {slider.name: slider.maximum for slider in face.sliders}
    assert np.mean([abs(value) >= ranges[name] for name, value in values.items()]) <= 0.02
    assert face.shapes == before.shapes
    assert [slider.name for slider in face.sliders] == [slider.name for slider in before.sliders]


def test_a_head_without_sliders_of_modes_gets_the_person_as_its_neutral(model: PersonModel, tmp_path: Path) -> None:
    from facepipe.photo.descent.subject import Subject

    parts = make(0)
    save_parts(replace(parts, sliders=tuple(one for one in parts.sliders if not one.modes)), tmp_path / "head.usdc")
    found = person_model(facepipe.open(tmp_path / "head.usdc").parts(), "head")
    assert found is not None
    with facepipe.open(tmp_path / "head.usdc").deriving(tmp_path / "person.usda") as face:
        values, report = found.author(face, someone(1), Subject.of(found.parts).free_sliders)
    face = facepipe.open(tmp_path / "person.usda")
    person = found.points(someone(1))
    np.testing.assert_allclose(10 * face.evaluate(sliders=values), person, rtol=0, atol=0.01)
    apart = np.linalg.norm(whole_points(found.parts) - person, axis=1)[found.face].mean()
    assert report.beyond_sliders_mean_mm < 0.6 * apart
    assert not report.section_bytes


def test_a_blink_closes_the_eyes_of_the_person(head: Path, model: PersonModel, tmp_path: Path) -> None:
    wide = 2.0 * np.sign(someone(3))
    with facepipe.open(head).deriving(tmp_path / "person.usda") as face:
        values, _ = model.author(face, wide, ())
    own = facepipe.open(tmp_path / "person.usda").with_identity(values)
    average = facepipe.open(head)
    closed = [face.evaluate({"eyeBlinkLeft": 1.0}) - face.evaluate() for face in (own, average)]
    gap = lid_gap(own.evaluate({"eyeBlinkLeft": 1.0}))
    assert gap <= lid_gap(average.evaluate({"eyeBlinkLeft": 1.0})) + 0.03  # cm
    assert np.abs(closed[0] - closed[1]).max() > 0.02  # not that of the average head


def lid_gap(points: np.ndarray) -> float:
    """Centimetres between the middles of the left upper and lower lid."""
    marks = points[asset().landmarks]
    return float(np.linalg.norm((marks[43] + marks[44] - marks[47] - marks[46]) / 2))


@pytest.mark.slow
def test_landmarks_find_a_person_better_than_the_average_head(head: Path, tmp_path: Path) -> None:
    parts = make_head(someone(11))
    truth = np.concatenate([mesh.points for mesh in parts.meshes])
    views = [tmp_path / "front.png", tmp_path / "left.png"]
    for yaw, path in zip((0.0, 0.6), views, strict=True):
        photograph(parts, yaw, path)
    marks = [str(path.with_suffix(".json")) for path in views]
    words = [*map(str, views), str(head), *(word for one in marks for word in ("--landmarks", one))]
    assert fit_photo(*words, "-o", tmp_path / "me.usda", *SOON) == 0
    face = facepipe.open(tmp_path / "me.usda")
    values = {slider.name: slider.value for slider in face.sliders if slider.value is not None}
    found = error(face.evaluate(sliders=values), truth)
    assert found < 0.7 * error(asset().points, truth)


def photograph(parts: FaceParts, yaw: float, path: Path, size: int = 256) -> None:
    """A black picture, and beside it where a camera sees the landmarks, which is all that a fit needs."""
    from facepipe.photo.descent.landmark_rig import LandmarkRig
    from facepipe.photo.descent.subject import Subject
    from facepipe.photo.renderer.camera import Camera

    Image.new("RGB", (size, size)).save(path)
    rig = LandmarkRig.from_subject(Subject.of(parts))
    points = rig.rig()
    backward = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    axes = np.stack([(np.cos(yaw), 0.0, -np.sin(yaw)), (0.0, 1.0, 0.0), backward])
    eye = points[:68].mean(dim=0).numpy() + 90.0 * backward
    camera = Camera.at(axes, eye, 1.9 * size, (size / 2, size / 2), dtype=points.dtype)
    marks, _ = rig.landmarks(points, camera)
    path.with_suffix(".json").write_text(json.dumps({"multipie68": marks.tolist()}))


def error(found: np.ndarray, truth: np.ndarray) -> float:
    aligned = fit_similarity(found[NARROW], truth[NARROW]).apply(found[NARROW])
    return float(np.linalg.norm(aligned - truth[NARROW], axis=1).mean())


def test_faces_of_a_database_are_who_a_person_may_be(head: Path, tmp_path: Path) -> None:
    people = []
    for seed in (1, 2, 3):
        people.append(tmp_path / f"{seed}.usdc")
        save_parts(make(seed), people[-1])
    facepipe.database_create(people, out=tmp_path / "people.fpdb")
    found = person_model(facepipe.open(head).parts(), "head", tmp_path / "people.fpdb")
    assert found is not None
    mean = np.mean([whole_points(facepipe.open(path).parts()) for path in people], axis=0)
    np.testing.assert_allclose(found.points(np.zeros(2)), mean, atol=0.02)
    assert len(found.names) == 2


def test_a_database_of_another_topology_is_refused_and_other_faces_have_no_modes(tmp_path: Path) -> None:
    from small_head import make as small

    people = []
    for seed in (1, 2):
        people.append(tmp_path / f"{seed}.usda")
        save_parts(small(seed), people[-1])
    facepipe.database_create(people, out=tmp_path / "small.fpdb")
    with pytest.raises(TopologyError, match="expected"):
        person_model(make(0), "head", tmp_path / "small.fpdb")
    assert person_model(small(1), "small") is None


def test_hair_goes_with_the_skin() -> None:
    found = person_model(make(0, textures=16), "head")
    assert found is not None
    hair = found.points(someone(2))[found.count :] - whole_points(found.parts)[found.count :]
    skin = found.points(someone(2))[: found.count] - whole_points(found.parts)[: found.count]
    assert np.linalg.norm(hair, axis=1).mean() > 1.0  # millimetres
    assert np.linalg.norm(hair, axis=1).max() <= np.linalg.norm(skin, axis=1).max()


@pytest.mark.parametrize("modes", [10, 100])
def test_usual_deviations_are_those_of_all_but_one_in_a_thousand(modes: int) -> None:
    report = IdentityReport(modes=modes, deviations=1.0, beyond_sliders_mean_mm=0.0, beyond_sliders_max_mm=0.0)
    assert report.usual == pytest.approx((chi2.ppf(0.999, modes) / modes) ** 0.5, rel=5e-3)
