"""`facepipe sliders`: lists, authors tables, and poses faces as UsdSkel shows them."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import done, exit_code, failed, run
from faces import tiny_face
from oracle import difference, played
from places import REPOSITORY
from small_head import make

import facepipe
from facepipe.parts import Animation, BoneLimits, FaceParts, Slider
from facepipe.performing import perform, read_kept
from facepipe.rig import CHANNELS, slide
from facepipe.stage import Face, save_parts
from facepipe.verbs.sliders import SetSliders, SlidersOfFace, read_table

Capsys = pytest.CaptureFixture[str]
DOCS = (REPOSITORY / "docs/sliders.md").read_text(encoding="utf-8")
TOLERANCE = 1e-5  # head heights

SLIDERS = (
    Slider(name="jawLeft", group="jaw", channels=(("root/jaw", "tx", 0.5),), mirror="jawRight"),
    Slider(name="jawRight", group="jaw", channels=(("root/jaw", "tx", -0.5),), mirror="jawLeft"),
    Slider(
        name="open",
        minimum=-1.0,
        value=0.5,
        channels=(("root/jaw/lip", "sy", 0.5), ("root/jaw", "rx", 0.25)),
        channel_curves=(None, ((-1.0, 0.0), (0.0, 0.0), (1.0, 2.0))),
        shapes=(("jawOpen", 1.0),),
        shape_curves=(((0.0, 0.0), (1.0, 1.0)),),
    ),
)
TABLE = """
[slider.open]
range = [0, 2]
shapes = { jawOpen = 0.5 }
[slider.jawRight]
channels = { "jaw:tx" = -0.25 }
[slider.lips]
range = [-1, 1]
mirror = "lipsOther"
channels = { "lip:t" = 0.1 }
[slider.lipsOther]
range = [-1, 1]
channels = { "lip:t" = -0.1 }
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with face.usda and table.toml."""
    save_parts(replace(tiny_face(), sliders=SLIDERS), tmp_path / "face.usda")
    (tmp_path / "table.toml").write_text(TABLE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample head."""
    path = tmp_path_factory.mktemp("sample") / "head.usdc"
    save_parts(make(), path)
    return path


# ---- listing


def test_a_face_shows_its_sliders(folder: Path, capsys: Capsys) -> None:
    lines = done(capsys, "sliders", "face.usda").splitlines()
    assert lines[0] == "face.usda: 3 sliders in 2 groups"
    table = [re.sub(" {2,}", "  ", line.strip()) for line in lines[1:]]
    assert table == [
        "(no group)",
        "open  -1 to 1, 0  = 0.5  lip:sy 0.5, jaw:rx 0.25 x curve of 3, jawOpen 1 x curve of 2",
        "jaw",
        "jawLeft  0 to 1, 0  jaw:tx 0.5  mirror jawRight",
        "jawRight  0 to 1, 0  jaw:tx -0.5  mirror jawLeft",
    ]


def test_machines_get_all(folder: Path, capsys: Capsys) -> None:
    listed = {one["name"]: one for one in json.loads(done(capsys, "sliders", "face.usda", "--json"))["sliders"]}
    assert list(listed) == ["jawLeft", "jawRight", "open"]
    assert listed["jawLeft"]["mirror"] == "jawRight"
    assert listed["open"] == {
        "name": "open",
        "group": "",
        "range": [-1.0, 1.0],
        "default": 0.0,
        "value": 0.5,
        "mirror": None,
        "channels": [
            {"joint": "root/jaw/lip", "channel": "sy", "gain": 0.5, "curve": None},
            {"joint": "root/jaw", "channel": "rx", "gain": 0.25, "curve": [[-1, 0], [0, 0], [1, 2]]},
        ],
        "shapes": [{"shape": "jawOpen", "gain": 1.0, "curve": [[0, 0], [1, 1]]}],
    }


def test_a_face_without_sliders_has_a_line_that_says_so(folder: Path, capsys: Capsys) -> None:
    save_parts(tiny_face(), folder / "none.usda")
    assert done(capsys, "sliders", "none.usda") == "none.usda: 0 sliders in 0 groups\n"
    assert "sliders: none, expected some" in failed(capsys, "sliders", "none.usda", "--reset", "-o", "out.usda")
    assert "no slider 'a'; there are none" in failed(capsys, "sliders", "none.usda", "--set", "a=1", "-o", "out.usda")


# ---- tables


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_a_table_is_authored_over_the_face(suffix: str, folder: Path, capsys: Capsys) -> None:
    out = folder / f"out{suffix}"
    assert "4 sliders, 2 of them replaced, over 4 channels and 1 shapes" in done(
        capsys, "sliders", "face.usda", "--from", "table.toml", "-o", out
    )
    assert exit_code("validate", out) == 0
    table = read_table(folder / "table.toml")
    expected = {one.name: one for one in SLIDERS}
    new = {one.name: one for one in table.resolve(tiny_face().skeleton.joints, ("jawOpen",), 0.01)}
    new["open"] = replace(new["open"], value=0.5)  # in the new range: kept
    new["jawRight"] = replace(new["jawRight"], mirror="jawLeft")  # which still names it
    new["lipsOther"] = replace(new["lipsOther"], mirror="lips")
    found = facepipe.open(out).sliders
    assert [one.name for one in found] == ["jawLeft", "jawRight", "lips", "lipsOther", "open"]
    for one in found:
        assert_near(one, {**expected, **new}[one.name])


def assert_near(one: Slider, other: Slider) -> None:
    """Equal but for float32."""
    for bones in (True, False):
        rows = [slider.channels if bones else slider.shapes for slider in (one, other)]
        assert [row[:-1] for row in rows[0]] == [row[:-1] for row in rows[1]]
        assert [row[-1] for row in rows[0]] == pytest.approx([row[-1] for row in rows[1]])
    assert replace(one, channels=(), shapes=()) == replace(other, channels=(), shapes=())


def test_replace_drops_what_the_table_lacks(folder: Path, capsys: Capsys) -> None:
    (folder / "table.csv").write_text("slider,target,gain\nnew,jawOpen,1\n")
    assert ", 3 dropped" in done(capsys, "sliders", "face.usda", "--from", "table.csv", "--replace", "-o", "out.usda")
    assert facepipe.open("out.usda").sliders == (Slider(name="new", shapes=(("jawOpen", 1.0),)),)


def test_what_a_table_makes_doubtful_is_reported(folder: Path, capsys: Capsys) -> None:
    limits = np.tile(np.float32([1] * 3 + [0.25] * 3 + [2] * 3), (3, 1))
    parts = replace(tiny_face(), sliders=SLIDERS, bone_limits=BoneLimits(lower=-limits, upper=limits))
    save_parts(parts, folder / "limited.usda")
    (folder / "odd.toml").write_text(
        '[slider.open]\nrange = [0, 0.25]\nchannels = { "jaw:rx" = 2 }\n'
        '[slider.far]\nchannels = { "*:rx" = -0.5 }\n[slider.idle]'
    )
    code, out, err = run(capsys, "sliders", "limited.usda", "--from", "odd.toml", "-o", "out.usda", "--json")
    assert code == 0
    assert json.loads(out)["beyond_limits"] == [
        "open -> root/jaw:rx",
        "far -> root:rx",
        "far -> root/jaw:rx",
        "far -> root/jaw/lip:rx",
    ]
    assert err.splitlines() == [
        "facepipe: warning: slider open: value 0.5 is out of its new range, now the default",
        "facepipe: warning: 1 sliders drive nothing: idle",
        "facepipe: warning: 4 channels of single sliders reach beyond the limits of the face: open -> root/jaw:rx, "
        "far -> root:rx, far -> root/jaw:rx, far -> root/jaw/lip:rx",
    ]


REFUSED: dict[str, tuple[str, str]] = {
    "a name that USD can't hold": ("[slider.2nd]", "table.toml -> slider 2nd: slider '2nd', expected letters"),
    "a name with blanks": ('[slider."my slider"]', "slider 'my slider', expected letters"),
    "a reserved name": ("[slider.value]", "is the name of a property of FacepipeSliderAPI"),
    "an unknown mirror": ('[slider.a]\nmirror = "b"', "slider a: mirror 'b', expected the name of another slider"),
    "itself as mirror": ('[slider.a]\nmirror = "a"', "slider a: mirror 'a', expected the name of another slider"),
    "a mirror of another": (
        '[slider.a]\nmirror = "jawLeft"',
        "slider a: mirror 'jawLeft', whose mirror is 'jawRight', expected them to name each other",
    ),
    "unknown joints": ('[slider.a]\nchannels = { "nose:tx" = 1 }', "nose:tx: 'nose' matches none of 3 joints"),
    "unknown shapes": ("[slider.a]\nshapes = { frown = 1 }", "frown: 'frown' matches none of 2 shapes"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_tables_that_the_face_can_not_have_are_refused(name: str, folder: Path, capsys: Capsys) -> None:
    text, message = REFUSED[name]
    (folder / "table.toml").write_text(text)
    assert message in failed(capsys, "sliders", "face.usda", "--from", "table.toml", "-o", "out.usda")


def test_the_tables_of_the_page_are_authored_on_the_sample(
    sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    tables = re.findall(r"```(toml|csv)\n(.*?)```", DOCS, re.DOTALL)
    assert [kind for kind, _ in tables] == ["toml", "csv", "csv"]
    for number, (kind, text) in enumerate(tables):
        (tmp_path / f"page.{kind}").write_text(text)
        done(capsys, "sliders", sample, "--from", f"page.{kind}", "--replace", "-o", f"{number}.usda")
        face = facepipe.open(f"{number}.usda")
        at_ends = {slider.name: slider.maximum for slider in face.sliders}
        assert np.abs(face.evaluate(sliders=at_ends) - face.evaluate()).max() > 0.1


# ---- setting


def rounded(face: Face, values: dict[str, float]) -> np.ndarray:
    """Points of slider values as UsdSkel can hold them: scales in half precision."""
    coefficients, weights = slide(face.sliders, face.skeleton.joints, values)
    coefficients[:, 6:] = coefficients[:, 6:].astype(np.float16)
    return face.evaluate(weights, coefficients=coefficients)


@pytest.mark.parametrize("more", [(), ("--flatten",)], ids=["layer", "standalone"])
@pytest.mark.parametrize("suffix", [".usda", ".usdz"])
def test_a_viewer_shows_the_posed_face(suffix: str, more: tuple[str, ...], folder: Path, capsys: Capsys) -> None:
    face, values = facepipe.open("face.usda"), {"open": 0.75, "jawLeft": 0.3}
    out = folder / f"out{suffix}"
    text = done(capsys, "sliders", "face.usda", "--set", "open=0.75", "--set", "jawLeft=0.3", "-o", out, *more)
    assert "open 0.75, jawLeft 0.3: 2 joints off rest, 1 shapes on" in text
    assert exit_code("validate", out) == 0
    assert difference(face, played(out)[0], rounded(face, values)) < TOLERANCE
    posed = facepipe.open(out)
    np.testing.assert_allclose(posed.evaluate(sliders={}), face.evaluate(sliders=values), atol=1e-6)
    transforms, weights = posed.sample("sliders")
    exact = posed.evaluate(weights, joint_transforms=transforms)
    assert difference(face, exact, face.evaluate(sliders=values)) < 1e-6


def test_every_slider_of_the_sample_poses_it(sample: Path, tmp_path: Path) -> None:
    face = facepipe.open(sample)
    rng = np.random.default_rng(6)
    values = {slider.name: float(rng.uniform(slider.minimum, slider.maximum)) for slider in face.sliders}
    with face.deriving(tmp_path / "posed.usdc") as derived:
        SetSliders(values=values)(derived)
    assert difference(face, played(tmp_path / "posed.usdc")[0], rounded(face, values)) < TOLERANCE
    assert difference(face, face.evaluate(sliders=values), face.evaluate()) > 0.02


def test_sliders_that_are_not_named_keep_their_values_or_are_reset(folder: Path, capsys: Capsys) -> None:
    done(capsys, "sliders", "face.usda", "--set", "jawLeft=0.25", "-o", "one.usda")
    done(capsys, "sliders", "one.usda", "--set", "jawRight=1", "-o", "two.usda")
    assert values_of("two.usda") == {"jawLeft": 0.25, "jawRight": 1.0, "open": 0.5}
    assert len(facepipe.open("two.usda").animations) == 1
    done(capsys, "sliders", "two.usda", "--set", "open=-1", "--reset", "-o", "three.usda")
    assert values_of("three.usda") == {"jawLeft": 0.0, "jawRight": 0.0, "open": -1.0}
    done(capsys, "sliders", "two.usda", "--reset", "-o", "four.usda")
    face = facepipe.open("four.usda")
    assert difference(face, played(Path("four.usda"))[0], face.evaluate()) < TOLERANCE


def values_of(path: str) -> dict[str, Any]:
    return {slider.name: slider.value for slider in facepipe.open(path).sliders}


def test_only_the_values_are_authored_of_sliders(folder: Path, capsys: Capsys) -> None:
    done(capsys, "sliders", "face.usda", "--set", "jawLeft=0.25", "-o", "out.usda")
    assert set(re.findall(r"facepipe:slider:\S+", (folder / "out.usda").read_text())) == {
        "facepipe:slider:jawLeft:value"
    }


@pytest.mark.parametrize(
    ("words", "left", "right"),
    [
        (("jawLeft=0.5",), 0.5, 0.5),
        (("jawRight=0.5",), 0.5, 0.5),
        (("jawRight=0.5", "jawLeft=0.25"), 0.25, 0.5),
        (("jawRight=0.5", "open=1"), 0.5, 0.5),
    ],
)
def test_mirror_sets_the_other_side(
    words: tuple[str, ...], left: float, right: float, folder: Path, capsys: Capsys
) -> None:
    flags = [word for one in words for word in ("--set", one)]
    done(capsys, "sliders", "face.usda", *flags, "--mirror", "-o", "out.usda")
    found = values_of("out.usda")
    assert (found["jawLeft"], found["jawRight"]) == (left, right)


def test_a_pose_beyond_limits_is_written_and_reported(folder: Path, capsys: Capsys) -> None:
    limits = np.tile(np.float32([0.25] * 3 + [1] * 3 + [2] * 3), (3, 1))
    parts = replace(tiny_face(), sliders=SLIDERS, bone_limits=BoneLimits(lower=-limits, upper=limits))
    save_parts(parts, folder / "limited.usda")
    code, _, err = run(capsys, "sliders", "limited.usda", "--set", "jawLeft=0.75", "-o", "out.usda")
    assert (code, err) == (1, "facepipe: warning: 1 channels beyond the limits of the face: jaw:tx\n")
    assert values_of("out.usda")["jawLeft"] == 0.75
    done(capsys, "sliders", "limited.usda", "--set", "jawLeft=0.75", "--set", "jawRight=0.75", "-o", "within.usda")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--set", "opne=1"), "no slider 'opne', did you mean 'open'?"),
        (("--set", "open=2"), "slider open: value 2, expected -1 to 1"),
        (("--set", "open=nan"), "--set open=nan: expected NAME=NUMBER with a finite number"),
        (("--set", "open"), "--set open: expected NAME=NUMBER"),
        (("--set", "open=1", "--mirror"), "none of open has a mirror, expected one of a symmetric pair"),
        (("--set", "open=1", "--from", "table.toml"), "--from: given with --set, expected only one of them"),
        (("--reset", "--from", "table.toml"), "--from: given with --reset"),
        (("--set", "open=1", "--name", "my pose"), "'my pose' is no name of a prim"),
        (("--set", "open=1", "--replace"), "--replace: given without --from"),
        (("--reset", "--mirror"), "--mirror: given without --set"),
        ((), "-o: given without --from, --from-shapes, --from-network, --person or --set"),
        (("--set", "open=1", "--name", "talk"), "has a clip 'talk' already, expected another name"),
    ],
)
def test_wrong_words_are_reported_and_nothing_is_written(
    words: tuple[str, ...], message: str, folder: Path, capsys: Capsys
) -> None:
    talk = Animation(name="talk", times=np.array([0.0, 1.0]), shapes=("jawOpen",), shape_weights=np.zeros((2, 1)))
    save_parts(replace(tiny_face(), sliders=SLIDERS, animations=(talk,)), folder / "face.usda")
    assert message in failed(capsys, "sliders", "face.usda", *words, "-o", "out.usda")


def test_sliders_of_what_the_face_lacks_can_not_be_set(folder: Path, capsys: Capsys) -> None:
    for slider in (
        Slider(name="open", channels=(("root/nose", "tx", 1.0),)),
        Slider(name="open", shapes=(("frown", 1.0),)),
    ):
        save_parts(replace(tiny_face(), sliders=(slider,)), folder / "stray.usda")
        found = failed(capsys, "sliders", "stray.usda", "--set", "open=1", "-o", "out.usda")
        assert "stray.usda" in found
        assert "root/nose" in found or "frown" in found


def test_existing_files_and_inputs_are_safe(folder: Path, capsys: Capsys) -> None:
    assert "is an input" in failed(capsys, "sliders", "face.usda", "--set", "open=1", "-o", "face.usda", "--force")
    assert "is an input" in failed(
        capsys, "sliders", "face.usda", "--from", "table.toml", "-o", "table.toml", "--force"
    )
    assert "suffix" in failed(capsys, "sliders", "face.usda", "--set", "open=1", "-o", "out.txt")
    done(capsys, "sliders", "face.usda", "--set", "open=1", "-o", "out.usda")
    assert "--force" in failed(capsys, "sliders", "face.usda", "--set", "open=1", "-o", "out.usda")
    first = (folder / "out.usda").read_bytes()
    done(capsys, "sliders", "face.usda", "--set", "open=1", "-o", "out.usda", "--force")
    assert (folder / "out.usda").read_bytes() == first


# ---- recipes


def test_recipes_make_the_same_again(folder: Path, capsys: Capsys) -> None:
    done(capsys, "sliders", "face.usda", "--from", "table.toml", "--replace", "-o", "made.usda")
    done(capsys, "sliders", "made.usda", "--set", "lips=0.5", "--mirror", "-o", "set.usda")
    for name in ("made", "set"):
        kept = read_kept(f"{name}.usda", SlidersOfFace)
        assert kept.warnings == ()
        perform(SlidersOfFace(**kept.values), Path("again.usda"))
        one, other = (facepipe.open(path) for path in ("again.usda", f"{name}.usda"))
        assert one.sliders == other.sliders
        np.testing.assert_array_equal(one.evaluate(sliders={}), other.evaluate(sliders={}))
        Path("again.usda").unlink()
    (folder / "table.toml").write_text(TABLE + "[slider.more]\n")
    assert read_kept("made.usda", SlidersOfFace).warnings == ("table.toml changed since made.usda was made",)


@pytest.mark.parametrize("options", ["{}", '{"drop": 3}', "[]", '{"values": {"a": "b"}}'])
def test_damaged_recipes_are_reported(options: str, folder: Path, capsys: Capsys) -> None:
    done(capsys, "sliders", "face.usda", "--set", "open=1", "-o", "set.usda")
    text = (folder / "set.usda").read_text()
    changed = re.sub(r"(recipe:options = )'.*'", lambda found: f"{found[1]}'{options}'", text)
    assert changed != text
    (folder / "set.usda").write_text(changed)
    failed(capsys, "sliders", "--edit", "set.usda", "-o", "again.usda")


def test_edit_changes_what_is_given(folder: Path, capsys: Capsys) -> None:
    done(capsys, "sliders", "face.usda", "--set", "open=1", "-o", "set.usda")
    done(capsys, "sliders", "--edit", "set.usda", "--set", "open=0.5", "--force")
    assert read_kept("set.usda", SlidersOfFace).values["values"] == {"open": 0.5}
    words = ("--edit", "set.usda", "--from", "table.toml", "--no-set", "-o", "made.usda")
    done(capsys, "sliders", *words)
    done(capsys, "sliders", "face.usda", "--from", "table.toml", "-o", "fresh.usda")
    assert Path("made.usda").read_bytes() == Path("fresh.usda").read_bytes()


def test_sliders_alone_bound_what_is_posed() -> None:
    """The pose holds every joint and shape that some slider drives, so that all poses of a face have the same lists."""
    parts: FaceParts = replace(tiny_face(), sliders=SLIDERS)
    face = Face.from_parts(parts)
    SetSliders(values={"open": -1.0})(face)
    animation = next(one for one in Face(face.stage).animations if one.name == "sliders")
    assert animation.joints == ("root/jaw", "root/jaw/lip")
    assert animation.shapes == ("jawOpen",)
    assert animation.coefficients is not None
    assert animation.coefficients[0, 1, CHANNELS.index("sy")] == 0.5
