"""Persons as payloads: how near a few hundred bytes come, whose face gets them, and what is refused."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Capsys, done, failed, run
from faces import tiny_face

import facepipe
from facepipe.core.errors import InputError
from facepipe.heads import make
from facepipe.heads.assembly import with_parts_fitted
from facepipe.heads.asset import asset
from facepipe.parts import FaceParts
from facepipe.payload.coefficients import read_header
from facepipe.payload.person import BASIS, JOINTS, MODES, POINTS, PersonContent, decode_person, encode_person
from facepipe.payload.sections import MOST_SECTIONS, Section, pack, unpack
from facepipe.payload.small_numbers import decode_numbers, encode_numbers
from facepipe.rig import build, coefficient_matrices
from facepipe.rig.conventions import ARKIT_SHAPES
from facepipe.stage import Face, save_parts
from facepipe.verbs.blend import BlendOptions, BlendSession, Weights
from facepipe.verbs.person_basis import Basis, head_basis
from facepipe.verbs.person_layers import encode_points
from facepipe.verbs.whole_faces import whole_points

_MOUTH = slice(11248, 13294)  # points of its inside


def distances(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(one - other, axis=1))


def skin(values: np.ndarray) -> np.ndarray:
    """Those of the skin, of values of all points."""
    return np.delete(values[: asset().parts["Head"].points.stop], np.arange(_MOUTH.start, _MOUTH.stop), axis=0)


def fitted(seed: int) -> np.ndarray:
    """(n, 3) millimetres of a person as photo fits make them: modes, with eyes and mouth fitted to the skin."""
    weights = np.random.default_rng(seed).normal(0, 0.8, len(asset().modes))
    return 10 * with_parts_fitted(asset().points + np.tensordot(weights, asset().modes, axes=1))


@cache
def drawn(seed: int) -> FaceParts:
    return make(seed)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_photos_person_is_271_bytes(seed: int) -> None:
    points = fitted(seed)
    data, layers = encode_points(head_basis(), points, within=5.0)
    off = distances(layers[-1].points, points)
    assert len(data) == 271
    assert skin(off).mean() < 0.03
    assert skin(off).max() < 1.0
    balls = np.concatenate([off[asset().parts[name].points] for name in ("EyeballLeft", "EyeballRight")])
    assert balls.max() < 0.12
    np.testing.assert_array_equal(head_basis().rebuilt(decode_person(data, "person"), "person"), layers[-1].points)


def test_so_is_a_drawn_one() -> None:
    """On average to 0.03 mm of the skin, whose lids and lips are fitted to the person."""
    means, balls = [], []
    for seed in range(10, 16):
        points = whole_points(make(seed))
        data, layers = encode_points(head_basis(), points, within=50.0)
        off = distances(layers[-1].points, points)
        assert len(data) == 271
        means.append(skin(off).mean())
        balls.append(off[asset().parts["EyeballLeft"].points].max())
    assert np.mean(means) < 0.03
    assert max(balls) < 0.12


@pytest.mark.parametrize("within", [0.15, 0.5])
def test_points_come_as_near_as_they_are_asked_to(within: float) -> None:
    points = whole_points(drawn(3))
    warped = points + 3 * np.sin(points / 15)[:, [1, 2, 0]]  # beyond any mode, and whole parts with it
    data, layers = encode_points(head_basis(), warped, within=within)
    off = distances(head_basis().rebuilt(decode_person(data, "person"), "person"), warped)
    balls = np.zeros(len(off), bool)
    for name in ("EyeballLeft", "EyeballRight"):
        balls[asset().parts[name].points] = True  # which stay balls
    assert 0.8 * within < off[~balls].max() <= within
    assert [layer.name for layer in layers if layer.name != "joints"] == ["modes", "parts", "points"]


def beyond_modes(seed: int) -> np.ndarray:
    """(n, 3) millimetres of a drawn person under a smooth random field of 3 mm."""
    points, random = whole_points(drawn(seed)), np.random.default_rng(seed)
    centres = points[random.choice(asset().parts["Head"].points.stop, 100)]
    field = np.exp(-((points[:, None] - centres) ** 2).sum(axis=2) / (2 * 30.0**2)) @ random.standard_normal((100, 3))
    return np.asarray(points + 3.0 * field / np.sqrt((skin(field) ** 2).sum(axis=1).mean()))


def without_joints() -> Basis:
    return replace(head_basis(), content=replace(head_basis().content, identity_joints=None))


def test_joints_carry_what_modes_leave() -> None:
    """A warp that no joint was learnt on: in 830 bytes to a third of what modes leave, and nearer than with points."""
    points = beyond_modes(3)
    data, layers = encode_points(head_basis(), points, most=830)
    assert len(data) <= 830
    left = {layer.name: skin(distances(layer.points, points)).mean() for layer in layers}
    assert left["joints"] < 0.35 * left["parts"]
    alone, _ = encode_points(without_joints(), points, most=830)
    other = without_joints().rebuilt(decode_person(alone, "person"), "person")
    assert left["joints"] < skin(distances(other, points)).mean()


def test_whose_head_is_turned_has_the_same_joints() -> None:
    points, turn = beyond_modes(3), np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    data, _ = encode_points(head_basis(), points @ turn.T + [4, 5, 6], most=900)
    got = head_basis().rebuilt(decode_person(data, "person"), "person")
    assert decode_person(data, "person").joints.any()
    assert skin(distances((got - [4, 5, 6]) @ turn, points)).mean() < 0.3


def test_joints_move_points_as_bones_do() -> None:
    """Point by point, as the docs have it: weights times matrices of coefficients about the joints' places."""
    basis, random = head_basis(), np.random.default_rng(0)
    assert basis.joints is not None
    steps, step = random.integers(-60, 60, (100, 9)), 0.1
    told = PersonContent(basis=basis.digest, modes=np.zeros(0, np.float16), joints=steps, step=step)
    read = decode_person(encode_person(told), "person")
    moved = basis.rebuilt(read, "person") - basis.mean
    held, size = basis.joints, float(np.float16(step))
    for point in random.integers(0, asset().parts["Head"].points.stop, 50).tolist():
        offset = np.zeros(3)
        for joint, weight in zip(held.indices[point], held.weights[point], strict=True):
            t, r, s = (steps[joint] * size).reshape(3, 3)
            matrix = coefficient_matrices(np.concatenate([t, r / 16, 1 + s / 16]))
            arm = basis.mean[point] - held.places[joint]
            offset += weight * ((matrix @ [*arm, 1])[:3] - arm)
        np.testing.assert_allclose(moved[point], offset, atol=1e-9)
    assert not moved[asset().parts["Head"].points.stop :].any()


def test_small_numbers_come_back() -> None:
    for seed in range(20):
        random = np.random.default_rng(seed)
        numbers = np.rint(random.laplace(0, random.choice([0.3, 2.0, 40.0]), (random.integers(1, 255), 9)))
        numbers = np.clip(numbers, -127, 127).astype(np.int64)
        np.testing.assert_array_equal(decode_numbers(encode_numbers(numbers), len(numbers), 9, "x"), numbers)


def test_a_head_that_stands_elsewhere_takes_a_placement_not_points() -> None:
    points, turn = fitted(4), np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    moved = 1.1 * points @ turn.T + [40, -300, 7]
    data, layers = encode_points(head_basis(), moved, within=5.0)
    assert [layer.name for layer in layers] == ["placement", "modes", "parts"]
    off = distances(layers[-1].points, moved)
    assert len(data) < 330
    assert skin(off).mean() < 0.04


@pytest.mark.parametrize("axis", [(0, 1, 0), (0.6, 0.8, 0), (0.577, 0.577, 0.578)])
def test_a_head_that_looks_away_is_half_a_turn(axis: tuple[float, float, float]) -> None:
    points, way = fitted(4), np.array(axis) / np.linalg.norm(axis)
    turned = points @ (2 * np.outer(way, way) - np.eye(3)).T
    data, _ = encode_points(head_basis(), turned, within=5.0)
    off = distances(head_basis().rebuilt(decode_person(data, "person"), "person"), turned)
    assert skin(off).mean() < 0.04


@pytest.mark.parametrize("most", [330, 830, 1300, 4000])
def test_bytes_are_kept_to_and_used(most: int) -> None:
    points = whole_points(drawn(3))
    warped = points + 2 * np.sin(points / 25)[:, [1, 2, 0]]
    data, layers = encode_points(head_basis(), warped, most=most)
    assert 0.9 * most < len(data) <= most or (most == 330 and len(data) <= most)
    means = [distances(layer.points, warped).mean() for layer in layers]
    assert means == sorted(means, reverse=True)


@pytest.mark.slow
def test_no_point_of_a_blend_is_far_at_10_000_bytes() -> None:
    """One whose sizes near the best step are all a few bytes above what there is room for."""
    random = np.random.default_rng(1005)
    seeds = random.choice(np.arange(1000, 10_000), 2, replace=False).tolist()
    names = ("cheek", "chin", "ears", "eyebrows", "eyes", "forehead", "mouth", "neck", "nose")
    shares = {name: float(random.choice([0.0, 1.0, random.uniform()])) for name in names}
    weights = Weights(regions={name: (1.0 - share, share) for name, share in shares.items()}, default=(1.0, 0.0))
    session = BlendSession([Face.from_parts(make(seed)) for seed in seeds], BlendOptions(), live=False)
    points = 10 * session.neutral(weights).points
    data, _ = encode_points(head_basis(), points, most=10_000)
    off = distances(head_basis().rebuilt(decode_person(data, "person"), "person"), points)
    assert len(data) <= 10_000
    assert skin(off).max() < 0.3


def test_a_rebuilt_person_is_the_person(tmp_path: Path, capsys: Capsys) -> None:
    """From the command line, over the average head: neutral, all shapes and poses, to 0.1 mm on average."""
    save_parts(drawn(2), tmp_path / "anna.usdc")
    save_parts(make(0), tmp_path / "head.usdc")
    told = json.loads(done(capsys, "person", tmp_path / "anna.usdc", "-o", tmp_path / "anna.fpb", "--json"))
    assert told["bytes"] == (tmp_path / "anna.fpb").stat().st_size < 600
    assert told["max_mm"] <= 1.0
    words = (tmp_path / "head.usdc", tmp_path / "anna.fpb")
    assert "a person on the built-in head" in done(capsys, "apply-bones", *words, "-o", tmp_path / "again.usdc")
    anna, again = (facepipe.open(tmp_path / name).parts() for name in ("anna.usdc", "again.usdc"))
    assert again.recipe is not None
    assert again.recipe.verb == "apply-bones"
    first, second = build(anna), build(again)
    known = slice(0, asset().parts["Head"].points.stop)

    def apart(weights: Mapping[str, float], coefficients: np.ndarray | None = None) -> float:
        one, other = (rig.evaluate(weights, coefficients=coefficients)[known] for rig in (first, second))
        return float(10 * distances(one, other).mean())

    assert apart({}) < 0.1
    assert max(apart({name: 1.0}) for name in ARKIT_SHAPES) < 0.1
    limits, rng = again.bone_limits, np.random.default_rng(0)
    assert limits is not None
    rest = np.array([0.0] * 6 + [1.0] * 3)
    for _ in range(10):
        share = 0.3 * rng.random(limits.lower.shape)
        within = rest + share * (np.where(rng.random(share.shape) < 0.5, limits.lower, limits.upper) - rest)
        assert apart({}, within) < 0.1
    done(capsys, "apply-bones", *words, "-o", tmp_path / "again.npz")
    points = np.load(tmp_path / "again.npz")["points"]
    np.testing.assert_allclose(points, np.concatenate([mesh.points for mesh in again.meshes]), atol=1e-4)


def test_who_the_face_was_before_does_not_matter(tmp_path: Path, capsys: Capsys) -> None:
    """Sliders and hair of the face that a payload comes to: the person is the payload's alone."""
    save_parts(make(5), tmp_path / "five.usdc")
    done(capsys, "sliders", tmp_path / "five.usdc", "--set", "noseWidth=1", "-o", tmp_path / "set.usdc")
    save_parts(make(0), tmp_path / "head.usdc")
    data, _ = encode_points(head_basis(), fitted(1), within=1.0)
    (tmp_path / "one.fpb").write_bytes(data)
    found = []
    for name in ("set", "head"):
        out = tmp_path / f"{name}_one.usdc"
        done(capsys, "apply-bones", tmp_path / f"{name}.usdc", tmp_path / "one.fpb", "-o", out)
        face = facepipe.open(out)
        assert all(slider.value is None for slider in face.sliders)
        found.append(face.evaluate()[: len(asset().points)])
    np.testing.assert_allclose(found[0], found[1], atol=2e-5)


def test_any_topology_has_points_against_the_template(tmp_path: Path, capsys: Capsys) -> None:
    face = tiny_face()
    save_parts(face, tmp_path / "template.usdc")
    other = replace(
        face, meshes=tuple(replace(mesh, points=mesh.points * [1.1, 0.95, 1.2] + 0.003) for mesh in face.meshes)
    )
    save_parts(other, tmp_path / "other.usdc")
    line = failed(capsys, "person", tmp_path / "other.usdc", "-o", tmp_path / "no.fpb", folder=tmp_path)
    assert "not the built-in head, expected --database" in line
    words = ("--template", tmp_path / "template.usdc", "--within", "0.05")
    done(capsys, "person", tmp_path / "other.usdc", "-o", tmp_path / "other.fpb", *words)
    words = (tmp_path / "template.usdc", tmp_path / "other.fpb")
    done(capsys, "apply-bones", *words, "-o", tmp_path / "again.usdc")
    again = facepipe.open(tmp_path / "again.usdc").parts()
    assert distances(whole_points(again), whole_points(other)).max() <= 0.05
    line = failed(capsys, "apply-bones", tmp_path / "other.usdc", words[1], "-o", tmp_path / "no.usdc", folder=tmp_path)
    assert "a person on another basis" in line


def test_a_studios_faces_are_a_basis(tmp_path: Path, capsys: Capsys) -> None:
    """A database of bare heads: a face made of its own modes needs no points."""
    rng, paths = np.random.default_rng(0), []
    face = tiny_face()
    for number in range(5):
        stretch = rng.normal(1, 0.05, 3)
        moved = tuple(replace(mesh, points=mesh.points * stretch) for mesh in face.meshes)
        paths.append(tmp_path / f"face{number}.usdc")
        save_parts(replace(face, meshes=moved), paths[-1])
    done(capsys, "database", "create", *paths[:4], "-o", tmp_path / "studio.fpdb", quiet=False)
    words = ("--database", tmp_path / "studio.fpdb")
    told = json.loads(done(capsys, "person", paths[4], "-o", tmp_path / "five.fpb", *words, "--json"))
    assert (told["basis"], told["max_mm"] <= 1.0) == ("studio.fpdb", True)
    done(capsys, "apply-bones", paths[0], tmp_path / "five.fpb", *words, "-o", tmp_path / "again.usdc")
    again = facepipe.open(tmp_path / "again.usdc").parts()
    off = distances(whole_points(again), whole_points(facepipe.open(paths[4]).parts()))
    assert off.max() == pytest.approx(told["max_mm"], abs=1e-3)


def content(**changes: Any) -> bytes:
    basis = head_basis()
    usual = PersonContent(basis=basis.digest, modes=np.full(100, 0.5, np.float16), parts=np.zeros((3, 7), np.float16))
    return encode_person(replace(usual, **changes))


def test_sections_that_are_not_known(tmp_path: Path, capsys: Capsys) -> None:
    save_parts(make(0), tmp_path / "head.usdc")
    sections = unpack(content(), "person")
    words = ("apply-bones", tmp_path / "head.usdc", tmp_path / "one.fpb", "-o", tmp_path / "out.usdc")
    (tmp_path / "one.fpb").write_bytes(pack([*sections, Section(99, b"look", required=True)]))
    assert "section of kind 99, which this version" in failed(capsys, *words, folder=tmp_path)
    (tmp_path / "one.fpb").write_bytes(pack([*sections, Section(99, b"look", required=False)]))
    code, out, err = run(capsys, *words)
    assert code == 1
    assert "left out: section of kind 99, not known" in err
    assert (tmp_path / "out.usdc").exists()
    code, out, _ = run(capsys, *words[:3], "--info", "--json")
    assert (code, json.loads(out)["left_out"], json.loads(out)["fits"]) == (1, [99], True)
    failed(capsys, *words[:3], "-o", tmp_path / "no.usdc", "--clamp", folder=tmp_path)


def test_readers_of_coefficients_refuse_persons_in_one_line() -> None:
    with pytest.raises(InputError, match=r"^person: version 2, expected 1$"):
        read_header(content(), "person")


def joints(step: float, count: int, last: int = 1, *, cut: int | None = None) -> Section:
    """A section of as many joints, each of whose channels goes one step, and the last one's some."""
    numbers = np.ones((count, 9), np.int64)
    numbers[-1:] = last
    if cut is not None:
        numbers = np.random.default_rng(0).integers(-99, 99, numbers.shape)
    return Section(JOINTS, (struct.pack("<eB", step, count) + encode_numbers(numbers))[:cut])


def mended(body: bytes) -> bytes:
    """With the CRC that it should have."""
    return body + struct.pack("<I", zlib.crc32(body))


_SIZE = 8  # of the header


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "no person, expected a file that begins with FPBC"),
        (content()[:-5], "its CRC differs"),
        (mended(content()[:6] + b"\1\0" + content()[8:-4]), "flags 0x0001, expected none"),
        (mended(content()[:-4] + b"\xff"), "a length without end"),
        (mended(content()[:-4] + b"\xff\xff\xff\xff\xff\xff\x01"), "a length without end"),
        (mended(content()[:-4] + b"\xff\x80\x00"), "needless bytes"),
        (mended(content()[:-4] + b"\xff\x7f"), "127 bytes, expected at most the 0 that follow"),
        (pack([Section(kind, b"") for kind in range(1, MOST_SECTIONS + 2)]), "more than 64 sections"),
        (mended(content()[:_SIZE] + b"\x82\0\x81\0"), "kind 1, expected each once, ascending"),
        (mended(content()[:_SIZE] + b"\x81\0" * 1_000_000), "kind 1, expected each once, ascending"),
        (mended(content()[:_SIZE] + b"\x80\0"), "kind 0, expected each once"),
        (pack([Section(MODES, b"ab")]), "names no basis"),
        (pack([Section(BASIS, b"ab")]), "2 bytes, expected 8"),
        (pack([Section(BASIS, bytes(8)), Section(MODES, b"abc")]), "3 bytes, expected 1 to 4096 times 2"),
        (pack([Section(BASIS, bytes(8)), Section(MODES, b"\0\x7e")]), "mode 0: nan, expected at most 100"),
        (pack([Section(BASIS, bytes(8)), Section(MODES, b"\0\x7b")]), "mode 0: 57344, expected at most 100"),
        (pack([Section(BASIS, bytes(8)), Section(3, struct.pack("<7f", 0, 0, 0, 0.9, 0.9, 0, 0))]), "placement 0"),
        (pack([Section(BASIS, bytes(8)), Section(3, struct.pack("<7f", 0, 0, 0, 0, 0, 0, 9))]), "placement 0"),
        (pack([Section(BASIS, bytes(8)), Section(4, bytes(8)), Section(5, bytes(14))]), "with turns and without"),
        (pack([Section(BASIS, bytes(8))]), "another basis (0000000000000000)"),
        (content(modes=np.zeros(111, np.float16)), "111 modes, expected at most the 110"),
        (content(parts=np.zeros((2, 7), np.float16)), "2 parts, expected the 3 of its basis or none"),
        (content(points=b"abc"), "-> points: 3 bytes, expected at least 5"),
        (pack([Section(BASIS, bytes(8)), Section(JOINTS, b"ab")]), "-> joints: 2 bytes, expected at least 3"),
        (pack([Section(BASIS, bytes(8)), joints(0.5, 0)]), "-> joints: no joints"),
        (pack([Section(BASIS, bytes(8)), joints(np.nan, 2)]), "-> joints: steps of nan mm"),
        (pack([Section(BASIS, bytes(8)), joints(np.inf, 2)]), "-> joints: steps of inf mm"),
        (pack([Section(BASIS, bytes(8)), joints(-0.5, 2)]), "-> joints: steps of -0.5 mm"),
        (pack([Section(BASIS, bytes(8)), joints(0.0, 2)]), "-> joints: steps of 0 mm"),
        (
            pack([Section(BASIS, bytes(8)), joints(0.5, 2, 128)]),
            "-> joint 1: 128 steps, expected at most 127",
        ),
        (pack([Section(BASIS, bytes(8)), joints(0.5, 200, 9, cut=40)]), "-> joints: ends in the middle"),
        (content(joints=np.ones((101, 9), np.int64), step=0.5), "101 joints, expected at most the 100 of its basis"),
    ],
)
def test_what_is_wrong_is_said(data: bytes, message: str) -> None:
    with pytest.raises(InputError) as caught:
        head_basis().rebuilt(decode_person(data, "person"), "person")
    assert message in str(caught.value)
    assert str(caught.value).startswith("person")


def test_no_flip_and_no_cut_gives_another_person() -> None:
    data, _ = encode_points(head_basis(), whole_points(drawn(3)), within=0.5)
    rng = np.random.default_rng(0)
    for place in range(0, 8 * len(data), 7):
        broken = bytearray(data)
        broken[place // 8] ^= 1 << place % 8
        with pytest.raises(InputError):
            decode_person(bytes(broken), "person")
    for end in rng.integers(0, len(data), 200):
        with pytest.raises(InputError):
            decode_person(data[:end], "person")


@pytest.mark.parametrize("kind", [POINTS, JOINTS])
def test_bytes_under_a_sound_crc_are_refused_or_make_a_face_in_bounds(kind: int) -> None:
    points = whole_points(drawn(3)) if kind == POINTS else beyond_modes(3)
    data, _ = encode_points(head_basis(), points, **({"within": 0.5} if kind == POINTS else {"most": 900}))
    assert kind in {section.kind for section in unpack(data, "person")}
    rng, made = np.random.default_rng(1), 0
    for _ in range(400):
        body = bytearray(data[:-4])
        for place in rng.integers(18, len(body), rng.integers(1, 5)):
            body[place] = rng.integers(0, 256)
        try:
            points = head_basis().rebuilt(decode_person(mended(bytes(body)), "person"), "person")
        except InputError:
            continue
        made += 1
        assert np.isfinite(points).all()
        assert np.abs(points).max() < 1e6
    assert made > 20, "that all were refused says nothing of what is made of them"


def test_a_face_that_is_one_point_has_finite_modes() -> None:
    basis = head_basis()
    for place in (0.0, 1000.0):
        weights, placement = basis.mode_fit.placed(np.full(basis.mean.shape, place))
        assert np.isfinite(weights).all()
        assert placement is None or np.isfinite(placement).all()
