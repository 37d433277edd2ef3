"""`facepipe blend`: weights, recipes, editing, matching, and mistakes that write nothing."""

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
from faces import grid_mesh, replace_mesh, tiny_face
from hypothesis import given
from hypothesis import strategies as st
from import_data import refused

import facepipe
from facepipe.cli import blend_command, main
from facepipe.options import from_json, to_json
from facepipe.parts import FaceParts
from facepipe.processors.blend import Blend, BlendOptions, Weights
from facepipe.processors.blend.recipe import blend_recipe, read_blend_recipe
from facepipe.processors.blend.weights_json import weights_from_json, weights_to_json
from facepipe.stage import Face, save_parts
from facepipe.validate import validate

Capsys = pytest.CaptureFixture[str]
WORDS = ("--set", "mouth=0.75,0.25", "--default", "0.5,0.5")


def made(seed: int) -> FaceParts:
    """A small face with points of its own."""
    parts, rng = tiny_face(seed), np.random.default_rng(seed)
    meshes = [replace_mesh(mesh, points=mesh.points + rng.normal(0, 0.05, mesh.points.shape)) for mesh in parts.meshes]
    return dataclasses.replace(parts, meshes=tuple(meshes))


@pytest.fixture(scope="module")
def drawer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """a.usda, b.usda, other.usda on one topology."""
    folder = tmp_path_factory.mktemp("drawer")
    for seed, name in enumerate(("a", "b", "other")):
        save_parts(made(seed), folder / f"{name}.usda")
    return folder


@pytest.fixture
def folder(drawer: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the commands run, with the faces in it."""
    for file in drawer.iterdir():
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(capsys: Capsys, *words: object) -> tuple[int, str, str]:
    """Exit code, stdout, stderr of `facepipe blend`."""
    try:
        code = main(["blend", *(str(word) for word in words)])
    except SystemExit as stop:
        code = int(stop.code or 0)
    out, err = capsys.readouterr()
    return code, out, err


def done(capsys: Capsys, *words: object) -> str:
    """Stdout of a command that must do its work without a warning."""
    code, out, err = run(capsys, *words)
    assert (code, err) == (0, "")
    return out


def failed(capsys: Capsys, *words: object) -> str:
    """The one line of a command that must fail and change no file."""
    before = content(Path.cwd())
    code, out, err = run(capsys, *words)
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert content(Path.cwd()) == before
    return err


def content(folder: Path) -> dict[Path, bytes]:
    return {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def points(path: str) -> Any:
    return facepipe.open(path).evaluate()


def saved(parts: FaceParts, name: str, **mesh_changes: Any) -> None:
    """Save the face with every mesh changed."""
    meshes = tuple(replace_mesh(mesh, **mesh_changes) for mesh in parts.meshes)
    save_parts(dataclasses.replace(parts, meshes=meshes), Path(name))


# --- blending


def test_the_result_is_that_of_python(folder: Path, capsys: Capsys) -> None:
    out = done(capsys, "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    weights = Weights(regions={"mouth": (0.75, 0.25)}, default=(0.5, 0.5))
    sources = [facepipe.open("a.usda"), facepipe.open("b.usda")]
    with sources[0].deriving("d.usda") as face:
        recipe = blend_recipe(["a.usda", "b.usda"], "d.usda", weights, BlendOptions())
        report = Blend(weights=weights)(face, sources, recipe=recipe)
    assert Path("c.usda").read_bytes() == Path("d.usda").read_bytes()
    assert out.startswith("c.usda: 2 sources, 45 points, 3 shapes and inbetweens in ")
    assert re.search(r"^mouth +\d+ +\d\.\d{4} ", out, re.MULTILINE)
    assert f"all  {report.deviation.edges}" in re.sub(r" +", "  ", out)
    assert "@./a.usda@" in Path("c.usda").read_text()
    assert [one for one in validate(Path("c.usda")) if one.severity == "error"] == []


def test_sources_are_not_touched_and_bytes_repeat(folder: Path, capsys: Capsys) -> None:
    before = content(folder)
    done(capsys, "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    first = Path("c.usda").read_bytes()
    done(capsys, "a.usda", "b.usda", "-o", "c.usda", *WORDS, "--force")
    assert content(folder) == {**before, folder / "c.usda": first}


def test_json(folder: Path, capsys: Capsys) -> None:
    words = ("--set", "mouth=3,1", "--default", "0.5,0.5", "--json")
    code, out, err = run(capsys, "a.usda", "b.usda", "-o", "c.usda", *words)
    report = json.loads(out)
    assert (code, report["path"], report["sources"]) == (0, "c.usda", ["a.usda", "b.usda"])
    assert report["weights"] == {"mouth": [0.75, 0.25], "neck": [0.5, 0.5], "default": [0.5, 0.5]}
    assert sum(one["edges"] for one in report["regions"].values()) == report["deviation"]["edges"]
    assert report["warnings"] == ["weights of mouth sum to 4, normalised to 1"]
    assert err == "facepipe: warning: weights of mouth sum to 4, normalised to 1\n"


def test_one_source_is_that_face_with_a_warning(folder: Path, capsys: Capsys) -> None:
    code, _, err = run(capsys, "a.usda", "-o", "c.usda")
    assert (code, err.count("\n")) == (0, 1)
    assert "one source" in err
    np.testing.assert_allclose(points("c.usda"), points("a.usda"), atol=1e-6)


def test_all_weight_on_one_source_gives_its_shape(folder: Path, capsys: Capsys) -> None:
    done(capsys, "a.usda", "b.usda", "other.usda", "-o", "c.usda", "--default", "0,1,0")
    done(capsys, "a.usda", "b.usda", "other.usda", "-o", "d.usda", "--gains", "0,1,0")
    moved = points("c.usda")[:36] - points("b.usda")[:36]
    assert np.ptp(moved, axis=0).max() < 1e-5  # but for the place of the anchor
    np.testing.assert_array_equal(points("c.usda"), points("d.usda"))


def test_a_lock_wins_over_default_and_gains(folder: Path, capsys: Capsys) -> None:
    words = ("--default", "0.1,0.9", "--gains", "1,3", "--lock", "mouth=1", "--json")
    report = json.loads(done(capsys, "a.usda", "b.usda", "-o", "c.usda", *words))
    assert report["weights"]["mouth"] == [1.0, 0.0]
    assert report["weights"]["neck"] == pytest.approx([0.1 / 2.8, 2.7 / 2.8])


def test_weights_of_a_file_and_flags_over_them(folder: Path, capsys: Capsys) -> None:
    weights = {"regions": {"mouth": [1, 3], "neck": [1, 0]}, "default": [0, 1], "gains": [2, 1], "locked": {"neck": 2}}
    Path("w.json").write_text(json.dumps(weights))
    flat = {**weights["regions"], **{key: weights[key] for key in ("default", "gains", "locked")}}  # type: ignore[dict-item]
    Path("flat.json").write_text(json.dumps(flat))
    run(capsys, "a.usda", "b.usda", "-o", "c.usda", "--weights", "w.json")
    run(capsys, "a.usda", "b.usda", "-o", "d.usda", "--weights", "flat.json")
    assert Path("c.usda").read_bytes() == Path("d.usda").read_bytes()
    assert weights_to_json(read_blend_recipe("c.usda").weights) == weights
    words = ("--weights", "w.json", "--set", "mouth=0.5,0.5", "--gains", "1,1", "--unlock", "neck", "--json")
    _, out, _ = run(capsys, "a.usda", "b.usda", "-o", "e.usda", *words)
    assert json.loads(out)["weights"] == {"mouth": [0.5, 0.5], "neck": [1.0, 0.0], "default": [0.0, 1.0]}


def test_options_reach_the_blend(folder: Path, capsys: Capsys) -> None:
    words = ("--edges", "cotangent", "--expressions", "document", "--static-mm", "0.01", "--anchor", "Head:3")
    done(capsys, "a.usda", "b.usda", "-o", "c.usda", *words)
    options = BlendOptions(edges="cotangent", expressions="document", static_mm=0.01, anchor="Head:3")
    assert read_blend_recipe("c.usda").options == options
    np.testing.assert_allclose(points("c.usda")[3], points("a.usda")[3], atol=1e-6)


@pytest.mark.parametrize("name", ["c.usda", "c.usdz"])
def test_flat_results_stand_alone_and_stay_so(folder: Path, capsys: Capsys, name: str) -> None:
    done(capsys, "a.usda", "b.usda", "-o", name, *WORDS, "--flatten")
    done(capsys, "a.usda", "b.usda", "-o", "layer.usda", *WORDS)
    np.testing.assert_allclose(points(name), points("layer.usda"), atol=1e-6)
    done(capsys, "--edit", name, "--set", "mouth=0,1", "--force")
    done(capsys, "--edit", "layer.usda", "--set", "mouth=0,1", "--force")
    expected = points("layer.usda")
    shutil.move("a.usda", "gone.usda")
    np.testing.assert_allclose(points(name), expected, atol=1e-6)


def test_the_picture_of_the_seams(folder: Path, capsys: Capsys) -> None:
    from PIL import Image

    out = done(capsys, "a.usda", "b.usda", "-o", "c.usda", *WORDS, "--heatmap", "seams.png")
    assert out.splitlines()[-1] == "seams.png"
    assert main(["render", "c.usda", "--heatmap", "facepipe:seamResidual", "-o", "again.png"]) == 0
    drawn, again = (np.asarray(Image.open(name).convert("RGB"), dtype=int) for name in ("seams.png", "again.png"))
    face = (slice(100, 700), slice(50, 640))  # beside the bar and its label
    assert drawn[face].std() > 5
    assert np.abs(drawn[face] - again[face]).mean() < 0.01


# --- recipes


def test_a_recipe_reads_back_as_it_was_written(folder: Path) -> None:
    weights = Weights(regions={"mouth": (0.1, 0.2), "neck": (1, 0)}, gains=(1, 1 / 3), locked={"neck": 2})
    options = BlendOptions(missing="transfer", region_width_mm=2.5, keep_shape="Teeth", anchor="Head:1", solver="splu")
    recipe = blend_recipe(["a.usda", Path("sub") / ".." / "b.usda"], Path("sub") / "c.usda", weights, options)
    assert recipe.sources == ("../a.usda", "../b.usda")
    (folder / "sub").mkdir()
    save_parts(dataclasses.replace(made(0), recipe=recipe), Path("sub") / "c.usda")
    again = read_blend_recipe("sub/c.usda")
    assert again.sources == (folder.resolve() / "a.usda", folder.resolve() / "b.usda")
    assert (again.weights, again.options, again.warnings) == (weights, options, ())


def test_digests_cover_the_layers_of_a_source(folder: Path, capsys: Capsys) -> None:
    done(capsys, "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    done(capsys, "c.usda", "other.usda", "-o", "d.usda")
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
    done(capsys, "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    shutil.copy("other.usda", "b.usda")
    code, out, err = run(capsys, "--edit", "c.usda", "-o", "d.usda", "--json")
    assert (code, err) == (0, "facepipe: warning: b.usda changed since c.usda was made\n")
    assert json.loads(out)["warnings"] == ["b.usda changed since c.usda was made"]
    done(capsys, "a.usda", "b.usda", "-o", "e.usda", *WORDS)
    assert Path("d.usda").read_bytes() == Path("e.usda").read_bytes()


def replaced_options(change: Any) -> Any:
    """An edit of the recipe's options in the text of a layer."""

    def edit(text: str) -> str:
        (old,) = re.findall(r"facepipe:recipe:options = '(.*)'", text)
        options = json.loads(old)
        changed = change(options)
        return text.replace(old, changed if isinstance(changed, str) else json.dumps(options))

    return edit


HOSTILE = [
    (lambda text: re.sub(r".*facepipe:recipe:verb.*\n", "", text), "has no recipe"),
    (lambda text: text.replace('verb = "blend"', 'verb = "sample"'), "a recipe of 'sample'"),
    (lambda text: text.replace('recipe:version = "', 'recipe:version = "9'), "made by facepipe 9"),
    (lambda text: text.replace('recipe:version = "', 'recipe:version = "x'), "version 'x"),
    (lambda text: text.replace('["./a.usda", "./b.usda"]', "[]"), "0 sources and 2 digests"),
    (lambda text: text.replace('["./a.usda", "./b.usda"]', '["./a.usda", ""]'), "source 2"),
    (lambda text: text.replace('["./a.usda", "./b.usda"]', '["./a.usda", "/dev/zero"]'), "no such file"),
    (lambda text: text.replace('["./a.usda", "./b.usda"]', '["./a.usda", "./a.usda"]'), "a source twice"),
    (lambda text: text.replace('["./a.usda", "./b.usda"]', "3"), "c.usda"),
    (replaced_options(lambda options: "nothing"), "no JSON"),
    (replaced_options(lambda options: "[" * 100_000), "no JSON"),
    (replaced_options(lambda options: "[1]"), "options are damaged"),
    (replaced_options(lambda options: options.pop("weights")), "options are damaged"),
    (replaced_options(lambda options: options.update(weights=3) or 0), "expected a JSON object"),
    (replaced_options(lambda options: options["weights"].update(regions={"mouth": "ab"}) or 0), "list of numbers"),
    (replaced_options(lambda options: options["weights"].update(regions={"mouth": [1]}) or 0), "1 weights, expected 2"),
    (replaced_options(lambda options: options["weights"].update(regions={"nose": [1, 1]}) or 0), "no such region"),
    (replaced_options(lambda options: options["weights"].update(default=[True, 1]) or 0), "list of numbers"),
    (replaced_options(lambda options: options["weights"].update(gains=[10**400, 1]) or 0), "list of numbers"),
    (replaced_options(lambda options: options["weights"].update(default=[float("nan"), 1]) or 0), "weight nan"),
    (replaced_options(lambda options: options["weights"].update(locked={"mouth": 7}) or 0), "from 1 to 2"),
    (replaced_options(lambda options: options["weights"].update(locked={"mouth": 1.5}) or 0), "number of a source"),
    (replaced_options(lambda options: options["options"].update(edges="both") or 0), "uniform, cotangent"),
    (replaced_options(lambda options: options["options"].update(static_mm=-1) or 0), "number from 0 to 100"),
    (replaced_options(lambda options: options["options"].update(static_mm="1") or 0), "a finite number"),
    (replaced_options(lambda options: options["options"].update(anchor=[]) or 0), "a text or null"),
    (replaced_options(lambda options: options["options"].update(speed=1) or 0), "option 'speed' is unknown"),
]


@pytest.mark.parametrize(("change", "message"), HOSTILE)
def test_damaged_recipes_are_one_line(folder: Path, capsys: Capsys, change: Any, message: str) -> None:
    done(capsys, "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    text = Path("c.usda").read_text()
    damaged = change(text)
    assert damaged != text
    Path("c.usda").write_text(damaged)
    for words in (("-o", "d.usda"), ("--force",)):
        assert message in failed(capsys, "--edit", "c.usda", *words)


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
    done(capsys, "a.usda", "b.usda", "-o", "c.usda", *before)
    first = Path("c.usda").read_bytes()
    done(capsys, "a.usda", "b.usda", "-o", "fresh.usda", *fresh)
    done(capsys, "--edit", "c.usda", *edit, "-o", "d.usda")
    assert Path("c.usda").read_bytes() == first
    done(capsys, "--edit", "c.usda", *edit, "--force")
    for name in ("c.usda", "d.usda"):
        assert Path(name).read_bytes() == Path("fresh.usda").read_bytes()


@pytest.mark.parametrize(("number", "sources"), [(2, ("a.usda", "other.usda")), (1, ("other.usda", "b.usda"))])
def test_a_replaced_source_is_a_fresh_blend(
    folder: Path, capsys: Capsys, number: int, sources: tuple[str, str]
) -> None:
    done(capsys, "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    done(capsys, "--edit", "c.usda", "--replace", f"{number}=other.usda", "--force")
    done(capsys, *sources, "-o", "fresh.usda", *WORDS)
    assert Path("c.usda").read_bytes() == Path("fresh.usda").read_bytes()


def test_a_folder_that_moved_is_edited_as_before(folder: Path, capsys: Capsys, monkeypatch: Any) -> None:
    (folder / "one" / "out").mkdir(parents=True)
    for name in ("a.usda", "b.usda"):
        shutil.move(name, Path("one") / name)
    done(capsys, "one/a.usda", "one/b.usda", "-o", "one/out/c.usda", *WORDS)
    done(capsys, "one/a.usda", "one/b.usda", "-o", "one/out/fresh.usda", "--set", "mouth=0,1", "--default", "0.5,0.5")
    shutil.move("one", "two")
    monkeypatch.chdir(folder / "two" / "out")
    done(capsys, "--edit", "c.usda", "--set", "mouth=0,1", "--force")
    assert Path("c.usda").read_bytes() == Path("fresh.usda").read_bytes()
    assert str(folder) not in Path("c.usda").read_text()


@pytest.mark.parametrize(("number", "name"), [(1, "a.usda"), (2, "b.usda")])
def test_a_source_that_went_is_named_and_can_be_replaced(folder: Path, capsys: Capsys, number: int, name: str) -> None:
    done(capsys, "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    shutil.move(name, "moved.usda")
    error = failed(capsys, "--edit", "c.usda", "-o", "d.usda")
    assert f"recipe -> source {number}: " in error
    assert f"{name}: no such file" in error
    done(capsys, "--edit", "c.usda", "--replace", f"{number}=moved.usda", "-o", "d.usda")
    shutil.copy("moved.usda", name)
    np.testing.assert_array_equal(points("d.usda"), points("c.usda"))


def test_mistakes_in_editing(folder: Path, capsys: Capsys) -> None:
    done(capsys, "a.usda", "b.usda", "-o", "c.usda", *WORDS, "--lock", "neck=2")
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
        (("--edit", "c.usda", "--replace", "other.usda", "-o", "d.usda"), "expected N=FACE"),
        (("--edit", "c.usda", "--replace", "2=gone.usda", "-o", "d.usda"), "gone.usda: no such file"),
        (("--edit", "c.usda", "--replace", "2=a.usda", "-o", "d.usda"), "a source twice"),
        (("--edit", "c.usda", "--replace", "2=c.usda", "--force"), "c.usda: is an input"),
        (("--edit", "a.usda", "-o", "d.usda"), "a.usda: has no recipe"),
        (("--edit", "gone.usda", "-o", "d.usda"), "gone.usda: no such file"),
        (("a.usda", "b.usda", "-o", "d.usda", "--replace", "2=other.usda"), "--replace: given without --edit"),
    ]
    for words, message in cases:
        assert message in failed(capsys, *words), words


def test_weights_of_a_file_respect_locks_too(folder: Path, capsys: Capsys) -> None:
    done(capsys, "a.usda", "b.usda", "-o", "c.usda", *WORDS, "--lock", "neck=2")
    Path("w.json").write_text('{"neck": [1, 0]}')
    assert "locked to source 2" in failed(capsys, "--edit", "c.usda", "--weights", "w.json", "--force")
    done(capsys, "--edit", "c.usda", "--weights", "w.json", "--unlock", "neck", "--force")
    regions = {"mouth": (0.75, 0.25), "neck": (1.0, 0.0)}
    assert read_blend_recipe("c.usda").weights == Weights(regions=regions, default=(0.5, 0.5))


def test_layers_that_a_source_stands_on_are_not_overwritten(folder: Path, capsys: Capsys) -> None:
    done(capsys, "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    done(capsys, "c.usda", "b.usda", "-o", "d.usda")
    assert "needed by" in failed(capsys, "d.usda", "b.usda", "-o", "a.usda", "--force")
    assert "needed by" in failed(capsys, "--edit", "c.usda", "--replace", "2=d.usda", "--force")


# --- matching


def test_match_finds_the_weights_of_a_blend(folder: Path, capsys: Capsys) -> None:
    sources = ("a.usda", "b.usda", "other.usda")
    done(capsys, *sources, "-o", "target.usda", "--set", "mouth=0.7,0.2,0.1", "--set", "neck=0.1,0.3,0.6")
    out = done(capsys, "--match", "target.usda", *sources, "-o", "found.usda")
    assert re.search(r"^mouth +0\.700 +0\.200 +0\.100$", out, re.MULTILINE)
    assert re.search(r"^neck +0\.100 +0\.300 +0\.600$", out, re.MULTILINE)
    assert "found.usda: 3 sources" in out
    np.testing.assert_allclose(points("found.usda"), points("target.usda"), atol=1e-5)
    done(capsys, "--edit", "found.usda", "--set", "mouth=0,0,1", "--force")


def test_match_keeps_locks(folder: Path, capsys: Capsys) -> None:
    done(capsys, "a.usda", "b.usda", "-o", "target.usda", "--set", "mouth=0.7,0.3", "--set", "neck=0.1,0.9")
    words = ("--match", "target.usda", "a.usda", "b.usda", "-o", "found.usda", "--lock", "neck=1")
    report = json.loads(done(capsys, *words, "--json"))
    assert report["weights"]["neck"] == [1.0, 0.0]
    assert report["match"]["rms_mm"] > 0
    assert read_blend_recipe("found.usda").weights.locked == {"neck": 1}


@pytest.mark.parametrize(
    "words",
    [("--set", "mouth=1,0"), ("--default", "1,0"), ("--gains", "1,0"), ("--unlock", "neck"), ("--edit", "b.usda")],
)
def test_match_takes_no_weights(folder: Path, capsys: Capsys, words: tuple[str, str]) -> None:
    sources = () if words[0] == "--edit" else ("a.usda", "b.usda")
    error = failed(capsys, "--match", "other.usda", *sources, "-o", "c.usda", *words)
    assert f"{words[0]}: given with --match" in error


def test_a_target_of_another_topology(folder: Path, capsys: Capsys) -> None:
    save_parts(FaceParts(meshes=(grid_mesh(), grid_mesh("Teeth", 4))), Path("odd.usda"))
    error = failed(capsys, "--match", "odd.usda", "a.usda", "b.usda", "-o", "c.usda")
    assert "odd.usda -> Teeth: 16 points, expected 9" in error


# --- mistakes


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "SOURCE: none given"),
        (("a.usda", "b.usda"), "no output file"),
        (("a.usda", "gone.usda", "-o", "c.usda"), "gone.usda: no such file"),
        (("a.usda", "a.usda", "-o", "c.usda"), "a.usda: is a source twice"),
        (("a.usda", "./b.usda", "b.usda", "-o", "c.usda"), "b.usda: is a source twice"),
        (("a.usda", "b.usda", "-o", "c.obj"), "suffix '.obj'"),
        (("a.usda", "b.usda", "-o", "no/c.usda"), "the folder does not exist"),
        (("a.usda", "b.usda", "-o", "b.usda", "--force"), "b.usda: is an input"),
        (("a.usda", "b.usda", "-o", "other.usda"), "exists, expected a new file (or --force)"),
        (
            ("a.usda", "b.usda", "-o", "c.usda", "--set", "nose=1,0"),
            "no such region, expected one of mouth, neck",
        ),
        (("a.usda", "b.usda", "-o", "c.usda", "--set", "mouth=1"), "1 weights, expected 2"),
        (("a.usda", "b.usda", "-o", "c.usda", "--set", "mouth=1,0,0"), "3 weights, expected 2"),
        (("a.usda", "b.usda", "-o", "c.usda", "--default", "1"), "1 weights, expected 2"),
        (("a.usda", "b.usda", "-o", "c.usda", "--gains", "1,1,1"), "3 weights, expected 2"),
        (("a.usda", "b.usda", "-o", "c.usda", "--set", "mouth=nan,1"), "--set mouth=nan,1: expected finite numbers"),
        (("a.usda", "b.usda", "-o", "c.usda", "--set", "mouth=0.5"), "1 weights, expected 2"),
        (("a.usda", "b.usda", "-o", "c.usda", "--set", "mouth"), "expected REGION=W,W,..."),
        (("a.usda", "b.usda", "-o", "c.usda", "--set", "mouth=a,b"), "expected finite numbers"),
        (("a.usda", "b.usda", "-o", "c.usda", "--set", "mouth=-1,2"), "source 1: weight -1.0, expected"),
        (("a.usda", "b.usda", "-o", "c.usda", "--set", "mouth=0,0"), "mouth: all weights are 0"),
        (("a.usda", "b.usda", "-o", "c.usda", "--gains", "0,0"), "all weights are 0"),
        (("a.usda", "b.usda", "-o", "c.usda", "--lock", "mouth=0"), "source 0, expected a number from 1 to 2"),
        (("a.usda", "b.usda", "-o", "c.usda", "--lock", "mouth=b"), "expected REGION=N"),
        (("a.usda", "b.usda", "-o", "c.usda", "--lock", "nose=1"), "nose: no such region"),
        (("a.usda", "b.usda", "-o", "c.usda", "--unlock", "mouth"), "is not locked"),
        (("a.usda", "b.usda", "-o", "c.usda", "--static-mm", "-1"), "option static_mm: is -1.0"),
        (("a.usda", "b.usda", "-o", "c.usda", "--static-mm", "nan"), "option static_mm: is nan"),
        (("a.usda", "b.usda", "-o", "c.usda", "--anchor", "Head:99"), "Head:99: no such point"),
        (("a.usda", "b.usda", "-o", "c.usda", "--keep-shape", "Nose*"), "Nose*"),
        (("a.usda", "b.usda", "-o", "c.usda", "--edges", "both"), "invalid choice"),
        (("a.usda", "b.usda", "-o", "c.usda", "--heatmap", "s.jpg"), "suffix '.jpg', expected .png"),
        (("a.usda", "b.usda", "-o", "c.usda", "--heatmap", "no/s.png"), "the folder does not exist"),
        (("a.usda", "b.usda", "-o", "c.usda", "--weights", "gone.json"), "gone.json: can't be read"),
        (("a.usda", "b.usda", "-o", "c.usda", "--weights", "/dev/zero"), "not a regular file"),
    ],
)
def test_mistakes_are_one_line_and_write_nothing(
    folder: Path, capsys: Capsys, words: tuple[str, ...], message: str
) -> None:
    assert message in failed(capsys, *words)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nothing", "is not JSON"),
        ("[" * 100_000, "is not JSON"),
        ("[1, 2]", "expected a JSON object"),
        ('{"mouth": 1}', "mouth: 1, expected a list of numbers"),
        ('{"mouth": [1, "2"]}', "expected a list of numbers"),
        ('{"mouth": [NaN, 1]}', "weight nan, expected a number of 0 or more"),
        ('{"mouth": [1, 0], "mouth": [0, 1]}', "'mouth' twice"),
        ('{"regions": {"mouth": [1, 0]}, "neck": [1, 0]}', "neck: unknown key"),
        ('{"regions": [1, 0]}', "no such region"),
        ('{"locked": {"mouth": "a"}}', "expected the number of a source"),
        ('{"locked": [1]}', "expected a JSON object"),
        ('{"nose": [1, 0]}', "nose: no such region"),
        ('{"mouth": [1, 0, 0]}', "3 weights, expected 2"),
    ],
)
def test_bad_files_of_weights(folder: Path, capsys: Capsys, text: str, message: str) -> None:
    Path("w.json").write_text(text)
    assert message in failed(capsys, "a.usda", "b.usda", "-o", "c.usda", "--weights", "w.json")


def test_faces_that_do_not_fit(folder: Path, capsys: Capsys) -> None:
    odd = made(1)
    saved(odd, "bare.usda", regions={})
    save_parts(dataclasses.replace(odd, meshes=odd.meshes[:1]), Path("few.usda"))
    turned = odd.meshes[0].face_vertex_indices.copy()
    turned[4:8] = np.roll(turned[4:8], 1)
    corners = replace_mesh(odd.meshes[0], face_vertex_indices=turned)
    save_parts(dataclasses.replace(odd, meshes=(corners, odd.meshes[1])), Path("turned.usda"))
    saved(odd, "still.usda", blendshapes=())
    Path("damaged.usda").write_text(Path("b.usda").read_text().replace("point3f[] points = [", "point3f[] points = [("))
    cases = [
        (("bare.usda", "b.usda", "--set", "mouth=1,0"), "the first source has no regions"),
        (("a.usda", "few.usda"), "few.usda: no mesh 'Teeth'"),
        (("a.usda", "turned.usda"), "turned.usda -> Head: face 1 uses point"),
        (("a.usda", "still.usda"), "still.usda: no shape 'jawOpen'"),
        (("a.usda", "damaged.usda"), "damaged.usda"),
    ]
    for words, message in cases:
        assert message in failed(capsys, *words, "-o", "c.usda"), words
    code, out, _ = run(capsys, "a.usda", "still.usda", "-o", "c.usda", "--missing", "skip")
    assert (code, "left out, as some source lacks them: jawOpen, mouthSmileLeft" in out) == (0, True)


def test_a_picture_that_is_there_is_kept(folder: Path, capsys: Capsys) -> None:
    Path("s.png").write_text("precious")
    words = ("a.usda", "b.usda", "-o", "c.usda", "--heatmap", "s.png")
    assert "exists" in failed(capsys, *words)
    done(capsys, *words, "--force")
    assert Path("s.png").read_bytes().startswith(b"\x89PNG")


# --- whole heads


@pytest.fixture(scope="module")
def heads(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """a.usda, b.usda, other.usda: sample heads."""
    from facepipe.sample import make

    folder = tmp_path_factory.mktemp("heads")
    for seed, name in enumerate(("a", "b", "other")):
        save_parts(make(seed), folder / f"{name}.usda")
    return folder


def test_the_examples_of_the_help_run(heads: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(heads)
    examples = re.findall(r"^ +facepipe blend (.*)$", blend_command.__doc__ or "", re.MULTILINE)
    assert len(examples) > 3
    for line in examples:
        done(capsys, *line.split())
    for name in ("c.usda", "d.usda", "e.usda"):
        assert [one for one in validate(heads / name) if one.severity == "error"] == []
    assert len(facepipe.open("c.usda").shapes) == len(facepipe.open("a.usda").shapes)
    assert np.linalg.norm(points("c.usda") - points("e.usda"), axis=1).max() < 0.01 * height(facepipe.open("a.usda"))


def height(face: Face) -> float:
    return face.head_height
