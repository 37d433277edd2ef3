"""The key light of a photo on the stage: kept by all files, absent where there is none, refused where it is wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from faces import tiny_face
from full_faces import full_photo
from parts_differences import assert_same
from pxr import Gf, Usd

import facepipe
from facepipe.checks import validate
from facepipe.core import tokens
from facepipe.core.errors import FacepipeError, InputError, SchemaError
from facepipe.parts import FaceParts, KeyLamp
from facepipe.stage import save_parts
from facepipe.stage.author_changes import author_changes

NAN, INFINITY = float("nan"), float("inf")
NAMES = (tokens.PHOTO_KEY_COLOR, tokens.PHOTO_KEY_DIRECTION, tokens.PHOTO_KEY_EXPONENT, tokens.PHOTO_KEY_SHINE)
LAMP = KeyLamp(direction=(0.5, -0.25, 2.0), color=(0.75, 0.0, 0.5), shine=1.25, exponent=30.5)


def lit(key: KeyLamp | None) -> FaceParts:
    """A small face in a photo with that lamp."""
    return replace(tiny_face(), photos=(replace(full_photo(), key=key, animation=None, tint={}),))


def key_of(path: Path) -> KeyLamp | None:
    return facepipe.open(path).photos[0].key


def changed(source: Path, out: Path, key: KeyLamp | None) -> tuple[str, ...]:
    """The lines of an override layer with another lamp."""
    with facepipe.open(source).deriving(out) as face:
        parts = face.parts()
        return author_changes(face, replace(parts, photos=(replace(parts.photos[0], key=key),)))


def on_photo(path: Path, name: str, value: object) -> None:
    """Set an attribute in a file."""
    stage = Usd.Stage.Open(str(path))
    assert stage.GetPrimAtPath("/Tiny/Photos/portrait").GetAttribute(name).Set(value)
    stage.Save()


@pytest.mark.parametrize("key", [LAMP, KeyLamp(direction=(0, 0, 1), color=(1e-30, 0, 0)), None])
@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_files_keep_it(tmp_path: Path, suffix: str, key: KeyLamp | None) -> None:
    save_parts(lit(key), tmp_path / f"face{suffix}")
    found = key_of(tmp_path / f"face{suffix}")
    assert found is None if key is None else found is not None
    if key is not None:
        assert_same(replace(key, direction=tuple(map(float, key.direction))), found)
    assert validate(tmp_path / f"face{suffix}") == ()


def test_a_photo_without_it_authors_nothing_of_it(tmp_path: Path) -> None:
    """As files were that nobody wrote a lamp to."""
    save_parts(lit(None), tmp_path / "face.usda")
    assert not [name for name in NAMES if name in (tmp_path / "face.usda").read_text()]
    save_parts(lit(LAMP), tmp_path / "face.usda")
    assert all(name in (tmp_path / "face.usda").read_text() for name in NAMES)


@pytest.mark.parametrize("flatten", [False, True])
def test_it_comes_changes_and_goes_in_override_layers(tmp_path: Path, flatten: bool) -> None:
    save_parts(lit(None), tmp_path / "0.usda")
    for step, key in enumerate((LAMP, replace(LAMP, shine=0.0), None, LAMP)):
        source, out = (tmp_path / f"{number}.usda" for number in (step, step + 1))
        assert changed(source, out, key) == ("portrait: camera changed",)
        assert key_of(out) == key
        assert changed(out, tmp_path / "again.usda", key) == ()
        if flatten:
            facepipe.open(out).save(tmp_path / "flat.usdc")
            assert key_of(tmp_path / "flat.usdc") == key
        assert validate(out) == ()


def test_a_black_lamp_in_a_file_is_none(tmp_path: Path) -> None:
    save_parts(lit(LAMP), tmp_path / "face.usda")
    on_photo(tmp_path / "face.usda", tokens.PHOTO_KEY_COLOR, Gf.Vec3f(0))
    assert key_of(tmp_path / "face.usda") is None
    assert validate(tmp_path / "face.usda") == ()


WRONG: dict[str, tuple[dict[str, object], str]] = {
    "NaN of a direction": ({"direction": (0.0, NAN, 1.0)}, "NaN"),
    "NaN of a colour": ({"color": (NAN, 0.0, 0.0)}, "NaN"),
    "no direction": ({"direction": (0.0, 0.0, 0.0)}, "without direction"),
    "negative colour": ({"color": (0.5, -0.1, 0.5)}, "0.5, -0.1, 0.5"),
    "negative shine": ({"shine": -0.5}, "shine -0.5"),
    "infinite shine": ({"shine": INFINITY}, "infinity"),
    "no exponent": ({"exponent": 0.0}, "exponent 0"),
    "negative exponent": ({"exponent": -3.0}, "exponent -3"),
    "infinite exponent": ({"exponent": INFINITY}, "infinity"),
}
UNHOLDABLE: dict[str, tuple[dict[str, object], str]] = {
    **WRONG,
    "black": ({"color": (0.0, 0.0, 0.0)}, "some light"),
    "black in float32": ({"color": (1e-60, 0.0, 0.0)}, "some light"),
    "direction that is none in float32": ({"direction": (0.0, 1e-60, 0.0)}, "without direction"),
    "exponent beyond float32": ({"exponent": 1e60}, "beyond float32"),
    "exponent that is 0 in float32": ({"exponent": 1e-60}, "exponent"),
    "flat direction": ({"direction": (0.0, 1.0)}, "2 and 3 numbers"),
}


@pytest.mark.parametrize("name", UNHOLDABLE)
def test_what_a_stage_can_not_hold_is_not_written(tmp_path: Path, name: str) -> None:
    changes, message = UNHOLDABLE[name]
    wrong = replace(LAMP, **changes)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=message):
        save_parts(lit(wrong), tmp_path / "face.usda")
    assert not list(tmp_path.iterdir())
    save_parts(lit(LAMP), tmp_path / "face.usda")
    with pytest.raises(InputError, match=message):
        changed(tmp_path / "face.usda", tmp_path / "out.usda", wrong)


@pytest.mark.parametrize("name", WRONG)
def test_wrong_lamps_of_files_are_not_read(tmp_path: Path, name: str) -> None:
    ((field, value),), message = WRONG[name][0].items(), WRONG[name][1]
    save_parts(lit(LAMP), tmp_path / "face.usda")
    on_photo(tmp_path / "face.usda", f"facepipe:photo:key:{field}", value)
    with pytest.raises(SchemaError, match="/Tiny/Photos/portrait: key light"):
        facepipe.open(tmp_path / "face.usda").parts()
    found = {one.check for one in validate(tmp_path / "face.usda")}
    assert found == ({"facepipe:Finite"} if message in ("NaN", "infinity") else {"facepipe:PhotoKeyLight"})


def test_texts_for_numbers_are_refused(tmp_path: Path) -> None:
    save_parts(lit(LAMP), tmp_path / "face.usda")
    text = (tmp_path / "face.usda").read_text()
    typed = "uniform float facepipe:photo:key:shine = 1.25"
    assert typed in text
    (tmp_path / "face.usda").write_text(text.replace(typed, 'uniform string facepipe:photo:key:shine = "bright"'))
    with pytest.raises(FacepipeError, match="/Tiny/Photos/portrait"):
        facepipe.open(tmp_path / "face.usda").parts()
    assert validate(tmp_path / "face.usda")
