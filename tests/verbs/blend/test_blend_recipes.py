"""Recipes of blends: read back as written, edited, moved, damaged."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Capsys, done, failed, run
from hypothesis import given
from hypothesis import strategies as st
from import_data import refused
from layers import with_options
from small_sources import WORDS, made, points

import facepipe
from facepipe.core.errors import InputError
from facepipe.declare import from_json, to_json
from facepipe.parts import Recipe
from facepipe.performing import read_kept, recipe_to
from facepipe.stage import save_parts
from facepipe.verbs.blend import Blend, BlendFaces, BlendOptions, BlendSession, Weights
from facepipe.verbs.blend.weights import weights_from_json, weights_to_json

# --- recipes


def test_a_recipe_reads_back_as_it_was_written(folder: Path) -> None:
    weights = Weights(regions={"mouth": (0.1, 0.2), "neck": (1, 0)}, gains=(1, 1 / 3), locked={"neck": 2})
    options = BlendOptions(missing="transfer", region_width_mm=2.5, keep_shape="Teeth", anchor="Head:1", solver="splu")
    sources = (Path("a.usda"), Path("sub") / ".." / "b.usda")
    recipe = recipe_to(BlendFaces(sources=sources, weights=weights, **dataclasses.asdict(options)), Path("sub/c.usda"))
    assert recipe.sources == ("../a.usda", "../b.usda")
    (folder / "sub").mkdir()
    save_parts(dataclasses.replace(made(0), recipe=recipe), Path("sub") / "c.usda")
    again = read_kept("sub/c.usda", BlendFaces)
    assert again.values["sources"] == (folder.resolve() / "a.usda", folder.resolve() / "b.usda")
    assert again.values["weights"] == weights
    assert dataclasses.asdict(options).items() <= again.values.items()
    assert again.warnings == ()


@pytest.mark.parametrize(("align", "kept"), [("landmarks", "landmarks"), ("none", None)])
def test_recipes_without_alignment_are_of_before_there_was_one(folder: Path, align: str, kept: str | None) -> None:
    action = BlendFaces(sources=(Path("a.usda"), Path("b.usda")), weights=Weights(), align=align)
    recipe = recipe_to(action, Path("c.usda"))
    assert recipe.options.get("align") == kept
    save_parts(dataclasses.replace(made(0), recipe=recipe), Path("c.usda"))
    assert read_kept("c.usda", BlendFaces).values["align"] == align


@pytest.mark.parametrize(("contacts", "kept"), [(True, True), (False, None)])
def test_recipes_without_contacts_are_of_before_they_were_held(folder: Path, contacts: bool, kept: bool | None) -> None:
    action = BlendFaces(sources=(Path("a.usda"), Path("b.usda")), weights=Weights(), contacts=contacts)
    recipe = recipe_to(action, Path("c.usda"))
    assert recipe.options.get("contacts") == kept
    save_parts(dataclasses.replace(made(0), recipe=recipe), Path("c.usda"))
    assert read_kept("c.usda", BlendFaces).values["contacts"] == contacts


def test_a_blend_has_the_recipe_given_or_none(folder: Path, capsys: Capsys) -> None:
    """Never that of its base, which says how another face was made."""
    old = Recipe(verb="sample", sources=("seed",), digests=("sha256:0",), options={"seed": 3}, version="0.1.0")
    save_parts(dataclasses.replace(made(0), recipe=old), Path("a.usda"))
    sources = [facepipe.open("a.usda"), facepipe.open("b.usda")]
    weights = Weights(regions={"mouth": (0.75, 0.25)}, default=(0.5, 0.5))
    with sources[0].deriving("bare.usda") as face:
        Blend(weights=weights)(face, sources)
    assert facepipe.open("bare.usda").parts().recipe is None
    assert "has no recipe" in failed(capsys, "blend", "--edit", "bare.usda", "-o", "d.usda")
    session = BlendSession(sources, BlendOptions(edges="cotangent"))
    with sources[0].deriving("c.usda") as face:
        action = BlendFaces(sources=(Path("a.usda"), Path("b.usda")), weights=weights, edges="cotangent")
        recipe = recipe_to(action, "c.usda")
        Blend(weights=weights)(face, session, recipe=recipe)
    done(capsys, "blend", "--edit", "c.usda", "-o", "again.usda")
    assert Path("again.usda").read_bytes() == Path("c.usda").read_bytes()


@pytest.mark.parametrize("wrong", [{"weights": {"mouth": (1, 0)}}, {"options": {"edges": "cotangent"}}])
def test_settings_of_another_type_are_refused(wrong: Any) -> None:
    with pytest.raises(InputError, match=r"Blend -> \w+: dict, expected \w+\(\.\.\.\)"):
        Blend(**wrong)


def test_digests_cover_the_layers_of_a_source(folder: Path, capsys: Capsys) -> None:
    done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    done(capsys, "blend", "c.usda", "other.usda", "-o", "d.usda")
    recipe = facepipe.open("d.usda").parts().recipe
    assert recipe is not None
    assert recipe.sources == ("./c.usda", "./other.usda")
    sums = {name: hashlib.sha256(Path(name).read_bytes()).hexdigest() for name in ("a.usda", "c.usda", "other.usda")}
    layers = f"{sums['a.usda']}  a.usda\n{sums['c.usda']}  c.usda\n"
    listing = "".join(sorted(layers.splitlines(keepends=True), key=lambda line: line.split()[1]))
    assert recipe.digests == (
        f"sha256:{hashlib.sha256(listing.encode()).hexdigest()}",
        f"sha256:{sums['other.usda']}",
    )


def test_a_source_that_changed_is_a_warning(folder: Path, capsys: Capsys) -> None:
    done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    shutil.copy("other.usda", "b.usda")
    code, out, err = run(capsys, "blend", "--edit", "c.usda", "-o", "d.usda", "--json")
    assert (code, err) == (0, "facepipe: warning: b.usda changed since c.usda was made\n")
    assert json.loads(out)["warnings"] == ["b.usda changed since c.usda was made"]
    done(capsys, "blend", "a.usda", "b.usda", "-o", "e.usda", *WORDS)
    assert Path("d.usda").read_bytes() == Path("e.usda").read_bytes()


HOSTILE = [
    (lambda text: re.sub(r".*facepipe:recipe:verb.*\n", "", text), "has no recipe"),
    (lambda text: text.replace('verb = "blend"', 'verb = "sample"'), "a recipe of 'sample'"),
    (lambda text: text.replace('recipe:version = "', 'recipe:version = "9'), "made by facepipe 9"),
    (lambda text: text.replace('recipe:version = "', 'recipe:version = "x'), "version 'x"),
    (lambda text: text.replace('["./a.usda", "./b.usda"]', "[]"), "0 sources and 2 digests"),
    (lambda text: text.replace('["./a.usda", "./b.usda"]', '["./a.usda", ""]'), "source 2"),
    (lambda text: text.replace("./b.usda", "/dev/zero"), "/dev/zero is outside the roots"),
    (lambda text: text.replace("./b.usda", f"{'b' * 300}.usda"), "no such file"),
    (lambda text: text.replace("./b.usda", "./a.usda"), "a source twice"),
    (
        lambda text: text.replace('sources = ["./a.usda", "./b', 'sources = ["./a.usda", "./c'),
        "expected one of the sources",
    ),
    (lambda text: text.replace('["./a.usda", "./b.usda"]', "3"), "c.usda"),
    (with_options(lambda options: "nothing"), "no JSON"),
    (with_options(lambda options: "[" * 100_000), "no JSON"),
    (with_options(lambda options: "[1]"), "options are damaged"),
    (with_options(lambda options: options.pop("sources") and 0), "no 'sources', expected one"),
    (with_options(lambda options: options.update(weights=3)), "weights: 3, expected an object"),
    (with_options(lambda options: options["weights"].update(regions={"mouth": "ab"})), "mouth: 'ab', expected a list"),
    (with_options(lambda options: options["weights"].update(regions={"mouth": [1]})), "1 weights, expected 2"),
    (with_options(lambda options: options["weights"].update(regions={"nose": [1, 1]})), "no such region"),
    (
        with_options(lambda options: options["weights"].update(default=[True, 1])),
        "default -> 0: True, expected a finite number",
    ),
    (with_options(lambda options: options["weights"].update(gains=[10**400, 1])), "gains -> 0: 1000"),
    (
        with_options(lambda options: options["weights"].update(default=[float("nan"), 1])),
        "default -> 0: nan, expected a finite number",
    ),
    (with_options(lambda options: options["weights"].update(locked={"mouth": 7})), "from 1 to 2"),
    (
        with_options(lambda options: options["weights"].update(locked={"mouth": 1.5})),
        "mouth: 1.5, expected a whole number",
    ),
    (with_options(lambda options: options.update(edges="both")), "uniform, cotangent"),
    (with_options(lambda options: options.update(static_mm=-1)), "number from 0 to 100"),
    (with_options(lambda options: options.update(static_mm="1")), "a finite number"),
    (with_options(lambda options: options.update(anchor=[])), "a text or null"),
    (with_options(lambda options: options.update(speed=1)), "option 'speed' is unknown"),
]


@pytest.mark.parametrize(("change", "message"), HOSTILE)
def test_damaged_recipes_are_one_line(folder: Path, capsys: Capsys, change: Any, message: str) -> None:
    done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    text = Path("c.usda").read_text()
    damaged = change(text)
    assert damaged != text
    Path("c.usda").write_text(damaged)
    for words in (("-o", "d.usda"), ("--force",)):
        assert message in failed(capsys, "blend", "--edit", "c.usda", *words)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)
KEYS = ("regions", "default", "gains", "locked", *(field.name for field in dataclasses.fields(BlendOptions)))


@given(st.dictionaries(st.sampled_from(KEYS) | st.text(max_size=8), JSON, max_size=5) | JSON)
def test_any_json_is_settings_or_refused_in_one_line(value: object) -> None:
    for read in (lambda: weights_from_json(value, "w"), lambda: from_json(BlendOptions, value, "w")):
        refused(read, Path("w"))


ROWS = st.lists(st.floats(0, 1e30), min_size=3, max_size=3).map(tuple)
NAMES = st.text(min_size=1, max_size=8).filter(lambda name: name not in KEYS)


@given(
    st.dictionaries(NAMES, ROWS),
    st.none() | ROWS,
    st.none() | ROWS,
    st.dictionaries(NAMES, st.integers(1, 9)),
    st.data(),
)
def test_settings_survive_json(regions: Any, default: Any, gains: Any, locked: Any, data: st.DataObject) -> None:
    weights = Weights(regions=regions, default=default, gains=gains, locked=locked)
    assert weights_from_json(json.loads(json.dumps(weights_to_json(weights))), "w") == weights
    options = BlendOptions(
        static_mm=data.draw(st.floats(0, 100)),
        anchor=data.draw(st.none() | st.text()),
        edges=data.draw(st.sampled_from(("uniform", "cotangent"))),
    )
    assert from_json(BlendOptions, json.loads(json.dumps(to_json(options))), "w") == options


# --- editing

CHANGE = ("--set", "mouth=0.6,0.4")
CHANGED = (*CHANGE, "--default", "0.5,0.5")


@pytest.mark.parametrize(
    ("before", "edit", "fresh"),
    [
        (WORDS, CHANGE, CHANGED),
        (WORDS, ("--default", "1,0", "--gains", "1,0.5"), (*WORDS[:2], "--default", "1,0", "--gains", "1,0.5")),
        (WORDS, ("--lock", "mouth=2"), (*WORDS, "--lock", "mouth=2")),
        ((*WORDS, "--lock", "mouth=2"), (*CHANGE, "--unlock", "mouth"), CHANGED),
        ((*WORDS, "--lock", "mouth=2"), ("--unlock", "mouth"), WORDS),
        ((*WORDS, "--lock", "mouth=2"), ("--lock", "mouth=1"), (*WORDS, "--lock", "mouth=1")),
        (("--edges", "cotangent"), ("--static-mm", "0.02"), ("--edges", "cotangent", "--static-mm", "0.02")),
        (("--edges", "cotangent"), ("--edges", "uniform"), ()),
        (WORDS, (), WORDS),
    ],
)
def test_an_edit_is_a_fresh_blend_to_the_byte(
    folder: Path, capsys: Capsys, before: tuple[str, ...], edit: tuple[str, ...], fresh: tuple[str, ...]
) -> None:
    done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *before)
    first = Path("c.usda").read_bytes()
    done(capsys, "blend", "a.usda", "b.usda", "-o", "fresh.usda", *fresh)
    done(capsys, "blend", "--edit", "c.usda", *edit, "-o", "d.usda")
    assert Path("c.usda").read_bytes() == first
    done(capsys, "blend", "--edit", "c.usda", *edit, "--force")
    for name in ("c.usda", "d.usda"):
        assert Path(name).read_bytes() == Path("fresh.usda").read_bytes()


@pytest.mark.parametrize(("number", "sources"), [(2, ("a.usda", "other.usda")), (1, ("other.usda", "b.usda"))])
def test_a_replaced_source_is_a_fresh_blend(
    folder: Path, capsys: Capsys, number: int, sources: tuple[str, str]
) -> None:
    done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    done(capsys, "blend", "--edit", "c.usda", "--replace", f"{number}=other.usda", "--force")
    done(capsys, "blend", *sources, "-o", "fresh.usda", *WORDS)
    assert Path("c.usda").read_bytes() == Path("fresh.usda").read_bytes()


def test_a_folder_that_moved_is_edited_as_before(folder: Path, capsys: Capsys, monkeypatch: Any) -> None:
    (folder / "one" / "out").mkdir(parents=True)
    for name in ("a.usda", "b.usda"):
        shutil.move(name, Path("one") / name)
    done(capsys, "blend", "one/a.usda", "one/b.usda", "-o", "one/out/c.usda", *WORDS)
    done(
        capsys,
        "blend",
        "one/a.usda",
        "one/b.usda",
        "-o",
        "one/out/fresh.usda",
        "--set",
        "mouth=0,1",
        "--default",
        "0.5,0.5",
    )
    shutil.move("one", "two")
    monkeypatch.chdir(folder / "two" / "out")
    done(capsys, "blend", "--edit", "c.usda", "--set", "mouth=0,1", "--force")
    assert Path("c.usda").read_bytes() == Path("fresh.usda").read_bytes()
    assert str(folder) not in Path("c.usda").read_text()


@pytest.mark.parametrize(("number", "name"), [(1, "a.usda"), (2, "b.usda")])
def test_a_source_that_went_is_named_and_can_be_replaced(folder: Path, capsys: Capsys, number: int, name: str) -> None:
    done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    shutil.move(name, "moved.usda")
    error = failed(capsys, "blend", "--edit", "c.usda", "-o", "d.usda")
    assert f"recipe -> source {number}: " in error
    assert f"{name}: no such file" in error
    done(capsys, "blend", "--edit", "c.usda", "--replace", f"{number}=moved.usda", "-o", "d.usda")
    shutil.copy("moved.usda", name)
    np.testing.assert_array_equal(points("d.usda"), points("c.usda"))


def test_mistakes_in_editing(folder: Path, capsys: Capsys) -> None:
    done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *WORDS, "--lock", "neck=2")
    cases = [
        (("--edit", "c.usda"), "expected --force (or -o OUT)"),
        (("--edit", "c.usda", "a.usda", "-o", "d.usda"), "given with --edit"),
        (("--edit", "c.usda", "-o", "other.usda"), "exists, expected a new file (or --force)"),
        (("--edit", "c.usda", "-o", "c.usda", "--force"), "c.usda: is an input"),
        (("--edit", "c.usda", "-o", "b.usda", "--force"), "b.usda: is an input"),
        (
            ("--edit", "c.usda", "--set", "neck=1,0", "-o", "d.usda"),
            "locked to source 2, expected no weights",
        ),
        (("--edit", "c.usda", "--unlock", "mouth", "-o", "d.usda"), "--unlock mouth: is not locked"),
        (("--edit", "c.usda", "--lock", "mouth=3", "-o", "d.usda"), "source 3, expected a number from 1 to 2"),
        (("--edit", "c.usda", "--replace", "3=other.usda", "-o", "d.usda"), "no such source, expected a number from 1"),
        (("--edit", "c.usda", "--replace", "other.usda", "-o", "d.usda"), "expected N=FILE"),
        (("--edit", "c.usda", *("--replace", "2=other.usda") * 2, "-o", "d.usda"), "--replace 2=...: given twice"),
        (("--edit", "c.usda", "--replace", "2=gone.usda", "-o", "d.usda"), "gone.usda: no such file"),
        (("--edit", "c.usda", "--replace", "2=a.usda", "-o", "d.usda"), "a source twice"),
        (("--edit", "c.usda", "--replace", "2=c.usda", "--force"), "c.usda: is an input"),
        (("--edit", "a.usda", "-o", "d.usda"), "a.usda: has no recipe"),
        (("--edit", "gone.usda", "-o", "d.usda"), "gone.usda: no such file"),
        (("a.usda", "b.usda", "-o", "d.usda", "--replace", "2=other.usda"), "--replace: given without --edit"),
    ]
    for words, message in cases:
        assert message in failed(capsys, "blend", *words), words


def test_weights_of_a_file_respect_locks_too(folder: Path, capsys: Capsys) -> None:
    done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *WORDS, "--lock", "neck=2")
    Path("w.json").write_text('{"neck": [1, 0]}')
    assert "locked to source 2" in failed(capsys, "blend", "--edit", "c.usda", "--weights", "w.json", "--force")
    done(capsys, "blend", "--edit", "c.usda", "--weights", "w.json", "--unlock", "neck", "--force")
    regions = {"mouth": (0.75, 0.25), "neck": (1.0, 0.0)}
    assert read_kept("c.usda", BlendFaces).values["weights"] == Weights(regions=regions, default=(0.5, 0.5))


def test_layers_that_a_source_stands_on_are_not_overwritten(folder: Path, capsys: Capsys) -> None:
    done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    done(capsys, "blend", "c.usda", "b.usda", "-o", "d.usda")
    assert "needed by" in failed(capsys, "blend", "d.usda", "b.usda", "-o", "a.usda", "--force")
    assert "needed by" in failed(capsys, "blend", "--edit", "c.usda", "--replace", "2=d.usda", "--force")
