"""Sliders made of blendshapes: what names say, where bones go, how sides mirror, what a residual makes good."""

from __future__ import annotations

import doctest
import functools
import json
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import done, failed, run
from faces import replace_mesh, tiny_face, with_meshes
from import_data import shared
from oracle import difference, random_coefficients
from places import REPOSITORY
from small_head import make

import facepipe
from facepipe.checks import validate
from facepipe.core.errors import InputError, SchemaError
from facepipe.core.names import mirrored_name
from facepipe.importers import makehuman
from facepipe.parts import Blendshape, BoneLimits, FaceParts, Slider
from facepipe.performing import perform, read_kept
from facepipe.rig import CHANNELS, Rig, build, rest_coefficients, slide
from facepipe.stage import Face, save_parts
from facepipe.verbs.fit_bones import LimitRules, read_limits
from facepipe.verbs.sliders import ShapeSlidersReport, SlidersFromShapes, SlidersOfFace
from facepipe.verbs.sliders import shape_names as names_module
from facepipe.verbs.sliders.shape_fits import channel_effects
from facepipe.verbs.sliders.shape_names import PAIRS, ShapeSlider, parse_pairs, shape_sliders

Capsys = pytest.CaptureFixture[str]
LIMITS = REPOSITORY / "docs/slider_bones.json"
TARGETS = "nose/nose-hump-*,nose/nose-trans-out,nose/nose-trans-in,chin/chin-triangle,?*/?-cheek-trans-*"
STILL = ("root:*", "neck:*", "head:*", "jaw*:*", "chin*:*", "jowl*:*", "lipLower*:*")
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


def made_of(parts: FaceParts, maker: SlidersFromShapes) -> tuple[Face, ShapeSlidersReport]:
    """A face with the sliders, read back from a file."""
    with tempfile.TemporaryDirectory() as name:
        save_parts(parts, f"{name}/face.usdc")
        with facepipe.open(f"{name}/face.usdc").deriving(f"{name}/made.usda", flatten=True) as face:
            report = maker(face)
        found = facepipe.open(f"{name}/made.usda")
        assert found.parts()
        return found, report


@functools.cache
def sample() -> FaceParts:
    return make(0)


@functools.cache
def head() -> FaceParts:
    """MakeHuman with some targets as shapes."""
    return makehuman.read(shared("makehuman/makehuman_head.npz"), makehuman.Options(shapes=TARGETS)).parts


@functools.cache
def head_made(residual: bool = False) -> tuple[Face, ShapeSlidersReport]:
    return made_of(head(), SlidersFromShapes(limits=read_limits(LIMITS), residual=residual))


@functools.cache
def sample_made(residual: bool = False) -> tuple[Face, ShapeSlidersReport]:
    return made_of(sample(), SlidersFromShapes(shapes="mouthSmile*,jawLeft,jawRight,jawOpen", residual=residual))


MADE = {"sample": sample_made, "makehuman": head_made}
faces = pytest.mark.parametrize("name", MADE)


def by_name(face: Face) -> dict[str, Slider]:
    return {slider.name: slider for slider in face.sliders}


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sample")
    save_parts(sample(), path / "face.usdc")
    return path


@pytest.fixture
def folder(saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(saved, tmp_path, dirs_exist_ok=True)
    (tmp_path / "limits.json").write_text(json.dumps({"lock": STILL}))
    return tmp_path


# ---- what names say


def names(*shapes: str, pairs: str = PAIRS) -> dict[str, ShapeSlider]:
    return {slider.name: slider for slider in shape_sliders(shapes, parse_pairs(pairs))}


def test_examples_in_the_docs_hold() -> None:
    assert doctest.testmod(names_module).failed == 0


def test_two_ends_make_one_slider_and_a_single_shape_one_from_0_to_1() -> None:
    made = names("nose_hump_incr", "chin_triangle", "nose_hump_decr")
    assert list(made) == ["noseHump", "chinTriangle"]
    assert made["noseHump"].ends == ((-1.0, "nose_hump_decr"), (1.0, "nose_hump_incr"))
    assert (made["noseHump"].minimum, made["noseHump"].group) == (-1.0, "nose")
    assert made["chinTriangle"].ends == ((1.0, "chin_triangle"),)
    assert made["chinTriangle"].minimum == 0.0


def test_names_that_pairs_share_end_in_the_upper_word() -> None:
    both = names("l_eye_bag_decr", "l_eye_bag_incr", "l_eye_bag_in", "l_eye_bag_out", "l_eye_bag_height_decr")
    assert list(both) == ["eyeBagIncrLeft", "eyeBagOutLeft", "eyeBagHeightDecrLeft"]


def test_sides_are_mirrors_of_each_other() -> None:
    made = names("l_ear_up", "l_ear_down", "r_ear_up", "r_ear_down", "eye_left_slit", "eye_right_slit", "l_lid", "jaw")
    pairs = {"earLeft": "earRight", "eyeSlitLeft": "eyeSlitRight", "lidLeft": None, "jaw": None}
    for one, other in pairs.items():
        assert made[one].mirror == other
        assert other is None or made[other].mirror == one
    assert names("jawLeft", "jawRight")["jawRight"].mirror == "jawLeft"


def test_expressions_keep_their_names_and_stay_single() -> None:
    shapes = tuple(dict.fromkeys(blendshape.name for mesh in sample().meshes for blendshape in mesh.blendshapes))
    made = names(*shapes)
    assert tuple(made) == shapes
    assert {one.minimum for one in made.values()} == {0.0}
    assert {shape: one.mirror for shape, one in made.items()} == {
        shape: other if (other := mirrored_name(shape)) != shape else None for shape in shapes
    }


def test_every_shape_is_in_one_slider() -> None:
    with np.load(shared("makehuman/makehuman_head.npz")) as arrays:
        shapes = [str(name).replace("-", "_").replace("/", "_") for name in arrays["target_names"]]
    made = names(*shapes)
    assert sorted(shape for one in made.values() for _, shape in one.ends) == sorted(shapes)
    assert sum(len(one.ends) == 2 for one in made.values()) > 120
    for one in made.values():
        assert one.mirror is None or made[one.mirror].mirror == one.name


def test_pairs_are_the_users() -> None:
    assert list(names("nose_less", "nose_MORE", "a_up", "a_down", pairs="less:more")) == ["nose", "aUp", "aDown"]
    assert list(names("nose_up", "nose_down", pairs="")) == ["noseUp", "noseDown"]
    for wrong in ("up", "up:", "a:b:c", "a_b:c", "up:down,in:up", "up:up"):
        with pytest.raises(InputError, match="option pairs"):
            SlidersFromShapes(pairs=wrong)


# ---- where bones go


@faces
def test_an_end_is_the_pose_that_was_reported(name: str) -> None:
    face, report = MADE[name]()
    rest, sliders = face.evaluate(), by_name(face)
    assert set(sliders) >= set(report.sliders)
    for slider, one in report.sliders.items():
        values = (-1.0, 1.0) if len(one.ends) == 2 else (1.0,)
        for value, end in zip(values, one.ends, strict=True):
            coefficients, _ = slide([sliders[slider]], face.skeleton.joints, {slider: value})
            points = face.evaluate(sliders={slider: value})
            assert difference(face, points, face.evaluate(coefficients=coefficients)) <= 1e-6
            off = np.linalg.norm(points - face.evaluate({end.shape: 1.0}), axis=1) * face.mm_per_unit
            assert np.sqrt((off**2).mean()) == pytest.approx(end.left_rms_mm, abs=1e-4)
            assert off.max() == pytest.approx(end.left_max_mm, abs=1e-3)
            assert end.left_rms_mm < end.rms_mm or end.reach == 0
        assert np.array_equal(face.evaluate(sliders={slider: 0.0}), rest)
    assert {one.by for one in report.sliders.values()} == {"bones"}


@faces
def test_values_between_go_steadily_from_rest_to_the_end(name: str) -> None:
    face, report = MADE[name]()
    rest = face.evaluate()
    for slider, one in report.sliders.items():
        for end in (1.0, -1.0)[: len(one.ends)]:
            steps = [face.evaluate(sliders={slider: end * share}) for share in (0.25, 0.5, 0.75, 1.0)]
            moved = np.stack([np.linalg.norm(points - rest, axis=1) for points in steps])
            clearly = moved[-1] * face.mm_per_unit > 0.1 * max(moved[-1].max() * face.mm_per_unit, 1.0)
            assert (np.diff(moved[:, clearly], axis=0) > 0).all()


def partner(rig: Rig, joint: int) -> int:
    paths = ["/".join(mirrored_name(part) for part in path.split("/")) for path in rig.joints]
    return rig.joints.index(paths[joint])


@faces
def test_sliders_of_two_sides_are_mirror_images(name: str) -> None:
    """To the last digit in gains, in the world as far as the joints of the rig are mirror images."""
    face, report = MADE[name]()
    rig, sliders = face.rig(), by_name(face)
    sided = [one for one in report.sliders if report.sliders[one].mirror]
    assert sided
    for slider in sided:
        other = str(report.sliders[slider].mirror)
        assert sliders[slider].mirror == other
        own, twin = ({channel[:2]: abs(channel[2]) for channel in sliders[key].channels} for key in (slider, other))
        assert {(rig.joints[partner(rig, rig.joints.index(joint))], c): g for (joint, c), g in own.items()} == twin
        motions = []
        for key in (slider, other):
            coefficients, _ = slide([sliders[key]], rig.joints, {key: 1.0})
            worlds = rig.joint_worlds(rig.local_transforms(coefficients))
            motions.append(worlds @ np.linalg.inv(rig.joint_worlds(rig.rest)))
        for joint in range(len(rig.joints)):
            np.testing.assert_allclose(motions[1][partner(rig, joint)], MIRROR @ motions[0][joint] @ MIRROR, atol=1e-5)


def test_shapes_of_the_middle_move_both_sides_alike_unless_they_are_lopsided() -> None:
    face, report = head_made()
    assert report.sliders["noseHump"].symmetric
    assert report.sliders["chinTriangle"].symmetric
    assert not report.sliders["noseTrans"].symmetric
    rig = face.rig()
    own = {one[:2]: one[2] for (one,) in zip(by_name(face)["chinTriangle"].channels)}
    for (joint, channel), gain in own.items():
        other = rig.joints[partner(rig, rig.joints.index(joint))]
        assert abs(own[other, channel]) == abs(gain)


@faces
def test_limits_hold_at_every_end(name: str) -> None:
    face, report = MADE[name]()
    limits = face.parts().bone_limits
    if name == "makehuman":
        lower, upper = read_limits(LIMITS).resolve(face.skeleton.joints, face.meters_per_unit)
        limits = BoneLimits(lower=lower, upper=upper)
    assert limits is not None
    made = [one for one in face.sliders if one.name in report.sliders]
    for slider in made:
        for value in (slider.minimum, slider.maximum):
            coefficients, _ = slide([slider], face.skeleton.joints, {slider.name: value})
            rounded = coefficients.astype(np.float32)
            assert ((rounded >= limits.lower) & (rounded <= limits.upper)).all()
    assert report.beyond_limits == ()


def test_channels_that_hardly_move_a_point_are_left_out() -> None:
    """And what is left out costs little: the others are fitted again."""
    parts = head()
    rules, shapes = read_limits(LIMITS), "nose_hump_*"
    few, all_ = (made_of(parts, SlidersFromShapes(shapes=shapes, limits=rules, least_effect=x))[1] for x in (0.1, 0.0))
    assert few.sliders["noseHump"].channels < 0.1 * all_.sliders["noseHump"].channels
    assert few.sliders["noseHump"].reach > all_.sliders["noseHump"].reach - 0.05


@pytest.mark.parametrize("parts", [tiny_face, make], ids=["tiny", "sample"])
def test_effects_are_those_of_a_small_step(parts: object) -> None:
    rig = build(parts(0))  # type: ignore[operator]
    rest, step = rest_coefficients(len(rig.joints)), 1e-6
    found, expected = channel_effects(rig), []
    some = np.random.default_rng(0).permutation(list(np.ndindex(rest.shape)))[:40]
    for joint, channel in some:
        moved = rest.copy()
        moved[joint, channel] += step
        expected.append(np.linalg.norm(rig.evaluate(coefficients=moved) - rig.evaluate(), axis=1).max() / step)
    np.testing.assert_allclose(found[tuple(some.T)], expected, rtol=1e-4, atol=1e-6)


def test_a_pose_of_the_bones_is_found_again() -> None:
    """A shape that bones can make is reached to the threshold, from both ends of the slider."""
    parts = tiny_face(0)
    rig, random = build(parts), np.random.default_rng(5)
    shapes = []
    for name in ("bump_in", "bump_out"):
        pose = rest_coefficients(3) + 0.3 * (random_coefficients(random, 3, 0.1) - rest_coefficients(3))
        shapes.append((name, rig.evaluate(coefficients=pose) - rig.evaluate()))
    meshes = []
    for number, mesh in enumerate(parts.meshes):
        start, stop = rig.mesh_offsets[number : number + 2]
        own = (Blendshape(name=n, point_indices=np.arange(stop - start), offsets=o[start:stop]) for n, o in shapes)
        skinned = mesh.skin is not None
        meshes.append(replace_mesh(mesh, blendshapes=tuple(own) if skinned else ()))
    face = Face.from_parts(replace(parts, meshes=tuple(meshes), skeleton=parts.skeleton))
    report = SlidersFromShapes(least_effect=0.0, regularise=0.0, threshold_mm=1e-3)(face)
    assert report.sliders["bump"].reach > 0.9
    assert report.warnings == (
        "each side is fitted alone: Tiny: no pairs of joints, expected names with left and right, or L and R",
    )


# ---- what bones can't reach


@faces
def test_with_a_residual_the_ends_are_the_shapes(name: str) -> None:
    face, report = MADE[name](residual=True)  # type: ignore[call-arg]
    assert not report.left_out
    assert {one.by for one in report.sliders.values()} >= {"bones and residual"}
    for slider, one in report.sliders.items():
        for value, end in zip((-1.0, 1.0) if len(one.ends) == 2 else (1.0,), one.ends, strict=True):
            points, target = face.evaluate(sliders={slider: value}), face.evaluate({end.shape: 1.0})
            assert np.linalg.norm(points - target, axis=1).max() * face.mm_per_unit <= 0.1
            assert end.end_max_mm <= 0.1
            assert (f"{end.shape}_residual" in face.shapes) == (end.residual_points > 0)


def test_a_slider_and_its_mirror_are_both_made_or_neither_is() -> None:
    """By what bones reach of both, though they reach more of one."""

    def made(least_reach: float) -> dict[str, float]:
        maker = SlidersFromShapes(shapes="jawOpen,mouthSmile*", least_reach=least_reach, residual=False)
        return {name: one.reach for name, one in made_of(sample(), maker)[1].sliders.items()}

    reaches = made(0.0)
    low, high = sorted(reach for name, reach in reaches.items() if name != "jawOpen")
    assert high - low > 1e-3
    assert made(0.95 * low + 0.05 * high).keys() == {"jawOpen", "mouthSmileLeft", "mouthSmileRight"}
    assert made(0.05 * low + 0.95 * high).keys() == {"jawOpen"}


def test_shapes_that_bones_hardly_reach_are_left_out_or_drive_their_slider_alone() -> None:
    for residual in (False, True):
        maker = SlidersFromShapes(
            shapes="jawOpen,mouthSmile*", limits=LimitRules(lock=STILL), least_reach=0.2, residual=residual
        )
        face, report = made_of(sample(), maker)
        assert (list(report.left_out) == ["jawOpen"]) is not residual
        assert any("left out" in line for line in report.warnings) is not residual
        if residual:
            assert report.sliders["jawOpen"].by == "shapes"
            assert by_name(face)["jawOpen"].shapes == (("jawOpen", 1.0),)
            assert difference(face, face.evaluate(sliders={"jawOpen": 0.5}), face.evaluate({"jawOpen": 0.5})) < 1e-12
        else:
            assert "jawOpen" not in by_name(face)


# ---- on the face


def test_sliders_of_the_same_names_are_replaced_and_keep_their_values() -> None:
    parts = sample()
    jaw = next(joint for joint in parts.skeleton.joints if joint.endswith("jaw"))
    old = tuple(
        Slider(name=name, value=value, channels=((jaw, "rx", 0.1),)) for name, value in (("jawOpen", 0.5), ("x", 1))
    )
    parts = replace(parts, sliders=old)
    for drop in (False, True):
        face, report = made_of(parts, SlidersFromShapes(shapes="jawOpen", drop=drop))
        assert (report.replaced, report.dropped) == (("jawOpen",), ("x",) if drop else ())
        assert set(by_name(face)) == ({"jawOpen"} if drop else {"jawOpen", "x"})
        assert by_name(face)["jawOpen"].value == 0.5
        assert len(by_name(face)["jawOpen"].channels) > 1


def test_the_same_again_is_the_same(folder: Path) -> None:
    files = []
    for name in ("one", "two"):
        with facepipe.open(folder / "face.usdc").deriving(folder / f"{name}.usda") as face:
            SlidersFromShapes(shapes="mouthSmile*", residual=True)(face)
        files.append((folder / f"{name}.usda").read_bytes())
    assert files[0] == files[1]
    with facepipe.open(folder / "one.usda").deriving(folder / "three.usda") as face:
        SlidersFromShapes(shapes="mouthSmile*", residual=True)(face)  # residuals are no shapes to make sliders of
    one, three = (facepipe.open(folder / f"{name}.usda") for name in ("one", "three"))
    assert one.sliders == three.sliders
    assert one.shapes == three.shapes


def test_made_faces_are_valid(folder: Path) -> None:
    with facepipe.open(folder / "face.usdc").deriving(folder / "made.usda") as face:
        SlidersFromShapes(shapes="mouth*", residual=True)(face)
    assert not [one for one in validate(folder / "made.usda") if one.severity == "error"]


def shapeless() -> FaceParts:
    return with_meshes(tiny_face(0), blendshapes=())


@pytest.mark.parametrize(
    ("parts", "maker", "message"),
    [
        (shapeless, {}, "no blendshapes"),
        (tiny_face, {"shapes": "nothing*"}, "matches none"),
        (tiny_face, {"shapes": " , "}, "no pattern"),
        (tiny_face, {"limits": LimitRules(joints=(("jaw", {"rx": (0.1, 0.2)}),))}, "expected rest inside"),
        (tiny_face, {"limits": LimitRules(joints=(("jawless", {"rx": (0.1, 0.2)}),))}, "jawless"),
    ],
)
def test_faces_and_options_that_give_no_sliders_are_refused(parts: object, maker: dict, message: str) -> None:
    face = Face.from_parts(parts())  # type: ignore[operator]
    before = face.stage.GetRootLayer().ExportToString()
    with pytest.raises(InputError, match=message):
        SlidersFromShapes(**maker)(face)
    assert face.stage.GetRootLayer().ExportToString() == before


# ---- the command


def test_the_command_makes_them_and_its_recipe_makes_them_again(folder: Path, capsys: Capsys) -> None:
    words = ("face.usdc", "--from-shapes", "mouthSmile*,jawOpen", "--limits", "limits.json", "--least-reach", "0.2")
    code, out, err = run(capsys, "sliders", *words, "-o", "made.usda", "--json")
    assert code == 1
    assert "1 sliders left out" in err
    report = json.loads(out)
    assert (list(report["sliders"]), list(report["left_out"])) == (["mouthSmileLeft", "mouthSmileRight"], ["jawOpen"])
    perform(SlidersOfFace(**read_kept("made.usda", SlidersOfFace).values), Path("again.usda"))
    assert facepipe.open("again.usda").sliders == facepipe.open("made.usda").sliders
    text = done(capsys, "sliders", *words, "--residual", "-o", "whole.usda")
    assert "jawOpen" in text
    assert "shapes" in text
    done(capsys, "sliders", "whole.usda", "--set", "mouthSmileLeft=0.5", "--mirror", "-o", "posed.usda")


@pytest.mark.parametrize(
    "options", ['{"shapes": 3}', '{"shapes": "*", "drop": false, "limits": {}, "options": {"pairs": 1}}']
)
def test_damaged_recipes_are_reported(options: str, folder: Path, capsys: Capsys) -> None:
    done(capsys, "sliders", "face.usdc", "--from-shapes", "jawOpen", "-o", "made.usda")
    stage = facepipe.open("made.usda").stage
    stage.GetDefaultPrim().GetAttribute("facepipe:recipe:options").Set(options)
    stage.GetRootLayer().Save()
    with pytest.raises(SchemaError):
        read_kept("made.usda", SlidersOfFace)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--from-shapes", "--set", "a=1", "-o", "out.usda"), "--from-shapes: given with --set"),
        (("--from-shapes", "--from", "t.toml", "-o", "out.usda"), "--from: given with --from-shapes"),
        (("--residual",), "--residual: given without --from-shapes"),
        (("--limits", "limits.json", "--reset", "-o", "out.usda"), "--limits: given without --from-shapes"),
        (("--from-shapes", "--limits", "none.json", "-o", "out.usda"), "none.json"),
        (("--from-shapes", "jawOpen", "--limits", "limits.json", "-o", "out.usda"), "bones reach no shape"),
        (("--from-shapes", "jawOpen", "--least-reach", "2", "-o", "out.usda"), "least_reach"),
        (("--from-shapes", "--pairs", "up", "-o", "out.usda"), "option pairs"),
        (("--from-shapes", "nothing", "-o", "out.usda"), "option from-shapes: 'nothing' matches none"),
    ],
)
def test_wrong_words_are_reported_and_nothing_is_written(
    words: tuple[str, ...], message: str, folder: Path, capsys: Capsys
) -> None:
    assert message in failed(capsys, "sliders", "face.usdc", *words)


@pytest.mark.slow
def test_all_targets_of_the_face_make_sliders() -> None:
    groups = ("nose", "mouth", "eyes", "chin", "cheek", "forehead", "eyebrows")
    options = makehuman.Options(shapes=",".join(f"{group}/*" for group in groups))
    parts = makehuman.read(shared("makehuman/makehuman_head.npz"), options).parts
    face, report = made_of(parts, SlidersFromShapes(limits=read_limits(LIMITS)))
    assert len(report.sliders) + len(report.left_out) == 100
    made = [
        slider for slider in face.sliders if slider.name not in {own.name for own in parts.sliders}
    ]  # beside pose units
    assert len(made) == len(report.sliders) >= 75
    assert {channel for one in made for _, channel, _ in one.channels} == set(CHANNELS)
    for group in ("nose", "mouth", "eye", "cheek"):
        assert report.groups[group].reach > 0.4
