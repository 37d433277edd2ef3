"""`facepipe blend`: what it makes and prints, matching, and mistakes that write nothing."""

from __future__ import annotations

import argparse
import dataclasses
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import Capsys, content, done, exit_code, failed, run
from faces import grid_mesh, replace_mesh
from small_sources import WORDS, made, points, saved

import facepipe
from facepipe.checks import validate
from facepipe.cli import command_module
from facepipe.cli.parser import Parser
from facepipe.performing import read_kept, recipe_to
from facepipe.stage import save_parts
from facepipe.verbs.blend import Blend, BlendFaces, Weights
from facepipe.verbs.blend.quality import Contact, _deviation
from facepipe.verbs.blend.weights import weights_to_json

# --- blending


def test_the_result_is_that_of_python(folder: Path, capsys: Capsys) -> None:
    out = done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    weights = Weights(regions={"mouth": (0.75, 0.25)}, default=(0.5, 0.5))
    sources = [facepipe.open("a.usda"), facepipe.open("b.usda")]
    with sources[0].deriving("d.usda") as face:
        recipe = recipe_to(BlendFaces(sources=(Path("a.usda"), Path("b.usda")), weights=weights), "d.usda")
        report = Blend(weights=weights)(face, sources, recipe=recipe)
    assert Path("c.usda").read_bytes() == Path("d.usda").read_bytes()
    assert out.startswith("c.usda: 2 sources, 45 points, 3 shapes and inbetweens in ")
    assert re.search(r"^mouth +\d+ +\d\.\d{4} ", out, re.MULTILINE)
    assert f"all  {report.deviation.edges}" in re.sub(r" +", "  ", out)
    assert "@./a.usda@" in Path("c.usda").read_text()
    assert [one for one in validate(Path("c.usda")) if one.severity == "error"] == []


def test_sources_are_not_touched_and_bytes_repeat(folder: Path, capsys: Capsys) -> None:
    before = content(folder)
    done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    first = Path("c.usda").read_bytes()
    done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *WORDS, "--force")
    assert content(folder) == {**before, folder / "c.usda": first}


def test_json(folder: Path, capsys: Capsys) -> None:
    words = ("--set", "mouth=3,1", "--default", "0.5,0.5", "--json")
    code, out, err = run(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *words)
    report = json.loads(out)
    assert (code, report["path"], report["sources"]) == (0, "c.usda", ["a.usda", "b.usda"])
    assert report["weights"] == {"mouth": [0.75, 0.25], "neck": [0.5, 0.5], "default": [0.5, 0.5]}
    assert sum(one["edges"] for one in report["regions"].values()) == report["deviation"]["edges"]
    assert report["warnings"] == ["weights of mouth sum to 4, normalised to 1"]
    assert err == "facepipe: warning: weights of mouth sum to 4, normalised to 1\n"


def test_the_summary_counts_parts_shapes_and_lids(folder: Path, capsys: Capsys) -> None:
    """A line for each eye; long lists by their number and first names."""
    sources = [facepipe.open("a.usda"), facepipe.open("b.usda")]
    with sources[0].deriving("c.usda") as face:
        report = Blend()(face, sources)
    plain = report.as_text(Path("c.usda"))
    assert f"loose parts: {report.loose_parts}; parts that keep their shape: {report.kept_parts}" in plain
    assert report.loose_parts == 1
    assert "transferred" not in plain
    assert "left out" not in plain
    contacts = {
        "EyeLeft": Contact(depth_mm=0.125, sources_mm=(0.0, 0.25)),
        "EyeRight": Contact(
            depth_mm=0.0,
            sources_mm=(0.5, 1.0),
            worst_shape="eyeBlinkRight",
            worst_depth_mm=2.0,
            worst_sources_mm=(1.5, 1.75),
        ),
    }
    names = tuple(f"shape{number}" for number in range(34))
    long = dataclasses.replace(report, contacts=contacts, skipped=names[:2], transferred=names, kept_parts=3)
    full = long.as_text(Path("c.usda"))
    assert full.splitlines()[-6:] == [
        "loose parts: 1; parts that keep their shape: 3",
        "EyeLeft: skin lies in it by 0.12 mm (sources 0.00, 0.25)",
        "EyeRight: skin lies in it by 0.00 mm (sources 0.50, 1.00); "
        "at worst 2.00 mm (sources 1.50, 1.75) with eyeBlinkRight",
        "shapes transferred: 34 (shape0, shape1, shape2, shape3, ...)",
        "shapes left out, as some source lacks them: 2 (shape0, shape1)",
        "sources are laid on the first one by: Head outside the mouth",
    ]


def test_no_edges_deviate_by_nothing() -> None:
    assert set(dataclasses.astuple(_deviation(np.zeros(0)))) == {0}


def test_every_warning_is_said_once(folder: Path, capsys: Capsys) -> None:
    """Of a source that changed, of weights, and of what only a later source has."""
    done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *WORDS)
    parts = made(1)
    save_parts(dataclasses.replace(parts, meshes=(*parts.meshes, grid_mesh("Hair", 3))), Path("b.usda"))
    code, out, err = run(capsys, "blend", "--edit", "c.usda", "--set", "mouth=2,2", "--force", "--json")
    lines = [line.removeprefix("facepipe: warning: ") for line in err.splitlines()]
    assert code == 0
    assert lines == json.loads(out)["warnings"]
    for part in ("b.usda changed", "Hair", "sum to 4"):
        assert sum(part in line for line in lines) == 1, err
    code, out, err = run(capsys, "blend", "--match", "other.usda", "a.usda", "b.usda", "-o", "m.usda", "--json")
    assert err.count("Hair") == 1
    assert len(json.loads(out)["warnings"]) == err.count("\n")


def test_one_source_is_that_face_with_a_warning(folder: Path, capsys: Capsys) -> None:
    code, _, err = run(capsys, "blend", "a.usda", "-o", "c.usda")
    assert (code, err.count("\n")) == (0, 1)
    assert "one source" in err
    np.testing.assert_allclose(points("c.usda"), points("a.usda"), atol=1e-6)


def test_all_weight_on_one_source_gives_its_shape(folder: Path, capsys: Capsys) -> None:
    done(capsys, "blend", "a.usda", "b.usda", "other.usda", "-o", "c.usda", "--default", "0,1,0", "--align", "none")
    done(capsys, "blend", "a.usda", "b.usda", "other.usda", "-o", "d.usda", "--gains", "0,1,0", "--align", "none")
    moved = points("c.usda")[:36] - points("b.usda")[:36]
    assert np.ptp(moved, axis=0).max() < 1e-5  # but for the place of the anchor
    np.testing.assert_array_equal(points("c.usda"), points("d.usda"))


def test_a_lock_wins_over_default_and_gains(folder: Path, capsys: Capsys) -> None:
    words = ("--default", "0.1,0.9", "--gains", "1,3", "--lock", "mouth=1", "--json")
    report = json.loads(done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *words))
    assert report["weights"]["mouth"] == [1.0, 0.0]
    assert report["weights"]["neck"] == pytest.approx([0.1 / 2.8, 2.7 / 2.8])


def test_weights_of_a_file_and_flags_over_them(folder: Path, capsys: Capsys) -> None:
    weights = {"regions": {"mouth": [1, 3], "neck": [1, 0]}, "default": [0, 1], "gains": [2, 1], "locked": {"neck": 2}}
    Path("w.json").write_text(json.dumps(weights))
    flat = {**weights["regions"], **{key: weights[key] for key in ("default", "gains", "locked")}}  # type: ignore[dict-item]
    Path("flat.json").write_text(json.dumps(flat))
    run(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", "--weights", "w.json")
    run(capsys, "blend", "a.usda", "b.usda", "-o", "d.usda", "--weights", "flat.json")
    assert Path("c.usda").read_bytes() == Path("d.usda").read_bytes()
    assert weights_to_json(read_kept("c.usda", BlendFaces).values["weights"]) == weights
    words = ("--weights", "w.json", "--set", "mouth=0.5,0.5", "--gains", "1,1", "--unlock", "neck", "--json")
    _, out, _ = run(capsys, "blend", "a.usda", "b.usda", "-o", "e.usda", *words)
    assert json.loads(out)["weights"] == {"mouth": [0.5, 0.5], "neck": [1.0, 0.0], "default": [0.0, 1.0]}


def test_options_reach_the_blend(folder: Path, capsys: Capsys) -> None:
    words = ("--edges", "cotangent", "--expressions", "document", "--static-mm", "0.01", "--anchor", "Head:3")
    done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *words)
    options = {"edges": "cotangent", "expressions": "document", "static_mm": 0.01, "anchor": "Head:3"}
    assert options.items() <= read_kept("c.usda", BlendFaces).values.items()
    np.testing.assert_allclose(points("c.usda")[3], points("a.usda")[3], atol=1e-6)


@pytest.mark.parametrize("name", ["c.usda", "c.usdz"])
def test_flat_results_stand_alone_and_stay_so(folder: Path, capsys: Capsys, name: str) -> None:
    done(capsys, "blend", "a.usda", "b.usda", "-o", name, *WORDS, "--flatten")
    done(capsys, "blend", "a.usda", "b.usda", "-o", "layer.usda", *WORDS)
    np.testing.assert_allclose(points(name), points("layer.usda"), atol=1e-6)
    done(capsys, "blend", "--edit", name, "--set", "mouth=0,1", "--force")
    done(capsys, "blend", "--edit", "layer.usda", "--set", "mouth=0,1", "--force")
    expected = points("layer.usda")
    shutil.move("a.usda", "gone.usda")
    np.testing.assert_allclose(points(name), expected, atol=1e-6)


def test_the_picture_of_the_seams(folder: Path, capsys: Capsys) -> None:
    """It replaces no file without --force, and is the one that `render` draws."""
    from PIL import Image

    Path("seams.png").write_text("precious")
    words = ("a.usda", "b.usda", "-o", "c.usda", *WORDS, "--heatmap", "seams.png")
    assert "seams.png: exists" in failed(capsys, "blend", *words)
    out = done(capsys, "blend", *words, "--force")
    assert out.splitlines()[-1] == "seams.png"
    assert exit_code("render", "c.usda", "--heatmap", "facepipe:seamResidual", "-o", "again.png") == 0
    drawn, again = (np.asarray(Image.open(name).convert("RGB"), dtype=int) for name in ("seams.png", "again.png"))
    face = (slice(100, 700), slice(50, 640))  # beside the bar and its label
    assert drawn[face].std() > 5
    assert np.abs(drawn[face] - again[face]).mean() < 0.01


# --- matching


def test_match_finds_the_weights_of_a_blend(folder: Path, capsys: Capsys) -> None:
    sources = ("a.usda", "b.usda", "other.usda")
    done(capsys, "blend", *sources, "-o", "target.usda", "--set", "mouth=0.7,0.2,0.1", "--set", "neck=0.1,0.3,0.6")
    out = done(capsys, "blend", "--match", "target.usda", *sources, "-o", "found.usda")
    assert re.search(r"^mouth +0\.700 +0\.200 +0\.100$", out, re.MULTILINE)
    assert re.search(r"^neck +0\.100 +0\.300 +0\.600$", out, re.MULTILINE)
    assert re.search(r"^found weights +a\.usda +b\.usda +other\.usda$", out, re.MULTILINE)
    assert "edges differ from the target's by 0.0000 mm RMS, 0.0000 mm at most" in out
    assert "found.usda: 3 sources" in out
    np.testing.assert_allclose(points("found.usda"), points("target.usda"), atol=1e-5)
    done(capsys, "blend", "--edit", "found.usda", "--set", "mouth=0,0,1", "--force")


def test_match_keeps_locks(folder: Path, capsys: Capsys) -> None:
    done(capsys, "blend", "a.usda", "b.usda", "-o", "target.usda", "--set", "mouth=0.7,0.3", "--set", "neck=0.1,0.9")
    words = ("--match", "target.usda", "a.usda", "b.usda", "-o", "found.usda", "--lock", "neck=1")
    report = json.loads(done(capsys, "blend", *words, "--json"))
    assert report["weights"]["neck"] == [1.0, 0.0]
    found = report["match"]
    assert found["max_mm"] >= found["rms_mm"] > 0
    assert found["weights"]["locked"] == {"neck": 1}
    assert found["weights"]["regions"]["mouth"] == pytest.approx(report["weights"]["mouth"])
    assert sum(found["weights"]["default"]) == pytest.approx(1)
    assert read_kept("found.usda", BlendFaces).values["weights"].locked == {"neck": 1}


@pytest.mark.parametrize(
    "words",
    [("--set", "mouth=1,0"), ("--default", "1,0"), ("--gains", "1,0"), ("--unlock", "neck")],
)
def test_match_takes_no_weights(folder: Path, capsys: Capsys, words: tuple[str, str]) -> None:
    error = failed(capsys, "blend", "--match", "other.usda", "a.usda", "b.usda", "-o", "c.usda", *words)
    assert f"{words[0]}: given with --match" in error


FEW_LANDMARKS = json.dumps({"points": [[0, 0, 0], *[None] * 67]})  # to conform by: with none, a face is looked for


def test_a_target_of_another_topology(folder: Path, capsys: Capsys) -> None:
    odd = (grid_mesh(), grid_mesh("Teeth", 4))
    save_parts(dataclasses.replace(facepipe.open("a.usda").parts(), meshes=odd), Path("odd.usda"))
    Path("a.landmarks.json").write_text(FEW_LANDMARKS)
    error = failed(capsys, "blend", "--match", "odd.usda", "a.usda", "b.usda", "-o", "c.usda")
    assert "odd.usda -> Teeth: 16 points, expected 9 as in a.usda; can't be conformed: a.usda" in error


# --- mistakes

LONG = "a" * 300 + ".usda"


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
        (
            ("a.usda", "b.usda", "-o", "c.usda", "--set", "mouth=-2,3"),
            "source 1: -2 where weights sum to 1",
        ),
        (("a.usda", "b.usda", "-o", "c.usda", "--set", "mouth=-1,1"), "mouth: weights that sum to 0 or less"),
        (("a.usda", "b.usda", "-o", "c.usda", "--set", "mouth=-1,-2"), "mouth: no weight above 0"),
        (
            ("a.usda", "b.usda", "-o", "c.usda", "--gains", "-1,2"),
            "source 1: weight -1.0, expected a number of 0",
        ),
        (("a.usda", "b.usda", "-o", "c.usda", "--set", "mouth=0,0"), "weights -> mouth: no weight above 0"),
        (("a.usda", "b.usda", "-o", "c.usda", "--default", "0,0"), "weights -> default: no weight above 0"),
        (("a.usda", "b.usda", "-o", "c.usda", "--gains", "0,0"), "weights -> gains: no weight above 0"),
        (("a.usda", "b.usda", "-o", "c.usda", "--lock", "mouth=0"), "source 0, expected a number from 1 to 2"),
        (("a.usda", "b.usda", "-o", "c.usda", "--lock", "mouth=b"), "expected REGION=N"),
        (("a.usda", "b.usda", "-o", "c.usda", "--lock", "nose=1"), "nose: no such region"),
        (
            ("a.usda", "b.usda", "-o", "c.usda", "--lock", "mouth=1", "--lock", "mouth=2"),
            "--lock mouth=...: given twice",
        ),
        (
            ("a.usda", "b.usda", "-o", "c.usda", "--set", "mouth=1,0", "--set", "mouth=1,0"),
            "--set mouth=...: given twice",
        ),
        (("a.usda", "b.usda", "-o", "c.usda", "--unlock", "mouth"), "is not locked"),
        (("a.usda", LONG, "-o", "c.usda"), "aaaa...: file name too long"),
        (("a.usda", "b.usda", "-o", LONG), "aaaa...: file name too long"),
        (("--edit", LONG, "-o", "c.usda"), "aaaa...: file name too long"),
        (("--match", LONG, "a.usda", "-o", "c.usda"), "aaaa...: file name too long"),
        (("a.usda", "b.usda", "-o", "c.usda", "--weights", LONG), "aaaa...: file name too long"),
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
    assert message in failed(capsys, "blend", *words)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nothing", "is not JSON"),
        ("[" * 100_000, "is not JSON"),
        ("[1, 2]", "expected a JSON object"),
        ('{"mouth": 1}', "mouth: 1, expected a list of which each is a finite number"),
        ('{"mouth": [1, "2"]}', "mouth -> 1: '2', expected a finite number"),
        ('{"mouth": [NaN, 1]}', "mouth -> 0: nan, expected a finite number"),
        ('{"mouth": [1, 0], "mouth": [0, 1]}', "'mouth' twice"),
        ('{"regions": {"mouth": [1, 0]}, "neck": [1, 0]}', "option 'neck' is unknown, expected some of regions"),
        ('{"regions": [1, 0]}', "no such region"),
        ('{"locked": {"mouth": "a"}}', "locked -> mouth: 'a', expected a whole number"),
        ('{"locked": [1]}', "locked: [1], expected an object of which each value is a whole number"),
        ('{"nose": [1, 0]}', "nose: no such region"),
        ('{"mouth": [1, 0, 0]}', "3 weights, expected 2"),
    ],
)
def test_bad_files_of_weights(folder: Path, capsys: Capsys, text: str, message: str) -> None:
    Path("w.json").write_text(text)
    assert message in failed(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", "--weights", "w.json")


def test_faces_that_do_not_fit(folder: Path, capsys: Capsys) -> None:
    odd = made(1)
    saved(odd, "bare.usda", regions={})
    save_parts(dataclasses.replace(odd, meshes=odd.meshes[:1]), Path("few.usda"))
    turned = odd.meshes[0].face_vertex_indices.copy()
    turned[4:8] = np.roll(turned[4:8], 1)
    corners = replace_mesh(odd.meshes[0], face_vertex_indices=turned)
    save_parts(dataclasses.replace(odd, meshes=(corners, odd.meshes[1])), Path("turned.usda"))
    saved(odd, "still.usda", blendshapes=())
    Path("a.landmarks.json").write_text(FEW_LANDMARKS)
    Path("damaged.usda").write_text(Path("b.usda").read_text().replace("point3f[] points = [", "point3f[] points = [("))
    cases = [
        (("bare.usda", "b.usda", "--set", "mouth=1,0"), "the first source has no regions"),
        (("a.usda", "few.usda"), "few.usda: no mesh 'Teeth'"),
        (("a.usda", "turned.usda"), "turned.usda -> Head: face 1 uses point"),
        (("a.usda", "still.usda"), "still.usda: no shape 'jawOpen'"),
        (("a.usda", "damaged.usda"), "damaged.usda"),
    ]
    for words, message in cases:
        assert message in failed(capsys, "blend", *words, "-o", "c.usda"), words
    code, out, _ = run(capsys, "blend", "a.usda", "still.usda", "-o", "c.usda", "--missing", "skip")
    assert (code, "left out, as some source lacks them: 2 (jawOpen, mouthSmileLeft)" in out) == (0, True)


# --- help


def test_the_examples_of_the_help_run(folder: Path, capsys: Capsys) -> None:
    for seed, name in enumerate(("a", "b", "other")):
        parts = made(seed)
        eyes = [{"neck": "eyes"}.get(region, region) for region in parts.meshes[0].regions]
        regions = dict(zip(eyes, parts.meshes[0].regions.values(), strict=True))
        head = replace_mesh(parts.meshes[0], regions=regions)
        save_parts(dataclasses.replace(parts, meshes=(head, *parts.meshes[1:])), Path(f"{name}.usda"))
    examples = re.findall(r"^ +facepipe blend (.*)$", command_module("blend").__doc__ or "", re.MULTILINE)
    assert len(examples) > 3
    for line in examples[1:]:  # the first is of heads of several topologies, which take their time
        done(capsys, "blend", *line.split())
    for name in ("c.usda", "d.usda", "e.usda"):
        assert [one for one in validate(folder / name) if one.severity == "error"] == []
    np.testing.assert_allclose(points("e.usda"), points("c.usda"), atol=1e-4)


def test_every_group_of_the_help_has_a_title_of_its_own() -> None:
    parser = Parser(prog="facepipe blend")
    command_module("blend").configure(parser, [])
    titles = [group.title for group in parser._action_groups if group._group_actions]
    assert len(set(titles)) == len(titles) == 5
    assert all(action.help for action in parser._actions if not isinstance(action, argparse._HelpAction))
