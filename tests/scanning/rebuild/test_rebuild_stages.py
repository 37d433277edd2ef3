"""What `facepipe personal-template`, `register-scan` and `split-shapes` have in common: recipes, bytes, bad input."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import expression_domes
import numpy as np
import pytest
from command_line import done, failed, run
from faces import with_meshes
from rebuild_stages import QUALITY, SEEN, Files

import facepipe
from facepipe.importers.scan_file import read_scan
from facepipe.importers.scan_landmarks import read_scan_landmarks, write_scan_landmarks
from facepipe.importers.scan_ply import write_ply
from facepipe.kinds import found_of
from facepipe.performing import read_kept
from facepipe.scanning.database import quality_from
from facepipe.scanning.rebuild.personal_template_action import PersonalTemplateAction
from facepipe.stage import save_parts
from facepipe.stage.recipes import source_digest


def test_the_recipes_show_what_the_stages_were_made_of(stages: Files) -> None:
    recipes = {name: facepipe.open(stages[f"{name}.usda"]).parts().recipe for name in ("personal", "open", "actor")}
    verbs = {"personal": "personal-template", "open": "register-scan", "actor": "split-shapes"}
    for name, recipe in recipes.items():
        assert recipe is not None
        assert recipe.verb == verbs[name]
        assert recipe.digests == tuple(source_digest(stages.folder / source) for source in recipe.sources)
    assert recipes["open"].sources == ("./personal.usda", "./open.ply", "./open.landmarks.json")  # type: ignore[union-attr]
    assert recipes["open"].options["weights"] == SEEN["open"]  # type: ignore[union-attr]
    assert recipes["actor"].sources == ("./personal.usda", "./open.usda", "./both.usda")  # type: ignore[union-attr]
    kept = quality_from(found_of(recipes["actor"])["quality"], "recipe")
    assert kept == QUALITY  # of the neutral; no shape of this person turns a triangle over


def test_edit_changes_what_is_given(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """Without a database, shapes come from the template either way."""
    done(capsys, *files.personal())
    done(capsys, "personal-template", "--edit", files["p.usda"], "--shapes-from", "template", "-o", files["q.usda"])
    assert read_kept(files["q.usda"], PersonalTemplateAction).values["shapes_from"] == "template"
    assert np.array_equal(files.delta("q.usda", "jawOpen"), files.delta("p.usda", "jawOpen"))
    done(capsys, *files.split(), quiet=False)
    edit = ("split-shapes", "--edit", files["actor.usda"], "--noise", 0.3, "-o", files["edited.usda"])
    done(capsys, *edit, quiet=False)
    done(capsys, *files.split("--noise", 0.3, "--force"), quiet=False)
    assert files["edited.usda"].read_bytes() == files["actor.usda"].read_bytes()


@pytest.mark.parametrize("stage", ["personal", "register", "split"])
def test_the_same_files_give_the_same_bytes(files: Files, capsys: pytest.CaptureFixture[str], stage: str) -> None:
    words = {"personal": files.personal(), "register": files.register("open"), "split": files.split()}[stage]
    out = words[words.index("-o") + 1]
    assert isinstance(out, Path)
    contents = []
    for _ in range(2):
        done(capsys, *words, "--force")
        contents.append(out.read_bytes())
    assert contents[0] == contents[1]


@pytest.mark.parametrize("stage", ["personal", "register", "split"])
def test_flattened_it_stands_alone(files: Files, capsys: pytest.CaptureFixture[str], stage: str) -> None:
    words = {"personal": files.personal(), "register": files.register("open"), "split": files.split()}[stage]
    out = words[words.index("-o") + 1]
    assert isinstance(out, Path)
    shape = "open" if stage == "register" else "jawOpen"
    done(capsys, *words, "--force")
    layered = files.delta(out.name, shape)
    done(capsys, *words, "--force", "--flatten")
    for path in files.folder.glob("*.usda"):
        if path != out:
            path.unlink()
    assert np.array_equal(files.delta(out.name, shape), layered)


def _other_face(name: str) -> Callable[[Files], None]:
    def spoil(files: Files) -> None:
        from database_faces import person

        save_parts(person(1), files[name])

    return spoil


def _other_neutral(files: Files) -> None:
    """An expression of someone else."""
    someone = replace(expression_domes.face(4), recipe=facepipe.open(files["open.usda"]).parts().recipe)
    save_parts(someone, files["open.usda"])


def _elsewhere(files: Files) -> None:
    scan = read_scan(files["open.ply"])
    write_ply(replace(scan, points=scan.points + 500.0), files["open.ply"])


def _mirrored(files: Files) -> None:
    scan, landmarks = (read_scan(files["open.ply"]), read_scan_landmarks(files["open.landmarks.json"]))
    write_ply(replace(scan, points=scan.points * [-1.0, 1.0, 1.0]), files["open.ply"])
    write_scan_landmarks(replace(landmarks, points=landmarks.points * [-1.0, 1.0, 1.0]), files["open.landmarks.json"])


def _no_recipe(files: Files) -> None:
    save_parts(replace(facepipe.open(files["open.usda"]).parts(), recipe=None), files["open.usda"])


def _damaged_recipe(files: Files) -> None:
    parts = facepipe.open(files["open.usda"]).parts()
    assert parts.recipe is not None
    options = {**parts.recipe.options, "weights": {"jawOpen": "much"}}
    save_parts(replace(parts, recipe=replace(parts.recipe, options=options)), files["open.usda"])


def _two_of_one_name(files: Files) -> None:
    files["both.usda"].write_bytes(files["open.usda"].read_bytes())


def _no_shapes(files: Files) -> None:
    parts = expression_domes.face()
    save_parts(with_meshes(parts, blendshapes=()), files["head.usda"])


def _nothing(files: Files) -> None:
    pass


def _words(files: Files, stage: str) -> Iterator[object]:
    return iter({"personal": files.personal(), "register": files.register("open"), "split": files.split()}[stage])


@pytest.mark.parametrize(
    ("stage", "spoil", "more", "text"),
    [
        ("personal", _other_face("anna.usda"), (), "other meshes or faces than"),
        ("personal", _other_face("head.usda"), (), "no multipie68 landmarks"),
        ("personal", _no_shapes, (), "has no blendshapes, expected some to start from"),
        ("personal", _nothing, ("--shapes-from", "database"), "has no expressions"),
        ("personal", lambda files: files["anna.usda"].unlink(), (), "anna.usda"),
        ("personal", _nothing, ("--database", "none.fpdb"), "none.fpdb"),
        ("register", _nothing, ("--weights", "jawShut=1"), "--weights -> jawShut: no such shape"),
        ("register", _nothing, ("--weights", "jawOpen=3"), "weight 3.0, expected one above 0, up to 2"),
        ("register", _nothing, ("--weights", "jawOpen"), "expected NAME=NUMBER"),
        ("register", _nothing, ("--name", "jawOpen"), "the face has such a shape, expected another --name"),
        ("register", _nothing, ("--name", "no name"), "expected letters, digits and underscores"),
        ("register", _elsewhere, (), "does it show this face?"),
        ("register", _mirrored, (), "open -> landmarks: fit a mirrored face, expected left and right as"),
        ("register", _nothing, ("--landmarks", "none.json"), "none.json"),
        ("register", _nothing, ("--neutral-landmarks", "a.json"), "expected --neutral-scan beside it"),
        ("register", _nothing, ("--neutral-scan", "none.ply"), "none.ply"),
        ("register", _other_face("personal.usda"), (), "no multipie68 landmarks"),
        ("register", lambda files: files["open.ply"].unlink(), (), "open.ply"),
        ("split", _no_recipe, (), "has no recipe, expected a face made by `facepipe register-scan`"),
        ("split", _damaged_recipe, (), "weights -> jawOpen: 'much', expected a finite number"),
        ("split", _two_of_one_name, (), "two expressions are called 'open', expected each name once"),
        ("split", _other_neutral, (), "open.usda: stands on a neutral that is up to"),
        ("split", _other_face("personal.usda"), (), "no multipie68 landmarks"),
        ("split", lambda files: files["both.usda"].unlink(), (), "both.usda"),
        ("split", _nothing, ("--noise", "-1"), "option noise"),
    ],
)
def test_bad_input_gives_one_line_and_nothing_written(
    files: Files,
    stage: str,
    spoil: Callable[[Files], None],
    more: tuple[str, ...],
    text: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(files.folder)
    if stage == "register":
        files["open.usda"].unlink()
    spoil(files)
    assert text in failed(capsys, *_words(files, stage), *more)


def test_inputs_are_not_overwritten(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.read_bytes() for path in files.folder.iterdir()}
    for words, targets in (
        (files.personal("--force"), ("anna.usda", "head.usda")),
        (files.register("open", "--force"), ("personal.usda", "open.ply", "anna.usda")),
        (files.split("--force"), ("personal.usda", "open.usda", "anna.usda")),
    ):
        for target in targets:
            changed = list(words)
            changed[changed.index("-o") + 1] = files[target]
            assert run(capsys, *changed)[0] == 2
    assert {path: path.read_bytes() for path in files.folder.iterdir()} == before


def test_stages_are_cooked_to_the_bytes_of_their_commands(
    files: Files, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One scan changes: its expression and the actor do, the other expression and the person do not."""
    monkeypatch.chdir(files.folder)
    assert run(capsys, *files.split())[0] == 0
    before = {path.name: path.read_bytes() for path in files.folder.iterdir()}
    code, out, _ = run(capsys, "cook", "actor.usda", "--force")
    assert (code, out.count(": cooked")) == (0, 4)
    assert {path.name: path.read_bytes() for path in files.folder.iterdir()} == before
    expression_domes.put(files["open.ply"], {"jawOpen": 0.6})
    code, out, _ = run(capsys, "cook", "actor.usda")
    done = {line.split(":")[0]: line.split(": ")[2].split(" ")[0] for line in out.splitlines()[:4]}
    assert (code, done) == (
        0,
        {"personal.usda": "up", "open.usda": "cooked", "both.usda": "up", "actor.usda": "cooked"},
    )
    cooked = {path.name: path.read_bytes() for path in files.folder.iterdir()}
    assert run(capsys, *files.register("open", "--force"))[0] == 0
    assert run(capsys, *files.split("--force"))[0] == 0
    assert {path.name: path.read_bytes() for path in files.folder.iterdir()} == cooked
