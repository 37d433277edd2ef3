"""Recipes of bone fits: read back as written, fitted again, moved, damaged."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bone_faces import pose, save_sources, saved, sculpt, small
from command_line import Capsys, content, done, exit_code, failed, run
from hypothesis import given
from hypothesis import strategies as st
from import_data import refused
from layers import with_options

import facepipe
from facepipe.declare import from_json, to_json
from facepipe.parts import Animation, FaceParts
from facepipe.payload import PayloadContent, encode
from facepipe.performing import perform, read_kept, recipe_to
from facepipe.rig import CHANNELS, build
from facepipe.stage import save_parts
from facepipe.stage.recipes import source_digest
from facepipe.verbs.fit_bones import (
    FitBones,
    FitBonesOptions,
    FitBonesToTargets,
    LimitRules,
    Target,
    read_limits,
    read_targets,
)
from facepipe.verbs.fit_bones.limits import limits_from_json

LOOSE = ("--threshold-mm", "5")
GOAL = ("--target", "goal.usda", *LOOSE)
RULES = LimitRules(
    joints=(("*", {"t": (-0.3, 0.1), "sz": (None, 1.5)}), ("jaw", {"rx": (None, None), "ty": (-1, None)})),
    lock=("root:*", "eye*:s"),
    units="cm",
)


def start(parts: FaceParts, seed: int) -> PayloadContent:
    """A pose as a payload."""
    coefficients = pose(build(parts), seed).astype(np.float32)
    return PayloadContent(
        joints=parts.skeleton.joints, coefficients=coefficients, meters_per_unit=parts.meters_per_unit
    )


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Rig, goals, a clip, limits, coefficients to start from."""
    folder, rig = save_sources(tmp_path_factory.mktemp("sources")), build(small())
    saved(sculpt(small(), rig.evaluate(coefficients=pose(rig, 2))), folder / "other.usda")
    frames = np.stack([pose(rig, 3, share) for share in (0.2, 0.4)])
    nod = Animation(name="nod", times=np.array([0.0, 0.1]), joints=rig.joints, coefficients=frames)
    saved(replace(small(), animations=(nod,)), folder / "clip.usda")
    (folder / "start.fpb").write_bytes(encode(start(small(), 4)).data)
    return folder


@pytest.fixture
def folder(sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with copies of those."""
    shutil.copytree(sources, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def same(one: str, other: str) -> bool:
    return Path(one).read_bytes() == Path(other).read_bytes()


# --- reading


def test_a_recipe_reads_back_as_it_was_written(folder: Path) -> None:
    Path("sub").mkdir()
    Path("facepipe.toml").touch()
    Path("limits.json").write_text(
        '{"joints": {"*": {"t": [-0.3, 0.1], "sz": [null, 1.5]}, "jaw": {"rx": [null, null], "ty": [-1, null]}}, '
        '"lock": ["root:*", "eye*:s"], "units": "cm"}'
    )
    words = ("goal.usda", "jawOpen=0.5", "sub/../clip.usda:nod", "talk", "goal.usda:Head")
    fit = FitBonesToTargets(
        rig=Path("rig.usda"),
        targets=words,
        initial="start.fpb",
        limits=read_limits(Path("limits.json")),
        regions={"neck": 0.1, "mouth": 2.0},
        mask=("mouth", "neck"),
        threshold_mm=1 / 3,
        max_iterations=7,
        rounds=3,
        regularise=1e-3,
        sparsity=0.25,
        symmetric=True,
        residual=True,
    )
    assert fit.limits == RULES
    recipe = recipe_to(fit, "sub/a.usda")
    assert recipe.sources == ("../rig.usda", "../goal.usda", "../clip.usda", "../start.fpb")
    assert recipe.digests == tuple(map(source_digest, map(Path, ("rig.usda", "goal.usda", "clip.usda", "start.fpb"))))
    save_parts(replace(small(), recipe=recipe), Path("sub/a.usda"))
    kept, home = read_kept("sub/a.usda", FitBonesToTargets), folder.resolve()
    again = FitBonesToTargets(**kept.values)
    files = (home / "goal.usda", f"{home / 'clip.usda'}:nod", f"{home / 'goal.usda'}:Head")
    targets = (str(files[0]), "jawOpen=0.5", files[1], "talk", files[2])
    assert again == replace(fit, rig=home / "rig.usda", targets=targets, initial=str(home / "start.fpb"))
    assert again.limits is not None
    assert [list(channels) for _, channels in again.limits.joints] == [["sz", "t"], ["rx", "ty"]]
    assert kept.warnings == ()
    assert kept.standalone
    assert recipe_to(again, "sub/a.usda") == recipe


def test_a_fit_from_the_recipe_in_python_has_the_same_bytes(folder: Path, capsys: Capsys) -> None:
    done(capsys, "fit-bones", "rig.usda", *GOAL, "--limits", "limits.json", "--initial", "start.fpb", "-o", "a.usda")
    kept = read_kept("a.usda", FitBonesToTargets)
    assert not kept.standalone
    perform(FitBonesToTargets(**kept.values), Path("b.usda"))
    assert same("a.usda", "b.usda")


def test_the_same_target_by_two_paths_is_refused(folder: Path, capsys: Capsys) -> None:
    Path("sub").mkdir()
    Path("facepipe.toml").touch()
    words = ("--target", "goal.usda", "--target", "sub/../goal.usda")
    assert "goal.usda: given twice" in failed(capsys, "fit-bones", "rig.usda", *words, "-o", "a.usda")


NUMBERS = st.none() | st.integers(-(10**9), 10**9) | st.floats(-1e9, 1e9)
PAIRS = st.tuples(NUMBERS, NUMBERS).filter(lambda pair: None in pair or pair[0] <= pair[1])  # type: ignore[operator]
CHANNEL = st.sampled_from([*CHANNELS, "t", "r", "s"])
PATTERN = st.text(min_size=1, max_size=8)


@given(
    st.lists(st.tuples(PATTERN, st.dictionaries(CHANNEL, PAIRS, max_size=4)), max_size=4),
    st.lists(st.builds("{}:{}".format, PATTERN, CHANNEL | st.just("*")), max_size=3),
    st.sampled_from(("stage", "mm", "cm", "m")),
)
def test_rules_of_limits_survive_json(joints: Any, lock: list[str], units: str) -> None:
    rules = LimitRules(joints=tuple(joints), lock=tuple(lock), units=units)
    again = limits_from_json(json.loads(json.dumps(rules.to_json())), "w")
    assert again == rules
    assert json.dumps(again.to_json()) == json.dumps(rules.to_json())


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)
RULES_LIKE = st.fixed_dictionaries(
    {
        "joints": st.lists(st.tuples(PATTERN, st.dictionaries(CHANNEL, JSON) | JSON).map(list)) | JSON,
        "lock": st.lists(PATTERN) | JSON,
        "units": st.just("mm") | JSON,
    }
)


@given(RULES_LIKE | JSON)
def test_any_json_is_limits_or_refused_in_one_line(value: object) -> None:
    refused(lambda: limits_from_json(value, "w"), Path("w"))


@given(st.floats(1e-6, 1e6), st.none() | st.integers(0, 1000), st.booleans())
def test_options_survive_json(threshold: float, rounds: int | None, residual: bool) -> None:
    options = FitBonesOptions(threshold_mm=threshold, rounds=rounds, residual=residual)
    assert from_json(FitBonesOptions, json.loads(json.dumps(to_json(options))), "w") == options


# --- editing

BEFORE: dict[str, tuple[str, ...]] = {
    "plain": GOAL,
    "limits": (*GOAL, "--limits", "limits.json"),
    "regions": (*GOAL, "--region", "mouth=2", "--region", "neck=0.5", "--mask", "mouth", "--mask", "neck"),
    "from an animation": (*GOAL, "--initial", "talk"),
    "from a payload": (*GOAL, "--initial", "start.fpb"),
    "residual": ("--target", "shapes", "--residual", "--max-iterations", "3"),
    "sparse": (*GOAL, "--sparsity", "0.1", "--regularise", "0.001", "--rounds", "1"),
    "flat": (*GOAL, "--flatten"),
    "targets": ("--target", "jawOpen=0.5", "--target", "clip.usda:nod", "--target", "other.usda", *LOOSE),
}


@pytest.mark.parametrize(
    ("kind", "suffix"), [*((kind, "usda") for kind in BEFORE), pytest.param("targets", "usdz", marks=pytest.mark.slow)]
)
def test_a_fit_again_has_the_same_bytes_once_and_twice(folder: Path, capsys: Capsys, kind: str, suffix: str) -> None:
    result = f"a.{suffix}"
    outcome = run(capsys, "fit-bones", "rig.usda", *BEFORE[kind], "-o", result)[0]
    first = Path(result).read_bytes()
    Path("limits.json").unlink()
    assert run(capsys, "fit-bones", "--edit", result, "-o", f"b.{suffix}")[0] == outcome < 2
    assert kind == "flat" or suffix == "usdz" or b"@./rig.usda@" in Path(f"b.{suffix}").read_bytes()
    for _ in range(2):
        assert run(capsys, "fit-bones", "--edit", result, "--force")[0] == outcome
        assert Path(result).read_bytes() == first
    if suffix == "usda":
        assert Path("b.usda").read_bytes() == first
    else:  # a package is named after its file
        np.testing.assert_array_equal(coefficients("b.usdz"), coefficients("a.usdz"))


def coefficients(path: str) -> np.ndarray:
    return np.concatenate(
        [animation.coefficients for animation in facepipe.open(path).animations if animation.coefficients is not None]
    )


LIMITED = (*GOAL, "--limits", "limits.json", "--mask", "mouth", "--region", "mouth=3", "--initial", "start.fpb")


@pytest.mark.parametrize(
    ("before", "edit", "fresh"),
    [
        (GOAL, ("--threshold-mm", "2"), ("--target", "goal.usda", "--threshold-mm", "2")),
        (GOAL, ("--target", "other.usda"), ("--target", "other.usda", *LOOSE)),
        (GOAL, ("clip.usda",), None),
        (GOAL, ("--limits", "limits.json"), (*GOAL, "--limits", "limits.json")),
        (GOAL, ("--residual",), (*GOAL, "--residual")),
        ((*GOAL, "--residual"), ("--no-residual",), GOAL),
        (LIMITED, ("--no-limits",), (*LIMITED[:4], *LIMITED[6:])),
        (LIMITED, ("--no-mask", "--mask", "neck"), (*LIMITED, "--no-mask", "--mask", "neck")),
        (LIMITED, ("--mask", "neck"), (*LIMITED, "--no-mask", "--mask", "neck")),
        (LIMITED, ("--no-mask",), (*LIMITED[:6], *LIMITED[8:])),
        (LIMITED, ("--no-initial",), LIMITED[:10]),
        (LIMITED, ("--initial", "talk"), (*LIMITED[:10], "--initial", "talk")),
        (LIMITED, ("--region", "neck=2"), (*LIMITED, "--region", "neck=2")),
        (LIMITED, ("--region", "mouth=2"), (*LIMITED[:8], "--region", "mouth=2", *LIMITED[10:])),
        (GOAL, ("--flatten",), (*GOAL, "--flatten")),
    ],
)
def test_an_edit_is_a_fresh_fit_to_the_byte(
    folder: Path, capsys: Capsys, before: Sequence[str], edit: Sequence[str], fresh: Sequence[str] | None
) -> None:
    run(capsys, "fit-bones", "rig.usda", *before, "-o", "a.usda")
    first = Path("a.usda").read_bytes()
    run(capsys, "fit-bones", *([edit[0], *GOAL] if fresh is None else ["rig.usda", *fresh]), "-o", "fresh.usda")
    run(capsys, "fit-bones", "--edit", "a.usda", *edit, "-o", "b.usda")
    assert Path("a.usda").read_bytes() == first
    run(capsys, "fit-bones", "--edit", "a.usda", *edit, "--force")
    assert first != Path("fresh.usda").read_bytes()
    assert same("a.usda", "fresh.usda")
    assert same("b.usda", "fresh.usda")


def test_a_folder_that_moved_is_fitted_as_before(folder: Path, capsys: Capsys, monkeypatch: Any) -> None:
    (folder / "one" / "out").mkdir(parents=True)
    (folder / "one/facepipe.toml").touch()
    for name in ("rig.usda", "goal.usda", "clip.usda", "start.fpb"):
        shutil.move(name, Path("one") / name)
    targets = ("--target", "one/goal.usda", "--target", "one/clip.usda:nod", *LOOSE)
    done(capsys, "fit-bones", "one/rig.usda", *targets, "--initial", "one/start.fpb", "-o", "one/out/a.usda")
    first = Path("one/out/a.usda").read_bytes()
    assert str(folder).encode() not in first
    shutil.move("one", "two")
    done(capsys, "fit-bones", "--edit", "two/out/a.usda", "--force")
    assert Path("two/out/a.usda").read_bytes() == first
    monkeypatch.chdir(folder / "two" / "out")
    done(capsys, "fit-bones", "--edit", "a.usda", "--force")
    assert Path("a.usda").read_bytes() == first


def changed_start() -> None:
    Path("start.fpb").write_bytes(encode(start(small(), 5)).data)


CHANGES: dict[str, Callable[[], object]] = {
    "rig.usda": lambda: saved(replace(small(), attribution="another"), Path("rig.usda")),
    "goal.usda": lambda: shutil.copy("other.usda", "goal.usda"),
    "start.fpb": changed_start,
}
REPLACED = {"rig.usda": ("clip.usda",), "goal.usda": ("--target", "other.usda"), "start.fpb": ("--no-initial",)}


@pytest.mark.parametrize("name", CHANGES)
def test_a_source_that_changed_is_a_warning(folder: Path, capsys: Capsys, name: str) -> None:
    done(capsys, "fit-bones", "rig.usda", *GOAL, "--initial", "start.fpb", "-o", "a.usda")
    CHANGES[name]()
    line = f"{name} changed since a.usda was made"
    code, out, err = run(capsys, "fit-bones", "--edit", "a.usda", "-o", "b.usda", "--json")
    assert (code, err, json.loads(out)["warnings"]) == (0, f"facepipe: warning: {line}\n", [line])
    done(capsys, "fit-bones", "rig.usda", *GOAL, "--initial", "start.fpb", "-o", "fresh.usda")
    assert same("b.usda", "fresh.usda")
    done(capsys, "fit-bones", "--edit", "a.usda", *REPLACED[name], "-o", "c.usda")
    assert read_kept("b.usda", FitBonesToTargets).warnings == ()


@pytest.mark.parametrize(("number", "name"), list(enumerate(CHANGES, 1)))
def test_a_source_that_went_is_named_and_can_be_replaced(folder: Path, capsys: Capsys, number: int, name: str) -> None:
    done(capsys, "fit-bones", "rig.usda", *GOAL, "--initial", "start.fpb", "-o", "a.usda")
    Path(name).unlink()
    error = failed(capsys, "fit-bones", "--edit", "a.usda", "-o", "b.usda")
    flag = ("RIG", "--target", "--initial")[number - 1]
    assert error.startswith(f"a.usda -> recipe -> source {number}: ")
    assert error.endswith(f"{name}: no such file, expected it there (or {flag})\n")
    done(capsys, "fit-bones", "--edit", "a.usda", *REPLACED[name], "-o", "b.usda")


def test_a_file_that_is_rig_and_target_is_needed_for_either(folder: Path, capsys: Capsys) -> None:
    done(capsys, "fit-bones", "clip.usda", "--target", "clip.usda:nod", *LOOSE, "-o", "a.usda")
    assert read_kept("a.usda", FitBonesToTargets).values["targets"] == (f"{folder.resolve() / 'clip.usda'}:nod",)
    Path("clip.usda").unlink()
    assert "source 1" in failed(capsys, "fit-bones", "--edit", "a.usda", "rig.usda", "-o", "b.usda")
    assert "source 1" in failed(capsys, "fit-bones", "--edit", "a.usda", "--target", "goal.usda", "-o", "b.usda")
    done(capsys, "fit-bones", "--edit", "a.usda", "rig.usda", "--target", "goal.usda", "-o", "b.usda")


def test_digests_cover_the_buffers_of_a_gltf(folder: Path) -> None:
    Path("my goal.bin").write_bytes(b"\0" * 8)
    uris = [{"uri": "my%20goal.bin"}, {"uri": "data:application/octet-stream;base64,AAAA"}, {}]
    Path("goal.gltf").write_text(json.dumps({"buffers": uris}))
    before = source_digest(Path("goal.gltf"))
    Path("my goal.bin").write_bytes(b"\1" * 8)
    assert source_digest(Path("goal.gltf")) != before
    Path("my goal.bin").write_bytes(b"\0" * 8)
    assert source_digest(Path("goal.gltf")) == before
    Path("goal.gltf").write_text("[]")
    alone = source_digest(Path("goal.gltf"))
    Path("my goal.bin").write_bytes(b"\1" * 8)
    assert source_digest(Path("goal.gltf")) == alone != before


# --- damaged recipes


WRONG: dict[str, Sequence[object]] = {
    "targets": (None, "goal.usda", [], [3], [""], ["none.usda"], ["./other.usda"]),
    "rig": (None, [], 3, "none.usda"),
    "threshold_mm": (None, [], "x", {}, "1", 0),
    "residual": (None, 1, "yes"),
    "limits": ([], {}, {"joints": {}, "lock": [], "units": "cm"}, {"joints": [], "lock": [], "units": [1]}),
    "regions": (None, [], "x", {"mouth": "1"}, {"mouth": -1}, {"mouth": True}, {"mouth": 10**400}, {"nose": 1}),
    "mask": (None, "mouth", {}, [1], [""], ["nose"]),
    "initial": (3, [], "", "frown", "./goal.fpb"),
}


@pytest.mark.parametrize("key", WRONG)
def test_options_that_are_damaged_are_one_line(folder: Path, capsys: Capsys, key: str) -> None:
    done(capsys, "fit-bones", "rig.usda", *GOAL, "--limits", "limits.json", "-o", "a.usda")
    text = Path("a.usda").read_text()
    changes = [with_options(lambda options, value=value: options.update({key: value})) for value in WRONG[key]]  # type: ignore[misc]
    for change in changes:
        assert change(text) != text
        Path("a.usda").write_text(change(text))
        for words in (("-o", "b.usda"), ("--force",)):
            failed(capsys, "fit-bones", "--edit", "a.usda", *words)


@pytest.mark.parametrize("key", ["joints", "lock", "units"])
@pytest.mark.parametrize("value", [None, 3, "x", [3], [[]], [["jaw"]], [["jaw", 3]], {"jaw": {}}])
def test_limits_that_are_damaged_are_refused(key: str, value: object) -> None:
    content = json.loads(json.dumps(RULES.to_json()))
    with pytest.raises(facepipe.core.errors.InputError, match=r"^w( -> |: )"):
        limits_from_json({**content, key: value}, "w")
    with pytest.raises(facepipe.core.errors.InputError, match=r"^w: "):
        limits_from_json({one: content[one] for one in content if one != key}, "w")


HOSTILE: list[tuple[Callable[[str], str], str]] = [
    (lambda text: re.sub(r".*facepipe:recipe:verb.*\n", "", text), "has no recipe"),
    (lambda text: text.replace('verb = "fit-bones"', 'verb = "blend"'), "a recipe of 'blend'"),
    (lambda text: text.replace('recipe:version = "', 'recipe:version = "9'), "made by facepipe 9"),
    (lambda text: text.replace('recipe:version = "', 'recipe:version = "x'), "version 'x"),
    (lambda text: text.replace('["./rig.usda", "./goal.usda"]', "[]"), "0 sources and 2 digests"),
    (lambda text: text.replace('["./rig.usda", "./goal.usda"]', '["./rig.usda", "b"]'), "one of the sources"),
    (lambda text: text.replace('./rig.usda"', '"'), "source 1"),
    (lambda text: text.replace('"./rig.usda"', '"/dev/zero"'), "/dev/zero is outside the roots"),
    (lambda text: text.replace('"./rig.usda"', f'"{"b" * 300}.usda"'), "no such file"),
    (lambda text: re.sub(r"(recipe:options = ').*'", r"\1nothing'", text), "no JSON"),
    (lambda text: re.sub(r"(recipe:options = ').*'", r"\1[1]'", text), "options are damaged"),
    (with_options(lambda options: options.update(more=1)), "option 'more' is unknown"),
]


@pytest.mark.parametrize(("change", "message"), HOSTILE)
def test_damaged_recipes_are_one_line(folder: Path, capsys: Capsys, change: Callable[[str], str], message: str) -> None:
    done(capsys, "fit-bones", "rig.usda", *GOAL, "-o", "a.usda")
    text = Path("a.usda").read_text()
    assert change(text) != text
    Path("a.usda").write_text(change(text))
    assert message in failed(capsys, "fit-bones", "--edit", "a.usda", "-o", "b.usda")


def test_mistakes_in_editing(folder: Path, capsys: Capsys) -> None:
    done(capsys, "fit-bones", "rig.usda", *GOAL, "-o", "a.usda")
    edit = ("--edit", "a.usda")
    cases: list[tuple[tuple[str, ...], str]] = [
        (edit, "a.usda: would be written again, expected --force (or -o OUT)"),
        ((*edit, "-o", "other.usda"), "other.usda: exists, expected a new file (or --force)"),
        ((*edit, "-o", "a.usda", "--force"), "a.usda: is an input"),
        ((*edit, "-o", "rig.usda", "--force"), "rig.usda: is an input"),
        ((*edit, "-o", "goal.usda", "--force"), "goal.usda: is an input"),
        ((*edit, "--target", "a.usda", "--force"), "a.usda: is an input"),
        ((*edit, "a.usda", "--force"), "a.usda: is an input"),
        ((*edit, "--force", "--limits", "rig.usda"), "rig.usda"),
        ((*edit, "--force", "--threshold-mm", "0"), "option threshold_mm"),
        ((*edit, "--force", "--region", "nose=1"), "region nose"),
        (("--edit", "rig.usda", "--force"), "rig.usda: has no recipe, expected a face made by `facepipe fit-bones`"),
        (("--edit", "gone.usda", "-o", "b.usda"), "gone.usda: no such file"),
    ]
    for words, message in cases:
        assert failed(capsys, "fit-bones", *words).startswith(message), words


# --- chains


def test_a_blend_is_a_rig(folder: Path, capsys: Capsys) -> None:
    """Its recipe gives way to that of the fit; the layers that it stands on count as the rig."""
    assert exit_code("blend", "rig.usda", "clip.usda", "-o", "mix.usda", "--default", "0.5,0.5") == 0
    capsys.readouterr()
    done(capsys, "fit-bones", "mix.usda", *GOAL, "-o", "a.usda")
    recipe = facepipe.open("a.usda").parts().recipe
    assert recipe is not None
    assert (recipe.verb, recipe.sources) == ("fit-bones", ("./mix.usda", "./goal.usda"))
    first = Path("a.usda").read_bytes()
    done(capsys, "fit-bones", "--edit", "a.usda", "--force")
    assert Path("a.usda").read_bytes() == first
    CHANGES["rig.usda"]()
    assert (
        run(capsys, "fit-bones", "--edit", "a.usda", "--force")[2]
        == "facepipe: warning: mix.usda changed since a.usda was made\n"
    )


def test_a_fit_is_a_rig(folder: Path, capsys: Capsys) -> None:
    done(capsys, "fit-bones", "rig.usda", *GOAL, "-o", "a.usda")
    done(capsys, "fit-bones", "a.usda", "--target", "other.usda", *LOOSE, "--initial", "goal", "-o", "b.usda")
    names = ["talk", "goal", "other"]
    assert [animation.name for animation in facepipe.open("b.usda").animations] == names
    before = content(folder)
    done(capsys, "fit-bones", "--edit", "b.usda", "--force")
    done(capsys, "fit-bones", "--edit", "a.usda", "--force")
    assert content(folder) == before
    done(capsys, "fit-bones", "--edit", "a.usda", "--target", "goal.usda", "--target", "jawOpen=0.1", "--force")
    code, _, err = run(capsys, "fit-bones", "--edit", "b.usda", "--force")
    assert (code, err) == (0, "facepipe: warning: a.usda changed since b.usda was made\n")
    assert [animation.name for animation in facepipe.open("b.usda").animations] == [*names[:2], "jawOpen_0_1", "other"]
    assert "is needed by" in failed(capsys, "fit-bones", "--edit", "a.usda", "b.usda", "--force")


def test_a_fit_that_is_stopped_leaves_what_was_there(folder: Path, capsys: Capsys) -> None:
    done(capsys, "fit-bones", "rig.usda", *GOAL, "-o", "a.usda")
    before = content(folder)
    face = facepipe.open("rig.usda")

    def stop() -> None:
        raise KeyboardInterrupt

    targets: tuple[Target, ...] = read_targets(face, ["goal.usda", "other.usda"])
    with pytest.raises(KeyboardInterrupt), face.deriving("a.usda") as result:
        FitBones()(result, targets, done=stop)
    assert content(folder) == before


def test_a_fit_to_another_face_makes_that_face_the_person(folder: Path, capsys: Capsys) -> None:
    done(capsys, "fit-bones", "rig.usda", *GOAL, "-o", "person.usda")
    done(capsys, "fit-bones", "rig.usda", "--target", "jawOpen", "--threshold-mm", "50", "-o", "shape.usda")
    assert facepipe.open("person.usda").parts().person == "goal"
    assert facepipe.open("shape.usda").parts().person is None
