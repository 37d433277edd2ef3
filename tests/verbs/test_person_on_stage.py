"""A person on the stage: sliders that are somebody, and a section in place of points, for every reader."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import head_scripts  # noqa: F401  (finds the modules of samples/head/)
import measures
import numpy as np
import pytest
from command_line import Capsys, done, exit_code, failed

import facepipe
from facepipe.core import tokens
from facepipe.core.arrays import FloatArray
from facepipe.core.errors import FacepipeError
from facepipe.heads import make
from facepipe.heads.assembly import MODE, mode_sliders, values_of
from facepipe.heads.asset import arrays, asset
from facepipe.heads.people import draw
from facepipe.parts import FaceParts, PersonBasis
from facepipe.rig import set_face
from facepipe.stage import Face, save_parts
from facepipe.verbs.person_basis import head_basis
from facepipe.verbs.person_layers import encode_points
from facepipe.verbs.whole_faces import whole_points


@cache
def person(seed: int) -> FaceParts:
    return make(seed)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """head.usdc, the average, and anna.fpb, who is drawn; she as section.usdc and as points.usdc."""
    place = tmp_path_factory.mktemp("person")
    save_parts(person(0), place / "head.usdc")
    (place / "anna.fpb").write_bytes(encode_points(head_basis(), whole_points(person(3)), within=50.0)[0])
    words = ("apply-bones", place / "head.usdc", place / "anna.fpb", "-o")
    assert exit_code(*words, place / "section.usdc", "--section") == exit_code(*words, place / "points.usdc") == 0
    return place


@pytest.fixture
def here(folder: Path, tmp_path: Path) -> Path:
    shutil.copytree(folder, tmp_path / "faces")
    return tmp_path / "faces"


def measured(moved: FloatArray) -> FloatArray:
    """(d,) measures of offsets (n, 3) in cm, of the mean of both sides, in standard deviations."""
    from scipy.spatial import cKDTree

    points, count = asset().points, measures.SKIN
    left = measures.functionals(measures.spots(points, asset().landmarks))
    other = cKDTree(points[:count]).query(points[:count] * (-1, 1, 1))[1]
    both = (left + left[:, other] * (-1.0, 1.0, 1.0)) / 2
    found = np.einsum("dnc,nc->d", both, moved[:count], optimize=True)
    return np.asarray(found / arrays("measures")["deviations"])


def with_values(parts: FaceParts, values: dict[str, float]) -> FaceParts:
    return replace(parts, sliders=tuple(replace(one, value=values.get(one.name)) for one in parts.sliders))


def of(basis: PersonBasis | None) -> PersonBasis:
    assert basis is not None
    return basis


def skin_off(parts: FaceParts, other: FaceParts) -> FloatArray:
    rows = head_basis().fitted
    return np.asarray(np.linalg.norm((whole_points(parts) - whole_points(other))[rows], axis=1))


def test_the_sliders_of_the_head_are_of_its_basis() -> None:
    assert person(0).person_basis is not None
    assert len({slider.name for slider in person(0).sliders}) == len(person(0).sliders)


@pytest.mark.parametrize("step", [31, pytest.param(1, marks=pytest.mark.slow)])
def test_identity_sliders_move_no_measure(step: int) -> None:
    """A standard deviation of a mode, or a named slider at 1, moves measures by 0.02 standard deviations at most."""
    face = Face.from_parts(person(0))
    still = face.evaluate()
    for slider in mode_sliders()[::step]:
        moved = face.evaluate(sliders={slider.name: 1.0}) - still
        assert np.linalg.norm(moved, axis=1).max() > 0.01
        assert np.abs(measured(moved)).max() <= 0.02, slider.name


@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(4, 14))])
def test_sliders_alone_are_a_drawn_person(seed: int) -> None:
    values = values_of(draw(seed).identity)
    ranges = {slider.name: slider.maximum for slider in person(0).sliders}
    assert np.mean([abs(value) >= ranges[name] for name, value in values.items()]) <= 0.02
    found = set_face(with_values(person(0), values))
    assert skin_off(found.parts, person(seed)).mean() <= 0.1
    own = (whole_points(person(seed)) - whole_points(person(0))) / 10
    names = arrays("measures")["names"].tolist()
    shown = np.array([2 * values.get(name, 0.0) for name in names])
    assert np.abs(measured(own) - shown).mean() < 0.15  # but for what fits of lids and lips change


def test_editing_a_person_moves_the_measure_alone() -> None:
    values = values_of(draw(3).identity)
    row = arrays("measures")["names"].tolist().index("noseWidth")
    face = Face.from_parts(person(0))
    before = face.evaluate(sliders=values)
    after = face.evaluate(sliders={**values, "noseWidth": values["noseWidth"] + 1.0})
    moved = measured(after - before)
    assert moved[row] == pytest.approx(2.0, abs=0.1)
    assert np.abs(np.delete(moved, row)).max() < 0.25


def test_no_identity_is_set_at_rest_and_set_faces_rest_at_their_values() -> None:
    parts = with_values(person(0), values_of(draw(3).identity))
    assert set_face(parts, "rest").parts is parts
    found = set_face(parts).parts
    assert [one.modes for one in found.sliders] == [one.modes for one in parts.sliders]
    assert set_face(found).parts is found  # adds nothing twice
    np.testing.assert_allclose(whole_points(found), 10 * Face.from_parts(parts).evaluate(pose="set"), atol=1e-4)


def test_the_persons_own_values_are_set(here: Path, capsys: Capsys) -> None:
    """Payload and face alike, and with the section nothing else is left."""
    out = done(capsys, "sliders", here / "head.usdc", "--person", here / "anna.fpb", "-o", here / "anna.usdc")
    assert "sliders off their defaults leave 0.0" in out
    assert (here / "anna.usdc").stat().st_size < 15_000
    one, other = (facepipe.open(here / name) for name in ("anna.usdc", "points.usdc"))
    off = 10 * np.linalg.norm(one.evaluate(pose="set") - other.evaluate(pose="set"), axis=1)
    assert off.max() <= 0.31
    assert off[head_basis().fitted].mean() < 0.02
    assert 10 * np.abs(one.evaluate(pose="rest") - other.evaluate(pose="rest")).max() > 1.0
    done(capsys, "sliders", here / "head.usdc", "--person", here / "points.usdc", "-o", here / "again.usdc")
    again = facepipe.open(here / "again.usdc")
    assert 10 * np.abs(again.evaluate(pose="set") - one.evaluate(pose="set")).max() <= 0.31


def test_a_face_without_such_sliders_is_refused(here: Path, capsys: Capsys) -> None:
    save_parts(make(0, controls="bones"), here / "bones.usdc")
    words = ("sliders", here / "bones.usdc", "--person", here / "anna.fpb", "-o", here / "out.usdc")
    assert "no sliders over modes of the built-in head" in failed(capsys, *words, folder=here)


def test_a_section_is_the_rewritten_neutral(here: Path, capsys: Capsys) -> None:
    paths = here / "section.usdc", here / "points.usdc"
    assert paths[0].stat().st_size < 2_000 < 100_000 < paths[1].stat().st_size
    one, other = map(facepipe.open, paths)
    for name in ("jawOpen", "eyeBlinkLeft", "mouthSmileLeft"):
        for pose in ("rest", "set"):
            off = one.evaluate({name: 1.0}, pose=pose) - other.evaluate({name: 1.0}, pose=pose)
            assert 10 * np.abs(off).max() < 1e-3
    for pose in ("rest", "set", "set-joints", "smile"):
        first, second = (set_face(face.parts(), pose).parts for face in (one, other))
        assert np.abs(whole_points(first) - whole_points(second)).max() < 1e-3
        for name in ("bind_transforms", "rest_transforms"):
            apart = np.abs(getattr(first.skeleton, name) - getattr(second.skeleton, name))
            assert apart.max() < 1e-4


@pytest.mark.slow
@pytest.mark.gate
def test_readers_take_both_alike(here: Path, capsys: Capsys) -> None:
    """Slider, export, blend, further fit, person: as from points."""
    section, points = here / "section.usdc", here / "points.usdc"
    found = []
    for path in (section, points):
        slid = path.with_name(f"{path.stem}_slid.usdc")
        done(capsys, "sliders", path, "--set", "noseWidth=0.8", "--set", "identity002=1", "-o", slid)
        done(capsys, "export", slid, "-o", slid.with_suffix(".glb"))
        mixed = path.with_name(f"{path.stem}_mixed.usdc")
        done(capsys, "blend", slid, here / "head.usdc", "-o", mixed, "--default", "0.5,0.5")
        done(capsys, "person", slid, "-o", slid.with_suffix(".fpb"), "--within", "50")
        faces = [facepipe.read(slid.with_suffix(".glb")).evaluate(), facepipe.open(mixed).evaluate(pose="set")]
        found.append([*faces, facepipe.open(slid).evaluate(pose="set")])
        found[-1].append(np.frombuffer(slid.with_suffix(".fpb").read_bytes(), np.uint8).astype(float)[:12])
    for scale, one, other in zip((1000.0, 10.0, 10.0, 1.0), *found, strict=True):
        assert scale * np.abs(one - other).max() < 2e-3


@pytest.mark.slow
def test_lower_levels_are_the_person(here: Path, capsys: Capsys) -> None:
    from scipy.spatial import cKDTree

    done(capsys, "sliders", here / "head.usdc", "--person", here / "anna.fpb", "-o", here / "anna.usdc")
    done(capsys, "lod", here / "anna.usdc", "--triangles", "8000", "-o", here / "levels.usdc", quiet=False)
    face = facepipe.open(here / "levels.usdc")
    points, still = (10 * one.evaluate(pose="set") for one in (face, facepipe.open(here / "head.usdc")))
    for level in face.lower_levels():
        own = whole_points(set_face(level).parts)
        to_person, to_head = (cKDTree(one).query(own)[0].mean() for one in (points, still))
        assert to_person < 0.5 * to_head


def test_what_changes_points_puts_the_person_into_them(here: Path, capsys: Capsys) -> None:
    section, points = here / "section.usdc", here / "points.usdc"
    assert of(facepipe.open(section).person_basis).section
    moved = here / "moved.usda"
    with facepipe.open(section).deriving(moved) as face:
        from facepipe.stage.author_changes import author_changes

        parts = face.parts()
        head = replace(parts.meshes[0], points=np.asarray(parts.meshes[0].points) + 0.1)
        author_changes(face, replace(parts, meshes=(head, *parts.meshes[1:])))
    found = facepipe.open(moved)
    assert found.person_basis is not None
    assert not found.person_basis.section
    expected = whole_points(facepipe.open(points).parts())
    expected[: len(head.points)] += 1.0
    np.testing.assert_allclose(whole_points(found.parts()), expected, atol=1e-3)
    (here / "bea.fpb").write_bytes(encode_points(head_basis(), whole_points(person(5)), within=50.0)[0])
    done(capsys, "apply-bones", here / "head.usdc", here / "bea.fpb", "-o", points, "--force")
    done(capsys, "apply-bones", section, here / "bea.fpb", "-o", here / "again.usda")
    again = facepipe.open(here / "again.usda")
    assert again.person_basis is not None
    assert not again.person_basis.section
    assert np.abs(whole_points(again.parts()) - whole_points(facepipe.open(points).parts())).max() < 1e-3


def test_cooking_makes_the_section_anew(here: Path, capsys: Capsys) -> None:
    """The digest of the payload is in the recipe: another payload is a change."""
    section = here / "section.usdc"
    before = facepipe.open(section).evaluate()
    (here / "anna.fpb").write_bytes(encode_points(head_basis(), whole_points(person(5)), within=50.0)[0])
    done(capsys, "cook", section, quiet=False)
    assert 10 * np.abs(facepipe.open(section).evaluate() - before).max() > 1.0


def _edited(here: Path, change: Callable[[bytes], bytes], digest: str | None = None) -> Path:
    section = here / "section.usdc"
    from pxr import Usd, Vt

    stage = Usd.Stage.Open(str(section))
    prim = stage.GetDefaultPrim()
    data = change(bytes(prim.GetAttribute(tokens.PERSON_SECTION).Get()))
    prim.GetAttribute(tokens.PERSON_SECTION).Set(Vt.UCharArray(list(data)))
    if digest is not None:
        prim.GetAttribute(tokens.PERSON_DIGEST).Set(digest)
    stage.GetRootLayer().Save()
    return section


@pytest.mark.parametrize(
    ("change", "digest", "line"),
    [
        (lambda data: data[:-9] + b"\0" + data[-8:], None, "is damaged: its CRC differs"),
        (lambda data: data[:3], None, "no person, expected a file that begins with FPBC"),
        (lambda data: data, "00" * 8, "expected " + head_basis().digest.hex()),
        (lambda data: bytes(1 << 20) + data, None, "bytes, expected at most 1,048,576"),
    ],
    ids=["a bit", "cut", "another digest", "too long"],
)
def test_a_damaged_section_is_one_line(
    here: Path, capsys: Capsys, change: Callable[[bytes], bytes], digest: str | None, line: str
) -> None:
    section = _edited(here, change, digest)
    for words in (("export", section, "-o", here / "out.glb"), ("inspect", section)):
        found = failed(capsys, *words, folder=here)
        assert line in found
        assert "section.usdc -> " in found
        assert "facepipe:person:" in found


def test_a_section_on_another_head_is_refused(here: Path) -> None:
    from faces import tiny_face

    basis = replace(of(person(0).person_basis), section=(here / "anna.fpb").read_bytes())
    face = Face.from_parts(replace(tiny_face(), person_basis=basis))
    with pytest.raises(FacepipeError, match="a person relative to the built-in head, expected its meshes"):
        face.parts()


def test_sliders_of_an_unknown_basis_are_one_line(here: Path) -> None:
    parts = with_values(person(0), {f"{MODE}001": 1.0})
    for basis in (None, replace(of(parts.person_basis), digest="0123")):
        with pytest.raises(
            FacepipeError, match=r"facepipe:person:digest: .*, expected [0-9a-f]{16} of the built-in head"
        ):
            set_face(replace(parts, person_basis=basis))
