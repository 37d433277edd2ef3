"""`facepipe fit-neutral` without a template: the built-in head on a scan, ready for use."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from command_line import Capsys, done, run
from contacts import BLINKS, Subject, blink, eye_sheets, person
from import_data import shared
from node import validate

import facepipe
from facepipe.core.policy.paths import Trust, trusting
from facepipe.heads import make
from facepipe.heads.assembly import LIDS, settled
from facepipe.heads.asset import asset
from facepipe.parts import FaceParts
from facepipe.performing import read_kept
from facepipe.scanning.rebuild.built_in_head import bare_head, people
from facepipe.scanning.rebuild.fit_neutral import are_sealed, shut_eyes, with_sealed_lips
from facepipe.scanning.rebuild.fit_neutral_action import FitNeutralAction
from facepipe.scanning.rebuild.template import Template
from facepipe.scans import ScanLandmarks
from facepipe.verbs.author_neutral import AuthorNeutral
from facepipe.verbs.whole_faces import Topology, whole_points

SIZE = 64  # texels
CARDS = {"Brows", "Lashes", "Hair"}


@cache
def built_in() -> tuple[FaceParts, FaceParts]:
    """The head, and it without hair."""
    parts = make(0, textures=SIZE)
    body = bare_head(parts)
    assert body is not None
    return parts, body


def test_other_faces_are_no_built_in_heads() -> None:
    parts, body = built_in()
    assert bare_head(replace(parts, meshes=parts.meshes[1:])) is None
    assert bare_head(replace(parts, meters_per_unit=0.001)) is None
    bare = bare_head(make(5))
    assert bare is not None
    assert Topology.of(bare).digest == Topology.of(body).digest


def test_people_are_those_of_the_modes() -> None:
    identity = people(built_in()[1]).identity
    assert len(identity.deviations) == len(asset().modes)
    spread = np.einsum("knc,k->nc", identity.components**2, identity.deviations**2)  # variance of each coordinate
    np.testing.assert_allclose(spread, ((10 * asset().modes.astype(np.float64)) ** 2).sum(axis=0), rtol=1e-6, atol=1e-6)


def test_eyes_lids_and_cards_are_those_of_the_person() -> None:
    """Given a drawn person's skin, all that goes with it comes out as that person has it."""
    truth, (parts, body) = make(21, textures=SIZE), built_in()
    count = Topology.of(body).point_count
    points = np.concatenate([whole_points(truth)[:count], whole_points(parts)[count:]])
    found = settled(parts, AuthorNeutral().changed(parts, points))
    for mesh, own in zip(found.meshes, truth.meshes, strict=True):
        if len(mesh.points) != len(own.points):
            continue  # hair of another style
        np.testing.assert_allclose(mesh.points, own.points, atol=1e-6)
        offsets = {shape.name: shape.offsets for shape in own.blendshapes}
        for shape in mesh.blendshapes:
            if mesh.name in CARDS or shape.name in LIDS:
                assert np.abs(shape.offsets - offsets[shape.name]).mean() < 3e-3, shape.name  # cm


def test_shut_eyes_are_seen_by_their_landmarks() -> None:
    shapes, blinks = asset().shapes, ("eyeBlink_L", "eyeBlink_R")
    rest = asset().points
    left = rest + shapes["eyeBlinkLeft"][1.0]
    both = left + shapes["eyeBlinkRight"][1.0]
    marks = [ScanLandmarks(points=points[asset().landmarks]) for points in (rest, left, both)]
    assert [shut_eyes(one, BLINKS) for one in marks] == [{}, {BLINKS[0]: 1.0}, dict.fromkeys(BLINKS, 1.0)]
    assert shut_eyes(marks[2], blinks) == dict.fromkeys(blinks, 1.0)
    assert shut_eyes(marks[2], ("jawOpen",)) == {}
    assert shut_eyes(ScanLandmarks(), BLINKS) == {}  # none is known


def test_lips_that_the_landmarks_show_shut_meet() -> None:
    template = Template.of(built_in()[1], "head")
    points, marks = template.points, template.rows[template.landmarks]
    parted, met = np.array(points[marks]), np.array(points[marks])
    met[[61, 62, 63]] = met[[67, 66, 65]]
    parted[[61, 62, 63], 1] += 2.0  # mm
    assert not are_sealed(ScanLandmarks(points=parted))
    assert are_sealed(ScanLandmarks(points=met))
    assert not are_sealed(ScanLandmarks())
    moved = points + 2.0 * (points[:, [1]] > points[marks[62], 1] - 0.01) * [0.0, 1.0, 0.0]  # lips 2 mm farther apart
    sealed = with_sealed_lips(template, moved)
    before, after = ((one[marks[62]] - one[marks[66]])[1] for one in (moved, sealed))
    assert before > 2.0
    assert abs(after) < 0.3
    width = np.linalg.norm(points[marks[64]] - points[marks[60]])
    far = np.linalg.norm(points - points[marks[60:68]].mean(axis=0), axis=1) > width
    np.testing.assert_array_equal(sealed[far], moved[far])


@pytest.mark.slow
def test_a_real_scan_becomes_a_ready_face_by_one_command(tmp_path: Path, capsys: Capsys) -> None:
    """Its eyes are shut, it has no unit, and nothing but the scan is given."""
    scan = shared("scans/LeePerrySmith.glb")
    out, glb = tmp_path / "face.usda", tmp_path / "face.glb"
    code, printed, err = run(capsys, "fit-neutral", scan, "-o", out, "--json")
    assert code == 0, err
    report = json.loads(printed)
    assert report["quality"]["surface_mean_mm"] < 0.2
    assert set(report["weights"]) == set(BLINKS)
    with trusting(Trust(roots=(tmp_path, scan.parent))):  # the scan lies elsewhere
        kept = read_kept(out, FitNeutralAction)
    assert (kept.values["template"], kept.values["database"], kept.standalone) == (None, None, True)
    face = facepipe.open(out).parts()
    assert {mesh.name for mesh in face.meshes} >= {"Teeth", *CARDS}
    corners = face.meshes[0].points[np.asarray(face.meshes[0].landmarks["multipie68"].indices)[[36, 45]]]
    assert 8.0 < np.linalg.norm(corners[1] - corners[0]) < 10.2  # cm between the outer corners of the eyes
    assert len(face.skeleton.joints) == 44
    found = blink(Subject(face), eye_sheets(person(0)))
    assert found.shown <= 0.01
    assert found.through.cells == 0
    done(capsys, "export", out, "-o", glb, quiet=False)
    (checked,) = validate([glb]).values()  # the Khronos validator's
    assert checked["issues"]["numErrors"] == checked["issues"]["numWarnings"] == 0
