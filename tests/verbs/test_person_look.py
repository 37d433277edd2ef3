"""What goes with a person's shape in a payload: how the head looks, small pictures, and bones on top."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import Capsys, done, failed, run
from faces import tiny_face
from payloads import tiny_payload
from PIL import Image

import facepipe
from facepipe.core.errors import InputError
from facepipe.heads import make
from facepipe.heads.look_code import decode_look, encode_look
from facepipe.heads.people import Look, draw
from facepipe.heads.surfaces import cards
from facepipe.parts import FaceParts, TextureInput
from facepipe.payload.person import PICTURES, PersonContent, decode_person, encode_person
from facepipe.payload.sections import Section, pack
from facepipe.stage import save_parts
from facepipe.verbs.person_basis import head_basis

_SHARES = ("redness", "lips", "age", "feminine", "freckles", "beard", "brows", "grey")


@pytest.mark.parametrize("seed", range(1, 12))
def test_a_look_comes_back_from_23_bytes(seed: int) -> None:
    look = draw(seed).look
    data = encode_look(look)
    back, missing = decode_look(data, "look")
    assert (len(data), missing) == (23, ())
    assert replace(back, tone=0.0, **dict.fromkeys(_SHARES, 0.0)) == replace(
        look, tone=0.0, **dict.fromkeys(_SHARES, 0.0)
    )
    assert abs(back.tone - look.tone) < 0.02
    assert all(abs(getattr(back, name) - getattr(look, name)) < 0.004 for name in _SHARES)


def test_a_style_that_a_head_does_not_have_is_said() -> None:
    data = bytearray(encode_look(Look(style="bun")))
    data[-4:-2] = b"\xff\xff"
    back, missing = decode_look(bytes(data), "look")
    assert (missing, back.style) == (("style",), Look().style)
    for wrong in (b"", bytes(22), bytes(24)):
        with pytest.raises(InputError, match=r"^look: .* bytes, expected 23$"):
            decode_look(wrong, "look")


@pytest.fixture(scope="module")
def head(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("head") / "head.usdc"
    save_parts(make(0, textures=64), path)
    return path


def beardless() -> int:
    """A seed of somebody with hair of another style than the standard head, and no beard of cards."""
    return next(
        seed
        for seed in range(1, 40)
        if (look := draw(seed).look).whiskers == "stubble" and look.style in ("long", "bob", "bun", "ponytail")
    )


def pixels(parts: FaceParts, material: str) -> np.ndarray:
    color = next(one for one in parts.materials if one.name == material).diffuse_color
    assert isinstance(color, TextureInput)
    return np.asarray(Image.open(io.BytesIO(color.texture.image())).convert("RGB"), float)


def test_a_person_with_looks_takes_300_bytes_and_looks_alike(head: Path, tmp_path: Path, capsys: Capsys) -> None:
    own = make(beardless(), textures=64)
    save_parts(own, tmp_path / "own.usdc")
    out = done(capsys, "person", tmp_path / "own.usdc", "-o", tmp_path / "me.fpb", "--look", "--within", "5")
    assert (tmp_path / "me.fpb").stat().st_size <= 300, out
    done(capsys, "apply-bones", head, tmp_path / "me.fpb", "-o", tmp_path / "me.usdc")
    me, before = facepipe.open(tmp_path / "me.usdc").parts(), facepipe.open(head).parts()
    for material in ("M_Face", "M_BackHead", "M_IrisLeft"):
        assert np.abs(pixels(me, material) - pixels(own, material)).mean() < 1.0, material
        assert np.abs(pixels(before, material) - pixels(own, material)).mean() > 1.5, "or it says nothing"
    hair = next(mesh for mesh in me.meshes if mesh.name == "Hair")
    held = cards(draw(beardless()).look.style)
    assert len(hair.points) == len(held.uv)
    assert np.abs(held.carry(np.asarray(me.meshes[0].points)) + held.offsets - hair.points).max() < 1e-3
    colors = [next(one for one in face.materials if one.name == "Hair").diffuse_color for face in (me, own)]
    assert np.allclose(*(one.scale for one in colors if isinstance(one, TextureInput)), atol=0.01)


def test_pictures_travel_as_webp(head: Path, tmp_path: Path, capsys: Capsys) -> None:
    own = make(beardless(), textures=256)
    save_parts(own, tmp_path / "own.usdc")
    done(capsys, "person", tmp_path / "own.usdc", "-o", tmp_path / "me.fpb", "--textures", "128", "--within", "5")
    content = decode_person((tmp_path / "me.fpb").read_bytes(), "me")
    assert [name for name, _ in content.pictures] == ["M_Face", "M_BackHead"]
    assert all(data[:4] == b"RIFF" and len(data) < 15_000 for _, data in content.pictures)
    done(capsys, "apply-bones", head, tmp_path / "me.fpb", "-o", tmp_path / "me.usdc")
    shown = pixels(facepipe.open(tmp_path / "me.usdc").parts(), "M_Face")
    assert shown.shape == (128, 128, 3)
    small = np.asarray(Image.fromarray(pixels(own, "M_Face").astype(np.uint8)).resize((128, 128)), float)
    assert np.abs(shown - small).mean() < 4.0


def test_what_is_no_picture_or_has_no_place_is_refused_or_said(head: Path, tmp_path: Path, capsys: Capsys) -> None:
    def applied(*pictures: tuple[str, bytes]) -> tuple[object, ...]:
        person = PersonContent(basis=head_basis().digest, modes=np.zeros(1), pictures=pictures)
        (tmp_path / "me.fpb").write_bytes(encode_person(person))
        return ("apply-bones", head, tmp_path / "me.fpb", "-o", tmp_path / "me.usdc")

    image = io.BytesIO()
    Image.new("RGB", (8, 8)).save(image, "WEBP")
    assert "M_Face" in failed(capsys, *applied(("M_Face", b"RIFFnothing")), folder=tmp_path)
    assert "left out: a picture of Coat" in run(capsys, *applied(("Coat", image.getvalue())))[2]
    for rows in (b"\x01", b"\x03abc\xff\xff\xff\x7f", b"\x01\xff\x00\x00\x00\x00", 2 * b"\x01a\x00\x00\x00\x00"):
        with pytest.raises(InputError, match=r"^me -> pictures: "):
            decode_person(pack([Section(1, head_basis().digest), Section(PICTURES, rows, required=False)]), "me")


def test_bones_lie_on_top_of_the_person(tmp_path: Path, capsys: Capsys) -> None:
    face = tiny_face()
    moved = replace(face, meshes=tuple(replace(one, points=1.1 * np.asarray(one.points)) for one in face.meshes))
    save_parts(face, tmp_path / "face.usda"), save_parts(moved, tmp_path / "moved.usda")
    tiny_payload(tmp_path / "pose.fpb")
    person = ("person", tmp_path / "moved.usda", "--template", tmp_path / "face.usda", "--within", "0.01")
    done(capsys, *person, "-o", tmp_path / "both.fpb", "--coefficients", tmp_path / "pose.fpb")
    done(capsys, *person, "-o", tmp_path / "shape.fpb")
    done(capsys, "apply-bones", tmp_path / "face.usda", tmp_path / "shape.fpb", "-o", tmp_path / "shape.usda")
    for target, source, out in (("face", "both", "both"), ("shape", "pose", "two")):
        files = (tmp_path / f"{target}.usda", tmp_path / f"{source}.fpb", "-o", tmp_path / f"{out}.usda")
        run(capsys, "apply-bones", *files)
    both, two = (facepipe.open(tmp_path / f"{name}.usda").evaluate(pose="set") for name in ("both", "two"))
    assert np.abs(both - facepipe.open(tmp_path / "shape.usda").evaluate(pose="set")).max() > 0.01
    np.testing.assert_allclose(both, two, atol=1e-6)
    done(capsys, *person, "-o", tmp_path / "small.fpb")
    other = failed(capsys, *person, "-o", tmp_path / "x.fpb", "--coefficients", tmp_path / "small.fpb", folder=tmp_path)
    assert "small.fpb" in other
