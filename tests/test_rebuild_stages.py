"""`facepipe personal-template`, `register-scan` and `split-shapes`: a person whose own shapes are known."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import expression_domes
import numpy as np
import pytest
import scan_domes
from expression_domes import OWN, PERSON
from import_data import shared
from test_cli import run

import facepipe
from facepipe.geometry.similarity import Similarity
from facepipe.importers.scan_file import read_scan
from facepipe.importers.scan_landmarks import read_scan_landmarks, write_scan_landmarks
from facepipe.importers.scan_ply import write_ply
from facepipe.parts import Recipe
from facepipe.processors.database import (
    Quality,
    WholeFace,
    create_database,
    quality_from,
    save_database,
    whole_face,
    whole_points,
)
from facepipe.processors.rebuild import Template
from facepipe.processors.rebuild.author_neutral import AuthorNeutral
from facepipe.processors.rebuild.neutral_place import placed_neutral
from facepipe.scans import Scan, ScanLandmarks
from facepipe.stage import save_parts
from facepipe.stage.recipes import source_digest
from facepipe.tokens import SCANNED
from facepipe.validate import validate

SEEN = {"open": {"jawOpen": 0.8}, "both": {"jawOpen": 0.4, "browUp": 1.0}}
QUALITY = Quality(surface_mean_mm=0.1, surface_p95_mm=0.4, coverage=0.9, flipped_triangles=3)
DOME = expression_domes.SIDE**2  # points of the first mesh


@dataclass(frozen=True)
class Files:
    """A folder with the stages of a rebuild."""

    folder: Path

    def __getitem__(self, name: str) -> Path:
        return self.folder / name

    def personal(self, *more: object) -> tuple[object, ...]:
        return ("personal-template", self["anna.usda"], "--template", self["head.usda"], "-o", self["p.usda"], *more)

    def register(self, name: str, *more: object) -> tuple[object, ...]:
        shown = [f"{shape}={weight}" for shape, weight in SEEN.get(name, {"jawOpen": 0.5}).items()]
        files = ("--personal", self["personal.usda"], "-o", self[f"{name}.usda"])
        return ("register-scan", self[f"{name}.ply"], *files, "--weights", *shown, *more)

    def split(self, *more: object) -> tuple[object, ...]:
        files = [self[f"{name}.usda"] for name in SEEN]
        return ("split-shapes", *files, "--personal", self["personal.usda"], "-o", self["actor.usda"], *more)

    def delta(self, name: str, shape: str) -> np.ndarray:
        """(n, 3) of the dome."""
        return whole_face(facepipe.open(self[name]).parts(), name).deltas[shape][:DOME]


def _put(folder: Path) -> Files:
    files = Files(folder)
    save_parts(expression_domes.face(), files["head.usda"])
    recipe = Recipe(verb="fit-neutral", options={"quality": QUALITY.__dict__})
    save_parts(replace(expression_domes.face(PERSON), recipe=recipe), files["anna.usda"])
    for name, weights in {"anna": {}, **SEEN}.items():
        expression_domes.put(files[f"{name}.ply"], weights)
    return files


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """All stages, one after another; not to be changed."""
    from facepipe.cli import main

    files = _put(tmp_path_factory.mktemp("stages"))
    words = list(files.personal())
    words[words.index(files["p.usda"])] = files["personal.usda"]
    for command in (words, files.register("open"), files.register("both"), files.split()):
        assert main([str(word) for word in command]) == 0
    return files


@pytest.fixture
def files(made: Files, tmp_path: Path) -> Files:
    """A copy to work in, without the actor."""
    for path in made.folder.iterdir():
        if path.name != "actor.usda":
            (tmp_path / path.name).write_bytes(path.read_bytes())
    return Files(tmp_path)


def test_starting_shapes_are_the_templates_carried_over(made: Files) -> None:
    """On other proportions they move about as much, the same way; the neutral is not touched."""
    for shape in OWN:
        own, template = made.delta("personal.usda", shape), expression_domes.template_motion(shape)
        assert np.abs(own - template).max() < 0.25 * np.abs(template).max()
        assert np.abs(own - template).max() > 1e-3
    before, after = (facepipe.open(made[name]) for name in ("anna.usda", "personal.usda"))
    assert np.array_equal(whole_points(before.parts()), whole_points(after.parts()))
    assert after.shapes == before.shapes
    assert after.skeleton.joints == before.skeleton.joints
    assert validate(made["personal.usda"]) == ()


def test_on_the_template_itself_starting_shapes_are_its_own(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    save_parts(expression_domes.face(), files["anna.usda"])
    code, out, _ = run(capsys, *files.personal("--json"))
    assert code == 0
    assert json.loads(out)["change_mean_mm"] < 1e-4
    for shape in OWN:
        assert np.abs(files.delta("p.usda", shape) - expression_domes.template_motion(shape)).max() < 1e-3


def test_a_database_with_expressions_gives_the_starting_shapes(
    files: Files, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its people move 1.3 times as much as the template does, and so will this one; what it lacks stays."""
    people = [_mover(seed, 1.3) for seed in range(1, 5)]
    save_database(create_database(people).database, files["faces.fpdb"])
    code, out, err = run(capsys, *files.personal("--database", files["faces.fpdb"], "--json"))
    assert code == 0, err
    assert json.loads(out)["source"] == "from the database"
    assert list(json.loads(out)["motion_mm"]) == ["jawOpen"]
    assert "1 shapes that the source lacks stay as they are: browUp" in err
    from_template = files.delta("personal.usda", "jawOpen")
    assert np.abs(files.delta("p.usda", "jawOpen") - 1.3 * from_template).max() < 0.3
    assert np.array_equal(files.delta("p.usda", "browUp"), files.delta("anna.usda", "browUp"))
    words = files.personal("--database", files["faces.fpdb"], "--shapes-from", "template", "--force", "--json")
    assert json.loads(run(capsys, *words)[1])["source"] == "from the template"
    assert np.array_equal(files.delta("p.usda", "jawOpen"), from_template)


def _mover(seed: int, gain: float) -> Callable[[], WholeFace]:
    parts = expression_domes.face(seed)
    jaw = parts.meshes[0].blendshapes[0]
    head = replace(parts.meshes[0], blendshapes=(replace(jaw, offsets=gain * jaw.offsets),))
    return lambda: whole_face(replace(parts, meshes=(head, *parts.meshes[1:])), f"p{seed}")


def test_an_expression_is_a_shape_over_the_personal_template(made: Files) -> None:
    places = scan_domes.grid(expression_domes.SIDE)[0]
    personal = facepipe.open(made["personal.usda"])
    for name, weights in SEEN.items():
        face = facepipe.open(made[f"{name}.usda"])
        assert face.shapes == (*personal.shapes, name)
        assert np.array_equal(whole_points(face.parts()), whole_points(personal.parts()))
        truth = sum(weight * OWN[shape] * expression_domes.motion(shape, places) for shape, weight in weights.items())
        off = np.linalg.norm(made.delta(f"{name}.usda", name) - truth, axis=1)
        template = sum(weight * made.delta("personal.usda", shape) for shape, weight in weights.items())
        assert off.mean() < 0.25 * np.linalg.norm(template - truth, axis=1).mean()
        assert off.mean() < 0.1
        for shape in OWN:
            assert np.array_equal(made.delta(f"{name}.usda", shape), made.delta("personal.usda", shape))
        assert validate(made[f"{name}.usda"]) == ()


def test_it_says_which_points_the_scan_showed(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """Half a scan; the eyeball is not matched."""
    scan = read_scan(files["open.ply"])
    at_home = scan_domes.POSE.undo(scan.points)
    half = scan.triangles[(at_home[scan.triangles][:, :, 0] < 0.0).all(axis=1)]
    write_ply(Scan(name="open", points=scan.points, triangles=half), files["open.ply"])
    code, _, err = run(capsys, *files.register("open", "--force"))
    assert code == 1
    assert "coverage" in err
    face = facepipe.open(files["open.usda"])
    scanned = face.primvar(SCANNED)
    x = whole_points(face.parts())[:DOME, 0]
    inside = np.abs(scan_domes.grid(expression_domes.SIDE)[0]).max(axis=1) < 44.0  # away from the scan's border
    assert set(np.unique(scanned)) == {0.0, 1.0}
    assert scanned[DOME:].max() == 0.0
    assert scanned[:DOME][x > 4.0].max() == 0.0
    assert scanned[:DOME][(x < -4.0) & inside].min() == 1.0


def test_the_recipes_tell_what_the_stages_were_made_of(made: Files) -> None:
    recipes = {name: facepipe.open(made[f"{name}.usda"]).parts().recipe for name in ("personal", "open", "actor")}
    verbs = {"personal": "personal-template", "open": "register-scan", "actor": "split-shapes"}
    for name, recipe in recipes.items():
        assert recipe is not None
        assert recipe.verb == verbs[name]
        assert recipe.digests == tuple(source_digest(made.folder / one) for one in recipe.sources)
    assert recipes["open"].sources == ("./personal.usda", "./open.ply", "./open.landmarks.json")  # type: ignore[union-attr]
    assert recipes["open"].options["weights"] == SEEN["open"]  # type: ignore[union-attr]
    assert recipes["actor"].sources == ("./personal.usda", "./open.usda", "./both.usda")  # type: ignore[union-attr]
    kept = quality_from(recipes["actor"].options["quality"], "recipe")  # type: ignore[union-attr]
    assert kept == QUALITY  # of the neutral; no shape of this person turns a triangle over


def test_with_the_neutrals_scan_sizes_are_one(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """The neutral's place on its scan is exact, and the expression's scan has its size to the bit."""
    face = facepipe.open(files["personal.usda"])
    template = Template.of(face.parts(), "personal.usda")
    scan, landmarks = read_scan(files["anna.ply"]), read_scan_landmarks(files["anna.landmarks.json"])
    place = placed_neutral(template, template.points, scan, landmarks).place
    assert isinstance(place, Similarity)
    moved = place.apply(scan_domes.POSE.apply(template.points))
    assert np.abs(moved - template.points).max() < 0.01
    words = files.register("open", "--neutral-scan", files["anna.ply"], "--force", "--json")
    held, free = (json.loads(run(capsys, *one)[1]) for one in (words, files.register("open", "--force", "--json")))
    assert held["fit"]["mm_per_unit"] == place.scale
    assert free["fit"]["mm_per_unit"] != place.scale


def test_painted_markers_are_followed_with_the_neutrals_scan(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """Motion along a surface that landmarks don't tell of: few landmarks, then markers too."""
    names = ("anna", "open")
    places = np.array([(x, y) for x in (-20.0, 0.0, 20.0) for y in (-30.0, -18.0, 0.0)])
    for name in names:
        own = SEEN.get(name, {})
        delta = sum((weight * OWN[one] * expression_domes.motion(one, places) for one, weight in own.items()), 0.0)
        where = scan_domes.POSE.apply(scan_domes.dome(places, PERSON) + delta)
        known = read_scan_landmarks(files[f"{name}.landmarks.json"])
        points = known.points.copy()
        if name == "open":
            points[:17] = points[31:] = np.nan  # chin and mouth are not told
        markers = {f"m{number}": one for number, one in enumerate(where)}
        write_scan_landmarks(replace(known, points=points, markers=markers), files[f"{name}.landmarks.json"])
    code, _, err = run(capsys, *files.register("open", "--force"))
    assert "markers don't count without --neutral-scan" in err
    truth = 0.8 * OWN["jawOpen"] * expression_domes.template_motion("jawOpen")
    without = np.linalg.norm(files.delta("open.usda", "open") - truth, axis=1).mean()
    code, _, err = run(capsys, *files.register("open", "--force", "--neutral-scan", files["anna.ply"]))
    assert code == 0
    assert "markers don't count" not in err
    assert np.linalg.norm(files.delta("open.usda", "open") - truth, axis=1).mean() < 0.5 * without


def test_shapes_become_the_persons_own(made: Files) -> None:
    for shape, gain in OWN.items():
        truth = gain * made.delta("personal.usda", shape)
        before, after = (
            np.linalg.norm(made.delta(name, shape) - truth, axis=1).mean() for name in ("personal.usda", "actor.usda")
        )
        assert after < 0.5 * before
    assert validate(made["actor.usda"]) == ()
    personal, actor = (facepipe.open(made[name]) for name in ("personal.usda", "actor.usda"))
    assert actor.shapes == personal.shapes
    assert np.array_equal(whole_points(actor.parts()), whole_points(personal.parts()))


def test_the_table_tells_of_each_shape(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """One expression alone: what it does not show stays to the bit, and that is no failure."""
    words = ("split-shapes", files["open.usda"], "--personal", files["personal.usda"], "-o", files["actor.usda"])
    code, out, _ = run(capsys, *words)
    assert code == 0
    jaw = next(line.split() for line in out.splitlines() if line.startswith("jawOpen"))
    assert float(jaw[1]) > 0.5
    assert 1.1 < float(jaw[2]) < 1.45
    assert jaw[4] == "open"
    assert "1 shapes of scans, 1 told apart; 1 as the personal template has them" in out
    assert np.array_equal(files.delta("actor.usda", "browUp"), files.delta("personal.usda", "browUp"))
    code, out, _ = run(capsys, *words, "--json", "--force")
    told = json.loads(out)
    assert told["shapes"]["jawOpen"]["gain"] == pytest.approx(float(jaw[2]), abs=0.006)
    assert told["unseen"] == ["browUp"]


def test_a_correction_by_hand_is_split(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """An artist who makes the whole expression smaller gets a smaller shape."""
    sizes = []
    for factor in (1.0, 0.8):
        face = facepipe.open(files["open.usda"])
        own = whole_face(face.parts(), "open")
        with face.deriving(files["corrected.usda"]) as derived:
            recipe = face.parts().recipe
            AuthorNeutral(shapes={"open": factor * own.deltas["open"]})(derived, own.points, recipe=recipe)
        words = ("split-shapes", files["corrected.usda"], "--personal", files["personal.usda"])
        assert run(capsys, *words, "-o", files["actor.usda"], "--force", "--weight-spread", 0)[0] == 0
        sizes.append(np.linalg.norm(files.delta("actor.usda", "jawOpen"), axis=1).mean())
    assert 0.78 < sizes[1] / sizes[0] < 0.9


def test_what_shapes_leave_is_told(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """Two expressions of the same weights that move in opposite ways: written, and exit code 1."""
    face = facepipe.open(files["open.usda"])
    own, recipe = whole_face(face.parts(), "open"), face.parts().recipe
    assert recipe is not None
    with face.deriving(files["odd.usda"]) as derived:
        other = replace(recipe, options={**recipe.options, "name": "odd"})
        AuthorNeutral(shapes={"odd": -2.0 * own.deltas["open"]})(derived, own.points, recipe=other)
    words = ("split-shapes", files["open.usda"], files["odd.usda"], "--personal", files["personal.usda"])
    code, _, err = run(capsys, *words, "-o", files["actor.usda"])
    assert code == 1
    assert "odd: shapes leave" in err
    assert files["actor.usda"].exists()


def test_a_personal_template_that_changed_is_told(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    text = files["personal.usda"].read_text(encoding="utf-8")
    files["personal.usda"].write_text(text + "\n# touched\n", encoding="utf-8")
    code, _, err = run(capsys, *files.split())
    assert code == 0
    assert "personal.usda is not what open.usda was registered with" in err


@pytest.mark.parametrize("stage", ["personal", "register", "split"])
def test_the_same_files_give_the_same_bytes(files: Files, capsys: pytest.CaptureFixture[str], stage: str) -> None:
    words = {"personal": files.personal(), "register": files.register("open"), "split": files.split()}[stage]
    out = words[words.index("-o") + 1]
    assert isinstance(out, Path)
    contents = []
    for _ in range(2):
        assert run(capsys, *words, "--force")[0] == 0
        contents.append(out.read_bytes())
    assert contents[0] == contents[1]


@pytest.mark.parametrize("stage", ["personal", "register", "split"])
def test_flattened_it_stands_alone(files: Files, capsys: pytest.CaptureFixture[str], stage: str) -> None:
    words = {"personal": files.personal(), "register": files.register("open"), "split": files.split()}[stage]
    out = words[words.index("-o") + 1]
    assert isinstance(out, Path)
    shape = "open" if stage == "register" else "jawOpen"
    assert run(capsys, *words, "--force")[0] == 0
    layered = files.delta(out.name, shape)
    assert run(capsys, *words, "--force", "--flatten")[0] == 0
    for path in files.folder.glob("*.usda"):
        if path != out:
            path.unlink()
    assert np.array_equal(files.delta(out.name, shape), layered)


def test_a_picture_is_drawn_beside_it(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    from PIL import Image

    code, out, _ = run(capsys, *files.register("open", "--force", "--picture", files["open.png"]))
    assert code == 0
    assert str(files["open.png"]) in out
    assert np.asarray(Image.open(files["open.png"]).convert("L")).std() > 10


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
    save_parts(replace(parts, meshes=tuple(replace(one, blendshapes=()) for one in parts.meshes)), files["head.usda"])


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
def test_bad_input_is_told_in_one_line_and_nothing_written(
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
    before = {path: path.read_bytes() for path in files.folder.iterdir()}
    code, out, err = run(capsys, *_words(files, stage), *more)
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert text in err
    assert {path: path.read_bytes() for path in files.folder.iterdir()} == before


@pytest.mark.parametrize(
    ("more", "text"),
    [
        (("--composite", "grin"), "--composite grin: no composite of that name, expected --weights"),
        ((), "no composite of that name"),
        (("--composite", "smile"), "composite smile -> mouthSmile_L: no such shape"),
    ],
)
def test_composites_are_names_of_the_table(
    files: Files, more: tuple[str, ...], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("register-scan", files["open.ply"], "--personal", files["personal.usda"], "-o", files["new.usda"])
    code, _, err = run(capsys, *words, *more)
    assert (code, err.count("\n")) == (2, 1)
    assert text in err
    assert not files["new.usda"].exists()


def test_a_scan_named_as_a_composite_shows_it(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    for end in (".ply", ".landmarks.json"):
        files[f"jaw_open{end}"].write_bytes(files[f"open{end}"].read_bytes())
    words = ("register-scan", files["jaw_open.ply"], "--personal", files["personal.usda"], "-o", files["new.usda"])
    assert run(capsys, *words)[0] == 0
    found, known = (files.delta(*one) for one in (("new.usda", "jaw_open"), ("open.usda", "open")))
    assert np.array_equal(found, known)


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


@pytest.mark.slow
def test_a_real_template_gets_the_shapes_of_an_actor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """ICT-FaceKit, an actor whose expressions are known, three simulated scans, from command to command."""
    from scan_actors import COMPOSITES, Actor, ict
    from scan_simulator import simulate

    npz, files, actor = shared("ict_facekit/ict_facekit.npz"), Files(tmp_path), Actor(101)
    assert run(capsys, "import", "ict", npz, files["head.usdc"])[0] == 0
    with facepipe.open(files["head.usdc"]).deriving(files["anna.usdc"]) as derived:
        AuthorNeutral()(derived, actor.neutral)
    words = (files["anna.usdc"], "--template", files["head.usdc"], "-o", files["personal.usdc"])
    assert run(capsys, "personal-template", *words)[0] == 0
    for number, name in enumerate(("jaw_open", "smile", "laugh")):
        seen = simulate(actor.composite(COMPOSITES[name]), 100 * 101 + number)
        scan = Scan(name=name, points=seen.points, triangles=seen.triangles.astype(np.int32))
        write_ply(scan, files[f"{name}.ply"])
        write_scan_landmarks(ScanLandmarks(points=seen.landmarks), files[f"{name}.landmarks.json"])
        words = (files[f"{name}.ply"], "--personal", files["personal.usdc"], "-o", files[f"{name}.usdc"])
        code, _, err = run(capsys, "register-scan", *words, "--picture", files[f"{name}.png"])
        assert code in (0, 1), err
    registered = [files[f"{name}.usdc"] for name in ("jaw_open", "smile", "laugh")]
    files_of = ("--personal", files["personal.usdc"], "-o", files["actor.usdc"])
    code, out, err = run(capsys, "split-shapes", *registered, *files_of)
    assert code == 0, err
    print(out)
    assert validate(files["actor.usdc"]) == ()
    off: dict[str, list[float]] = {"personal.usdc": [], "actor.usdc": []}
    for name in ("jawOpen", "mouthSmile_L", "mouthSmile_R", "cheekSquint_L", "cheekSquint_R"):
        truth = actor.shape(name)[: ict().full_face]
        moved = np.linalg.norm(truth, axis=1) > 0.05 * np.linalg.norm(truth, axis=1).max()
        ours = name.replace("_L", "Left").replace("_R", "Right")
        for file, means in off.items():
            delta = whole_face(facepipe.open(files[file]).parts(), file).deltas[ours][: ict().full_face]
            means.append(float(np.linalg.norm(delta - truth, axis=1)[moved].mean()))
    print(off)
    assert np.mean(off["actor.usdc"]) < 0.65 * np.mean(off["personal.usdc"])
