"""Poses and shapes of people who are not drawn: payloads have how their joints rest and their shapes turn."""

from __future__ import annotations

import struct
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from import_data import shared
from rebuilt_expressions import against_its_own, evaluated, pose
from rebuilt_people import RIG, with_rig
from scipy.spatial.transform import Rotation

import facepipe
from facepipe.core.errors import InputError
from facepipe.heads import make
from facepipe.heads.assembly import LIDS
from facepipe.heads.asset import asset
from facepipe.parts import FaceParts
from facepipe.payload.person import BASIS, PersonContent, decode_person, encode_person
from facepipe.payload.person import RIG as KIND
from facepipe.payload.sections import Section, pack
from facepipe.payload.small_numbers import encode_numbers
from facepipe.rig import set_face
from facepipe.rig.identity import with_identity
from facepipe.stage import save_parts
from facepipe.verbs.person import encoded_person
from facepipe.verbs.person_basis import head_basis
from facepipe.verbs.person_layers import encode_points
from facepipe.verbs.person_rig import RigChange, rig_of
from facepipe.verbs.whole_faces import whole_points


@cache
def drawn(seed: int) -> FaceParts:
    return make(seed)


def turned(parts: FaceParts) -> tuple[FaceParts, RigChange]:
    """A drawn face whose joints and shapes are turned, and by how much."""
    rng = np.random.default_rng(0)
    rests = np.tile(np.eye(4), (len(parts.skeleton.joints), 1, 1))
    rests[:, :3, :3] = Rotation.from_rotvec(rng.normal([0.05, -0.02, 0.01], 0.01, (len(rests), 3))).as_matrix()
    rests[:, :3, 3] = rng.normal(0, 0.5, (len(rests), 3))
    change = RigChange(rests=rests, shapes=1.05 * Rotation.from_rotvec([0.06, 0.01, -0.02]).as_matrix())
    return replace(change.turned(parts), skeleton=change.skeleton(parts.skeleton)), change


def test_a_rig_is_found_to_half_a_step() -> None:
    parts, change = turned(drawn(3))
    data, report = encoded_person(parts, "turned", within=0.5)
    content = decode_person(data, "turned")
    found = head_basis().rig_change(content)
    assert np.abs(found.rests[:, :3, 3] - change.rests[:, :3, 3]).max() <= 0.0501
    off = np.einsum("jba,jbc->jac", found.rests[:, :3, :3], change.rests[:, :3, :3])
    assert np.linalg.norm(Rotation.from_matrix(off).as_rotvec(), axis=1).max() <= 0.00025 * np.sqrt(3) * 1.1
    assert np.abs(found.shapes - change.shapes).max() < 1e-3
    alone = encode_person(replace(content, rig=None))
    assert alone == encode_points(head_basis(), whole_points(parts), within=0.5)[0]
    assert report.layers[-1].name == "rig"
    assert report.bytes == len(data) <= len(alone) + 250


@pytest.mark.parametrize("way", [{"within": 0.5}, pytest.param({"most": 900}, marks=pytest.mark.slow)])
def test_who_is_drawn_has_none(way: dict[str, float]) -> None:
    """Nor who sliders make of the average head: joints are where they make of points what is drawn."""
    data, report = encoded_person(drawn(3), "drawn", **way)
    assert data == encode_points(head_basis(), whole_points(drawn(3)), **way)[0]
    assert "rig" not in [layer.name for layer in report.layers]
    values = {"jawWidth": 0.8, "noseWidth": -0.7, "identity003": 1.0}
    sliders = tuple(replace(one, value=values.get(one.name)) for one in drawn(0).sliders)
    assert rig_of(replace(drawn(0), sliders=sliders)) is None


@pytest.mark.slow
def test_few_bytes_are_for_points() -> None:
    parts, _ = turned(drawn(3))
    few, many = (decode_person(encoded_person(parts, "turned", most=most)[0], "x") for most in (1300, 8000))
    assert few.rig is None
    assert many.rig is not None


def test_a_shape_that_somebody_changed_is_no_turn_of_all() -> None:
    head = drawn(0).meshes[0]
    weaker = {"jawOpen": 0.5, "mouthSmileLeft": 1.5}
    shapes = (replace(one, offsets=weaker.get(one.name, 1.0) * one.offsets) for one in head.blendshapes)
    assert rig_of(replace(drawn(0), meshes=(replace(head, blendshapes=tuple(shapes)), *drawn(0).meshes[1:]))) is None


@pytest.fixture(scope="module")
def rebuilt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of head.usdc, me.fpb with a rig, and points.usdc and section.usdc that are made of both."""
    folder = tmp_path_factory.mktemp("rig")
    save_parts(drawn(0), folder / "head.usdc")
    (folder / "me.fpb").write_bytes(with_rig(encode_points(head_basis(), whole_points(drawn(4)), within=50.0)[0]))
    for name, as_section in (("points", False), ("section", True)):
        facepipe.apply_bones(
            folder / "head.usdc", folder / "me.fpb", out=folder / f"{name}.usdc", as_section=as_section
        )
    return folder


def test_a_section_is_the_rewritten_face(rebuilt: Path) -> None:
    one, other = (facepipe.open(rebuilt / f"{name}.usdc").parts() for name in ("points", "section"))
    coefficients = pose(one, np.random.default_rng(0))
    for weights in ({}, {"jawOpen": 0.7}, {"eyeBlinkLeft": 0.4, "eyeLookDownRight": 1.0, "mouthSmileLeft": 1.0}):
        np.testing.assert_allclose(evaluated(one, weights), evaluated(other, weights), atol=1e-4)
        both = (evaluated(face, weights, coefficients) for face in (one, other))
        np.testing.assert_allclose(*both, atol=1e-4)
    for how in ("set", "set-joints", "rest"):
        first, second = (set_face(face, how).parts for face in (one, other))
        np.testing.assert_allclose(evaluated(first, {}, coefficients), evaluated(second, {}, coefficients), atol=1e-4)


def test_joints_and_shapes_are_what_the_payload_says(rebuilt: Path) -> None:
    parts, plain = facepipe.open(rebuilt / "points.usdc").parts(), drawn(0)
    change = RigChange.of(RIG, 44)
    places = np.einsum("jk,jkc->jc", asset().joint_shares, 0.1 * whole_points(parts)[asset().joint_points])
    worlds = np.asarray(parts.skeleton.bind_transforms)
    np.testing.assert_allclose(worlds[:, :3, 3], places + change.rests[:, :3, 3] / 10, atol=1e-4)
    np.testing.assert_allclose(worlds[:, :3, :3], change.rests[:, :3, :3], atol=1e-6)
    before = {shape.name: shape for shape in plain.meshes[0].blendshapes}
    for shape in parts.meshes[0].blendshapes:
        if shape.name not in LIDS:
            expected = before[shape.name].offsets @ change.shapes.T
            np.testing.assert_allclose(shape.offsets, expected, atol=1e-5)
            for own, was in zip(shape.inbetweens, before[shape.name].inbetweens, strict=True):
                np.testing.assert_allclose(own.offsets, was.offsets @ change.shapes.T, atol=1e-5)


def test_sliders_of_modes_keep_the_rig(rebuilt: Path) -> None:
    parts = facepipe.open(rebuilt / "section.usdc").parts()
    sliders = tuple(replace(one, value=1.5 if one.name == "identity002" else None) for one in parts.sliders)
    moved = with_identity(replace(parts, sliders=sliders))
    assert np.abs(whole_points(moved) - whole_points(parts)).max() > 0.5
    for one, other in ((moved, parts), (parts, moved)):
        np.testing.assert_allclose(
            np.asarray(one.skeleton.bind_transforms)[:, :3, :3],
            np.asarray(other.skeleton.bind_transforms)[:, :3, :3],
            atol=1e-6,
        )
    again = rig_of(moved)
    assert again is not None
    change = RigChange.of(again, 44)
    np.testing.assert_allclose(change.rests[:, :3, 3], RigChange.of(RIG, 44).rests[:, :3, 3], atol=0.06)


def section(*halves: float, count: int = 0, bits: bytes = b"") -> bytes:
    own = struct.pack("<6eB", *halves, count) + bits
    return pack([Section(BASIS, head_basis().digest), Section(KIND, own)])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (pack([Section(BASIS, head_basis().digest), Section(KIND, bytes(9))]), "-> rig: 9 bytes, expected at least 13"),
        (section(np.nan, 0, 0, 0, 0.1, 0.001), "-> rig -> shapes: nan 0 0 0, expected part of a quaternion, a scale"),
        (section(0.8, 0.8, 0, 0, 0.1, 0.001), "-> rig -> shapes: 0.799805 0.799805 0 0, expected part"),
        (section(0, 0, 0, 4, 0.1, 0.001), "-> rig -> shapes: 0 0 0 4, expected part"),
        (section(0, 0, 0, 0, 0, 0.001), "-> rig: steps of 0 mm, expected more than 0 and at most 10"),
        (section(0, 0, 0, 0, 0.1, np.inf), "-> rig: steps of inf radians, expected more than 0 and at most 0.1"),
        (
            section(0, 0, 0, 0, 0.1, 0.001, count=60, bits=encode_numbers(np.zeros((60, 6), int))),
            "-> rig: 60 joints, expected at most the 44 of its basis",
        ),
        (section(0, 0, 0, 0, 0.1, 0.001, count=44, bits=b"\xff" * 9), "-> rig"),
    ],
)
def test_a_damaged_rig_is_refused_in_a_line(data: bytes, message: str) -> None:
    with pytest.raises(InputError) as caught:
        head_basis().rebuilt(decode_person(data, "person"), "person")
    assert message in str(caught.value)
    assert str(caught.value).startswith("person")


def test_a_rig_beyond_limits_is_not_written() -> None:
    content = PersonContent(basis=head_basis().digest, modes=np.zeros(0), rig=replace(RIG, steps=np.full((2, 6), 128)))
    with pytest.raises(InputError, match="joint 0: 128 steps, expected at most 127"):
        encode_person(content)


@pytest.mark.slow
@pytest.mark.gate
def test_shapes_and_poses_of_a_blend_are_its_own(rebuilt: Path, tmp_path: Path) -> None:
    """52 shapes and 50 poses of all joints: 0.1 mm on average, where the points are 0.07 off."""
    for seed in (1504, 1505):
        save_parts(make(seed), tmp_path / f"{seed}.usdc")
    weights = {"regions": {"eyes": [1.0, 0.0], "nose": [0.0, 1.0], "mouth": [0.5, 0.5]}}
    facepipe.blend([tmp_path / "1504.usdc", tmp_path / "1505.usdc"], out=tmp_path / "blend.usdc", weights=weights)
    found = against_its_own(tmp_path / "blend.usdc", rebuilt / "head.usdc", tmp_path)
    assert len(found["with"].shapes) == 52
    assert max(found["with"].shapes.mean(), found["with"].poses.mean()) <= 0.1
    assert found["without"].shapes.mean() > 0.11
    assert found["without"].poses.mean() > 1.0


@pytest.mark.slow
@pytest.mark.needs_scan
def test_poses_of_a_scan_are_its_own(rebuilt: Path, tmp_path: Path) -> None:
    """As near as its points, which are 0.13 mm off."""
    facepipe.fit_neutral(shared("scans/LeePerrySmith.glb"), out=tmp_path / "scan.usdc")
    found = against_its_own(tmp_path / "scan.usdc", rebuilt / "head.usdc", tmp_path)
    assert found["with"].poses.mean() < found["with"].rest + 0.01
    assert found["without"].poses.mean() > 2 * found["with"].poses.mean()


@pytest.mark.slow
def test_sliders_of_a_person_keep_the_rig(rebuilt: Path, tmp_path: Path) -> None:
    """Joints and shapes of a payload come with `sliders --person`, and from the face that it was made."""
    for person in ("me.fpb", "points.usdc"):
        out = tmp_path / f"by_{Path(person).stem}.usdc"
        facepipe.sliders(rebuilt / "head.usdc", out=out, person=rebuilt / person)
        found = set_face(facepipe.open(out).parts()).parts
        own = facepipe.open(rebuilt / "points.usdc").parts()
        turns, expected = (np.asarray(one.skeleton.bind_transforms)[:, :3, :3] for one in (found, own))
        np.testing.assert_allclose(turns, expected, atol=1e-3)
        jaw, expected = (evaluated(one, {"jawOpen": 1.0}) - evaluated(one, {}) for one in (found, own))
        assert np.linalg.norm(jaw - expected, axis=1).mean() < 0.02
